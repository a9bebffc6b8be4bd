"""The semantic actor: embedding → forces, trained on the teacher's labels (paper §III-A)."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.symmetry import (
    MirrorLinear,
    Signs,
    Twins,
    embedding_signs,
    force_signs,
)

SECOND_HIDDEN = 256


class Actor(nn.Module):
    """MLP D-1024-256-1 with ReLU and dropout; ``forward`` is force ÷ force limit, unclipped.

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
        linear: list[nn.Module] = [
            nn.Linear(embedding, hidden),
            nn.Linear(hidden, SECOND_HIDDEN),
            nn.Linear(SECOND_HIDDEN, math.prod(action_shape)),
        ]
        if mirror is not None:
            first, second = Twins(hidden), Twins(SECOND_HIDDEN)
            linear = [
                MirrorLinear(Signs(embedding_signs(embedding)), first),
                MirrorLinear(first, second),
                MirrorLinear(second, Signs(force_signs(mirror))),
            ]
        self.layers = nn.Sequential(
            *(linear[0], nn.ReLU(), nn.Dropout(dropout)),
            *(linear[1], nn.ReLU(), nn.Dropout(dropout)),
            linear[2],
        )

    def forward(self, z: Tensor) -> Tensor:
        """Embeddings [..., D] → actions [..., *A] in units of the force limit."""
        action: Tensor = self.layers(z).reshape(*z.shape[:-1], *self.action_shape)
        return action

    def act(self, z: Tensor) -> Tensor:
        """The action that can be applied: ``forward`` clipped to ±1."""
        return torch.clamp(self(z), -1.0, 1.0)
