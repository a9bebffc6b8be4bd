"""Planners give controllers a model's predictions: one stride of forces at a time, in newton."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.networks.hierarchy import hold, plan_stride
from hjepa_cli.core.networks.reflex import Reflex

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model


def follow(
    model: "Model",
    strides: Sequence[tuple[int, nn.Module]],
    z: Tensor,
    forces_n: Tensor,
    ages: Integers,
) -> Tensor:
    """Move embeddings [n, D] on by their ages, with the coarsest predictor as far as it goes.

    Args:
        model: whose predictors they are.
        strides: control steps and predictor of each level, coarse ones first; the last is of 1.
        z: embeddings [n, D]; they stay as they are.
        forces_n: what was applied since, [n, L, *A].
        ages: how many steps ago each was true [n].
    """
    z, actions = z.clone(), forces_n.to(z.device) / model.force_limit_n
    done = np.zeros_like(ages)
    with model.autocast():
        for stride, predictor in strides:
            while (due := ages - done >= stride).any():
                rows = np.flatnonzero(due)
                at = torch.from_numpy(done[rows, None] + np.arange(stride))
                of = torch.from_numpy(rows)
                z[of] = predictor(z[of], actions[of[:, None], at]).to(z.dtype)
                done[rows] += stride
    return z


def corrected(posterior: nn.Module, predicted: Tensor, packets: Tensor) -> Tensor:
    """Return where devices are [n, D], from where they were predicted to be and their packets.

    The posterior is a predictor that is guided by the packet, over no time and under no force.
    """
    z: Tensor = posterior(predicted, predicted.new_zeros(len(predicted), 0), packets)
    return z


def _actor(model: "Model") -> Callable[[Tensor], Tensor]:
    """Return ``model.act`` for embeddings of its own predictors, which need not be looked at."""
    actor: Any = model.networks["actor"]
    return lambda z: actor.act(z).float()


class Hierarchy:
    """Plans as H-JEPA: one coarse stride at a time, filled in by the finer levels."""

    def __init__(self, model: "Model") -> None:
        self._model = model
        self.stride = model.strides.h

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Plan a stride, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        networks = self._model.networks
        with self._model.autocast():
            actions, _, z_next = plan_stride(
                _actor(self._model),
                networks["high"],
                networks["medium"],
                networks["low"],
                z,
                self._model.strides,
                recompute_waypoint=self._model.architecture["stride_actions"] == "all",
            )
        return self._model.force_limit_n * actions, z_next

    def correct(self, predicted: Tensor, packets: Tensor) -> Tensor:
        """Return where devices are [n, D], by the model's posterior: see :func:`corrected`."""
        with self._model.autocast():
            z = corrected(self._model.networks["posterior"], predicted, packets)
        return z.to(packets.dtype)

    def follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        """Move embeddings on, by P^H in strides and by the predictor of stride 1 for the rest."""
        networks = self._model.networks
        strides = ((self.stride, networks["high"]), (1, networks["flat"]))
        return follow(self._model, strides, z, forces_n, ages)


class OnePredictor:
    """Plans as TS-JEPA: one predictor of a fixed depth, the action held in between."""

    def __init__(self, model: "Model", predictor: nn.Module, stride: int) -> None:
        self._model, self._predictor, self.stride = model, predictor, stride

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Plan a stride, as :class:`~hjepa_cli.core.networks.planning.Planner` says."""
        with self._model.autocast():
            actions = hold(_actor(self._model)(z), self.stride)
            return self._model.force_limit_n * actions, self._predictor(z, actions)

    def follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        """Move embeddings on in strides; a rest that is none goes by the predictor of stride 1."""
        strides = ((self.stride, self._predictor), (1, self._model.networks["flat"]))
        return follow(self._model, strides, z, forces_n, ages)

    def step(self, z: Tensor, forces_n: Tensor) -> Tensor:
        """Go a stride on under given forces: z [N, D], forces_n [N, *A] → embeddings [N, D]."""
        with self._model.autocast():
            actions = forces_n.to(self._model.device).unsqueeze(1) / self._model.force_limit_n
            return self._predictor(z, actions)  # type: ignore[no-any-return]


class ReflexReaction:
    """Plays a reflex in newton, as a :class:`~hjepa_cli.core.networks.planning.Reaction`."""

    def __init__(self, model: "Model", reflex: nn.Module) -> None:
        assert isinstance(reflex, Reflex)
        self._model, self._reflex = model, reflex
        self.stride = reflex.shape[0]
        self.remembers = reflex.longest_age if reflex.sees_forces else 0

    def plan(self, z: Tensor, ages: Tensor, sent_n: Tensor) -> Tensor:
        """Plan forces, as :class:`~hjepa_cli.core.networks.planning.Reaction` says."""
        limit_n, device = self._model.force_limit_n, self._model.device
        sent = (sent_n / limit_n).unsqueeze(1).to(device) if self.remembers else None
        with self._model.autocast():
            actions = self._reflex.act(z.to(device), ages.unsqueeze(1).to(device), sent)
            return limit_n * actions.squeeze(1).float()
