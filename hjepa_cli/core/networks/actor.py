"""The semantic actor turns embeddings into forces, as the teacher's labels say (paper §III-A)."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.symmetry import embedding_signs, force_signs, linear_layers

SECOND_HIDDEN = 256


class Actor(nn.Module):
    """This MLP D-1024-256-1 has ReLU and dropout; ``forward`` is force ÷ force limit, unclipped.

    With ``action_shape`` ``(m,)`` its last layer has m outputs. With ``mirror``, what a mirror does
    to each of them, reflected embeddings give mirrored forces, and an upright pole gets none.
    """

    def __init__(
        self,
        embedding: int,
        hidden: int,
        dropout: float,
        action_shape: tuple[int, ...] = (),
        mirror: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.action_shape = action_shape
        forces = force_signs(mirror or (1.0,) * math.prod(action_shape))
        parts = embedding_signs(embedding), hidden, SECOND_HIDDEN, forces
        first, second, last = linear_layers(*parts, mirrored=mirror is not None)
        self.layers = nn.Sequential(
            *(first, nn.ReLU(), nn.Dropout(dropout)),
            *(second, nn.ReLU(), nn.Dropout(dropout)),
            last,
        )

    def forward(self, z: Tensor) -> Tensor:
        """Map embeddings [..., D] to actions [..., *A] in units of the force limit."""
        action: Tensor = self.layers(z).reshape(*z.shape[:-1], *self.action_shape)
        return action

    def act(self, z: Tensor) -> Tensor:
        """Return the action that can be applied: ``forward`` clipped to ±1."""
        return torch.clamp(self(z), -1.0, 1.0)
