"""The semantic actor: embedding → force, trained on the teacher's labels (paper §III-A)."""

import torch
from torch import Tensor, nn


class Actor(nn.Module):
    """MLP D-1024-256-1 with ReLU and dropout; ``forward`` is force ÷ force limit, unclipped."""

    def __init__(self, embedding: int, hidden: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(embedding, hidden),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(hidden, 256),
            nn.ReLU(),
            nn.Dropout(dropout),
            nn.Linear(256, 1),
        )

    def forward(self, z: Tensor) -> Tensor:
        """Embeddings [..., D] → action [...] in units of the force limit."""
        action: Tensor = self.layers(z).squeeze(-1)
        return action

    def act(self, z: Tensor) -> Tensor:
        """The action that can be applied: ``forward`` clipped to ±1."""
        return torch.clamp(self(z), -1.0, 1.0)
