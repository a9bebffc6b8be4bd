"""The semantic actor: embedding → forces, trained on the teacher's labels (paper §III-A)."""

import math

import torch
from torch import Tensor, nn


class Actor(nn.Module):
    """MLP D-1024-256-1 with ReLU and dropout; ``forward`` is force ÷ force limit, unclipped.

    With ``action_shape`` ``(m,)`` its last layer has m outputs.
    """

    def __init__(
        self, embedding: int, hidden: int, dropout: float, action_shape: tuple[int, ...] = ()
    ) -> None:
        super().__init__()
        self.action_shape = action_shape
        self.layers = nn.Sequential(
            nn.Linear(embedding, hidden),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, 256),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(256, math.prod(action_shape)),
        )

    def forward(self, z: Tensor) -> Tensor:
        """Embeddings [..., D] → actions [..., *A] in units of the force limit."""
        action: Tensor = self.layers(z).reshape(*z.shape[:-1], *self.action_shape)
        return action

    def act(self, z: Tensor) -> Tensor:
        """The action that can be applied: ``forward`` clipped to ±1."""
        return torch.clamp(self(z), -1.0, 1.0)
