"""The baselines on raw frames: camera frames in, forces out, no prediction (paper §IV).

``supervised`` is the context encoder with the semantic actor behind it, trained end to end on the
teacher's labels. ``autoencoder`` learns to reconstruct what the encoder sees; a second network of
the supervised kind acts on the reconstructions alone.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.decoder import Decoder
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.read_frames import read_frames
from hjepa_cli.core.training.batches import TrajectoryBatch


class Imitation:
    """The actor's force against the teacher's, mean squared, all the way back to the frames.

    Args:
        networks: as for :func:`read_frames`, and ``actor``.
        trained: those of them that learn; the others stay as they are.
    """

    def __init__(
        self, networks: nn.ModuleDict, trained: tuple[str, ...], device: torch.device
    ) -> None:
        self.networks, self.trained, self.device = networks.to(device), trained, device

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """The scalar term ``force`` of a batch with labels, in units of the force limit squared."""
        assert batch.labels is not None
        frames, labels = batch.frames.to(self.device), batch.labels.to(self.device)
        forces = self.networks["actor"](read_frames(self.networks, frames))
        return {"force": F.mse_loss(forces.float(), labels)}

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """The only term."""
        return terms["force"]

    def train(self) -> None:
        """Put what learns into training mode."""
        for name, network in self.networks.items():
            network.train(name in self.trained).requires_grad_(name in self.trained)

    def after_step(self) -> None:
        """Nothing follows a step."""

    def parts(self) -> dict[str, nn.Module]:
        """All networks: those that stay as they are came out of an earlier loop."""
        return {"networks": self.networks}

    def parameters(self) -> Iterator[nn.Parameter]:
        """Everything the optimiser trains."""
        for name in self.trained:
            yield from self.networks[name].parameters()


class Reconstruction:
    """Encoder and decoder: the standardised input of the encoder against its reconstruction.

    Args:
        networks: ``encoder`` and ``decoder``, and others that wait.
    """

    def __init__(self, networks: nn.ModuleDict, device: torch.device) -> None:
        self.networks, self.device = networks.to(device), device
        encoder, decoder = networks["encoder"], networks["decoder"]
        assert isinstance(encoder, Encoder) and isinstance(decoder, Decoder)
        self.encoder, self.decoder = encoder, decoder

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """The scalar term ``reconstruction``: mean squared error in each channel's variance."""
        return {"reconstruction": self.error(batch.frames)}

    def error(self, frames: Tensor) -> Tensor:
        """Mean squared error of frames [N, κ, 64, 128, 3]; 1: no better than the mean."""
        inputs = self.encoder.inputs(frames.to(self.device))
        painted = self.decoder(self.encoder.embed(inputs))
        return F.mse_loss(painted, self.decoder.standardise(inputs))

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """The only term."""
        return terms["reconstruction"]

    def train(self) -> None:
        """Put both into training mode."""
        self.encoder.train()
        self.decoder.train()

    def after_step(self) -> None:
        """Nothing follows a step."""

    def parts(self) -> dict[str, nn.Module]:
        """All networks."""
        return {"networks": self.networks}

    def parameters(self) -> Iterator[nn.Parameter]:
        """Everything the optimiser trains."""
        yield from self.encoder.parameters()
        yield from self.decoder.parameters()
