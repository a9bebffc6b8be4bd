"""Embeddings may move linearly, z' = A z + B u + c, as fitted in closed form.

The hierarchy's predictors have to beat that to earn their training.
"""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.control.embedded_split import EmbeddedSplit, embed_split
from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.core.networks.symmetry import reflect

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

RIDGES = tuple(float(weight) for weight in np.logspace(-8, 0, 9))  # x mean square of the inputs


@dataclasses.dataclass(frozen=True, eq=False)
class LinearLatent:
    """Moves embeddings linearly under actions: z' = z + [z, u, 1] W.

    Attributes:
        weights: W [D + F + 1, D], for F actions in units of the force limit.
        ridge: the weight of the penalty it was fitted with, relative to the inputs' mean square.
    """

    weights: Tensor
    ridge: float

    def step(self, z: Tensor, actions: Tensor) -> Tensor:
        """Move embeddings [n, D] by a step under actions [n, F]; their length is free."""
        return z + torch.cat([z, actions, torch.ones_like(z[:, :1])], dim=1) @ self.weights


class LinearPlanner:
    """Plays a linear latent model, one step at a time.

    The state stays linear; the actor, from embeddings [n, D] to forces_n [n, *A], sees it at the
    length that embeddings have. An action of 1 stands for the force limit.
    """

    stride = 1

    def __init__(
        self, latent: LinearLatent, actor: Callable[[Tensor], Tensor], force_limit_n: float
    ) -> None:
        self._latent, self._actor, self._limit_n = latent, actor, force_limit_n

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Plan a step, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        forces_n = self._actor(normalise(z))
        return forces_n.unsqueeze(1), self._latent.step(
            z, forces_n.reshape(len(z), -1) / self._limit_n
        )

    def follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        """Move embeddings on, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        z, actions = z.clone(), forces_n.flatten(2) if forces_n.dim() > 2 else forces_n[..., None]
        for step in range(forces_n.shape[1]):
            on = torch.from_numpy(ages > step)
            z[on] = self._latent.step(z[on], actions[on, step].to(z.device) / self._limit_n)
        return z


def fit_linear_latent(model: "Model", settings: Settings) -> LinearLatent:
    """Fit the training trajectories of the settings; the held-out ones choose the ridge.

    Of the weights :data:`RIDGES` the one is taken whose rollouts from the first embedding of each
    held-out trajectory to its end, under the forces that were applied, stay closest (mean squared
    distance at an embedding's length). What is penalised is the change that a step makes.
    """
    signs = model.plant.force_signs if model.architecture["mirror"] == "exact" else None
    train, test = (embed_split(model, settings, split) for split in ("train", "test"))
    fits = ridge_fits(train, signs)
    errors = [rollout_error(fit, test) for fit in fits]
    best = fits[int(np.argmin(errors))]
    weights = best.weights.float().to(model.device)
    return LinearLatent(weights, best.ridge)


def ridge_fits(data: EmbeddedSplit, signs: tuple[float, ...] | None) -> list[LinearLatent]:
    """Fit once for each of :data:`RIDGES`, in float64.

    With ``signs``, what a mirror does to each force, the mirror images count as data too.
    """
    z, z_next = data.z[:, :-1].flatten(0, 1).double(), data.z[:, 1:].flatten(0, 1).double()
    actions = torch.from_numpy(data.actions[:, :-1]).flatten(0, 1)
    if signs is not None:
        z, z_next = (torch.cat([part, reflect(part)]) for part in (z, z_next))
        actions = torch.cat([actions, actions * torch.tensor(signs, dtype=actions.dtype)])
    inputs = torch.cat([z, actions, torch.ones_like(z[:, :1])], dim=1)
    # One eigendecomposition serves all weights.
    values, vectors = torch.linalg.eigh(inputs.T @ inputs)
    projected = vectors.T @ (inputs.T @ (z_next - z))
    scale = values.sum() / len(values)
    return [
        LinearLatent(vectors @ (projected / (values + ridge * scale)[:, None]), ridge)
        for ridge in RIDGES
    ]


def rollout_error(latent: LinearLatent, data: EmbeddedSplit) -> float:
    """Return the mean squared distance of open-loop rollouts from k = 0 on; ∞ if they blow up."""
    z, actions = data.z[:, 0].double(), torch.from_numpy(data.actions)
    total = 0.0
    for k in range(data.z.shape[1] - 1):
        z = latent.step(z, actions[:, k])
        total += float((normalise(z) - normalise(data.z[:, k + 1])).square().mean())
    return total if np.isfinite(total) else np.inf
