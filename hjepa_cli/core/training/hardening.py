"""An encoder that knows clean pictures learns to see the same in worse ones, and further apart.

It comes last, when actor and levels are there. A JEPA that is trained on worse pictures is less
steady in clean ones too, and so is a hardened encoder: what learns from their embeddings rolls them
out less far (docs/LOG.md). So all of it learns from the encoder of clean pictures. That one is the
teacher here: the encoder goes on from it, and its embedding of a worse picture is to be the
teacher's of the clean one. The teacher's frames lie close together, which makes embeddings that
levels predict well; those of the encoder lie further apart from here on, where noise moves them
less than a pole that falls.
"""

import copy

import torch
from torch import Tensor, nn

from hjepa_cli.config.schema import Look
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.training.batches import TrajectoryBatch
from hjepa_cli.core.training.frame_policies import Phase
from hjepa_cli.core.training.losses import cosine_loss


class Hardening(Phase):
    """It trains the ``encoder`` of ``networks`` on worse pictures; the others stay as they are."""

    def __init__(self, networks: nn.ModuleDict, device: torch.device) -> None:
        teacher = copy.deepcopy(networks["encoder"])
        super().__init__(nn.ModuleDict({**networks, "teacher": teacher}), ("encoder",), device)

    def look_elsewhere(self, look: Look, sample: Tensor) -> None:
        """Let the encoder see frames of another look, and the teacher those that it knows.

        The encoder goes on from what it knows nevertheless: standardised by a ``sample`` of its
        frames [N, κ, H, W, C], their differences are as large as before.
        """
        encoder = self.networks["encoder"]
        assert isinstance(encoder, Encoder)
        encoder.look = look
        encoder.fit_standardisation(sample.to(self.device))

    def train(self) -> None:
        """Choose what learns; batch norms keep the statistics of clean pictures."""
        super().train()
        self.networks.eval()

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """Return 1 − cos(Ψ(worse), Ψ_teacher(clean)) of frames [B · F, κ, H, W, C]."""
        with torch.no_grad():
            target = self.networks["teacher"](batch.aimed_at.to(self.device))
        z = self.networks["encoder"](batch.seen.to(self.device))
        return {"hardening": cosine_loss(z, target)}
