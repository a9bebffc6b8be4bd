"""The baselines on raw frames turn them into forces without any prediction (paper §IV).

``supervised`` is the context encoder with the semantic actor behind it, trained end to end on the
teacher's labels. ``autoencoder`` learns to reconstruct what the encoder sees; a second network of
the supervised kind acts on the reconstructions alone.
"""

from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.decoder import Decoder, read_frames
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.training.batches import TrajectoryBatch


class Phase:
    """The sum of terms is minimised by some networks, ``trained``; the others stay as they are."""

    def __init__(
        self, networks: nn.ModuleDict, trained: tuple[str, ...], device: torch.device
    ) -> None:
        self.networks, self.trained, self.device = networks.to(device), trained, device

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Return the sum of terms."""
        return torch.stack([*terms.values()]).sum()

    def train(self) -> None:
        """Put what learns into training mode."""
        for name, network in self.networks.items():
            network.train(name in self.trained).requires_grad_(name in self.trained)

    def after_step(self) -> None:
        """Do nothing after a step."""

    def parts(self) -> dict[str, nn.Module]:
        """Return all networks: those that stay as they are came out of an earlier phase."""
        return {"networks": self.networks}

    def parameters(self) -> Iterator[nn.Parameter]:
        """Yield everything the optimiser trains."""
        for name in self.trained:
            yield from self.networks[name].parameters()


class Imitation(Phase):
    """It compares the actor's force with the teacher's, squared, all the way back to the frames."""

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """Return the term ``force`` of a batch with labels, in units of the force limit squared."""
        assert batch.labels is not None
        frames, labels = batch.seen.to(self.device), batch.labels.to(self.device)
        forces = self.networks["actor"](read_frames(self.networks, frames))
        return {"force": F.mse_loss(forces.float(), labels)}


class Reconstruction(Phase):
    """It compares the encoder's standardised input with what the decoder makes of embeddings."""

    def __init__(self, networks: nn.ModuleDict, device: torch.device) -> None:
        super().__init__(networks, ("encoder", "decoder"), device)

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """Return the term ``reconstruction``: mean squared error in each channel's variance."""
        return {"reconstruction": self.error(batch.frames, batch.worse)}

    def error(self, frames: Tensor, worse: Tensor | None = None) -> Tensor:
        """Return the mean squared error of frames [N, κ, 64, 128, 3]; the mean frame's is 1.

        They are reconstructed from ``worse`` ones, where there are any.
        """
        encoder, decoder = self.networks["encoder"], self.networks["decoder"]
        assert isinstance(encoder, Encoder) and isinstance(decoder, Decoder)
        inputs = encoder.inputs(frames.to(self.device))
        seen = inputs if worse is None else encoder.inputs(worse.to(self.device))
        return F.mse_loss(decoder(encoder.embed(seen)), decoder.standardise(inputs))
