"""Reflexes answer a packet of any age with forces, without predicting anything.

While each packet replaces all that was known, whatever a predictor plays is a function of the last
packet and its age. A reflex learns that function as it is.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.actor import SECOND_HIDDEN
from hjepa_cli.core.networks.symmetry import embedding_signs, force_signs, linear_layers
from hjepa_cli.core.plants.system import System

DECAYS = 8  # of the age: e^(−age/τ) for as many τ, from one step to the longest age


class Reflex(nn.Module):
    """In this MLP D-1024-256-H a function of the age scales the first hidden layer, unit by unit.

    What is left of a packet after j steps is, near rest, linear in what it said, with factors that
    depend on j: a product, which a network that only adds the age to its inputs would have to make
    from bends.

    Args:
        embedding, hidden: D, and the width of the first hidden layer.
        longest_age: A, in steps; older packets are taken to be as old as this.
        forces_at_once: H, the steps that one call plays.
        sees_forces: whether the forces sent since the packet are inputs too.
        action_shape: that of the plant.
        mirror: what a mirror does to the forces of a step, a factor for each; then reflected
            embeddings give mirrored forces. ``None``: an ordinary network.
    """

    decay_rates: Tensor

    def __init__(
        self,
        embedding: int,
        hidden: int,
        *,
        longest_age: int,
        forces_at_once: int,
        sees_forces: bool = False,
        action_shape: tuple[int, ...] = (),
        mirror: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.longest_age, self.sees_forces = longest_age, sees_forces
        self.shape = (forces_at_once, *action_shape)
        exponents = torch.arange(DECAYS) / (DECAYS - 1)
        self.register_buffer("decay_rates", float(longest_age) ** -exponents, persistent=False)
        self.mirrored = mirror is not None
        self.scale = nn.Linear(DECAYS + 1, hidden // 2 if self.mirrored else hidden)
        forces = force_signs(mirror or (1.0,) * math.prod(action_shape))
        inputs = embedding_signs(embedding) + forces * (longest_age * sees_forces)
        parts = inputs, hidden, SECOND_HIDDEN, forces * forces_at_once
        self.first, self.second, self.output = linear_layers(*parts, mirrored=self.mirrored)

    def forward(self, z: Tensor, ages: Tensor, sent: Tensor | None = None) -> Tensor:
        """Return forces ÷ force limit [n, J, H, *A] of the ages j … j + H − 1, unclipped.

        Args:
            z: the last packets' embeddings [n, D].
            ages: J ages j of each in steps [n, J].
            sent: forces ÷ force limit [n, J, A, *A] of the ages 0 … A − 1, zero from j on; only
                where the network ``sees_forces``.
        """
        inputs = z.unsqueeze(1)  # once for all ages
        if sent is not None:
            inputs = torch.cat([inputs.expand(-1, ages.shape[1], -1), sent.flatten(2)], dim=-1)
        ages = ages.clamp(max=self.longest_age).unsqueeze(-1).to(z.dtype)
        even = torch.cat([ages / self.longest_age, torch.exp(-ages * self.decay_rates)], dim=-1)
        scale = 1.0 + self.scale(even)
        if self.mirrored:  # a unit and its twin alike: an age is what it is in a mirror
            scale = torch.cat([scale, scale], dim=-1)
        hidden = torch.relu(self.second(torch.relu(self.first(inputs) * scale)))
        forces: Tensor = self.output(hidden).reshape(*ages.shape[:2], *self.shape)
        return forces

    def act(self, z: Tensor, ages: Tensor, sent: Tensor | None = None) -> Tensor:
        """Return forces that can be applied: ``forward`` clipped to ±1."""
        return torch.clamp(self(z, ages, sent), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Decay:
    """The force of a packet fades as s e^(−j/τ) with its age j."""

    gain: float  # s
    tau_steps: float  # τ


def read_decays(metadata: Mapping[str, Any], kind: System) -> dict[str, Decay]:
    """Return what a checkpoint's metadata say of ``hold-decay`` and ``hold-decay-linear``.

    Raises:
        KeyError, TypeError, ValueError: they are not those of a reflex on this plant.
    """
    parts = {"hold-decay": metadata["reflex"], "hold-decay-linear": metadata["reflex"]["law"]}
    rows, forces = parts["hold-decay-linear"]["gains_n"], math.prod(kind.action_shape)
    if len(rows) != forces or any(len(row) != len(kind.state_names) for row in rows):
        raise ValueError(f"expected gains of {forces} forces on {len(kind.state_names)} states")
    numbers = [value for row in rows for value in row]
    for part in parts.values():
        numbers += [part["gain"], part["tau_steps"]]
        if part["tau_steps"] <= 0:
            raise ValueError(f"tau_steps = {part['tau_steps']}; expected more than 0")
    if not all(type(number) in (int, float) and math.isfinite(number) for number in numbers):
        raise ValueError("expected finite numbers")
    return {name: Decay(float(d["gain"]), float(d["tau_steps"])) for name, d in parts.items()}
