"""The joint-embedding objective: context encoder, EMA target, companion P^H, inverse dynamics."""

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.batches import TrajectoryBatch
from hjepa_cli.core.training.ema import EmaTarget
from hjepa_cli.core.training.losses import InverseDynamics, rollout_loss
from hjepa_cli.core.training.regularisers import REGULARISERS, Regulariser


class Jepa:
    """Ψ_θ and P^H trained together (paper eqs. 5-7), with an optional auxiliary task.

    Args:
        encoder: the context encoder; the target starts as its copy.
        predictor: companion P^H, one stride per call.
        ema_decay: η.
        inverse_dynamics: weight of the inverse-dynamics loss; 0 leaves it out.
        regulariser: ``"none"``, or one of :data:`~hjepa_cli.core.training.regularisers.REGULARISERS`.
        regulariser_weight: of its term.
        seed: of what it draws.
        rollout_strides: length of the training rollouts in strides.
        forces: how many drive a device.
        mirror: as for :class:`Predictor`, of the auxiliary task.
    """

    def __init__(
        self,
        encoder: Encoder,
        predictor: Predictor,
        *,
        ema_decay: float,
        inverse_dynamics: float,
        rollout_strides: int,
        device: torch.device,
        forces: int = 1,
        mirror: Sequence[float] | None = None,
        regulariser: str = "none",
        regulariser_weight: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.encoder, self.predictor = encoder.to(device), predictor.to(device)
        self.target = EmaTarget(encoder, ema_decay)
        self.rollout_strides = rollout_strides
        self.weights = {"prediction": 1.0}
        self.inverse: InverseDynamics | None = None
        if inverse_dynamics > 0.0:
            self.weights["inverse_dynamics"] = inverse_dynamics
            self.inverse = InverseDynamics(encoder.embedding, forces=forces, mirror=mirror)
            self.inverse.to(device)
        self.regularise: dict[str, Regulariser] = {}
        if regulariser != "none":
            self.weights[regulariser] = regulariser_weight
            self.regularise[regulariser] = REGULARISERS[regulariser](seed)
        self.device = device

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """Named scalar loss terms of one batch, before weighting, under the names of ``weights``.

        Args:
            batch: frames [B · F, 2, H, W, 3] and actions [B, F − 1, h, *A], moved to the device.
        """
        frames, actions = batch.frames.to(self.device), batch.actions.to(self.device)
        windows, strides = actions.shape[0], actions.shape[1]
        z = self.encoder(frames).unflatten(0, (windows, strides + 1))
        with torch.no_grad():
            targets = self.target.module(frames).unflatten(0, (windows, strides + 1))
        starts = torch.arange(strides, device=self.device)
        terms = {
            "prediction": rollout_loss(
                self.predictor, z, targets, actions, starts, self.rollout_strides
            )
        }
        if self.inverse is not None:
            terms["inverse_dynamics"] = self.inverse.loss(
                z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1), actions.mean(2).flatten(0, 1)
            )
        for name, regularise in self.regularise.items():
            terms[name] = regularise(z.flatten(0, 1))
        return terms

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Weighted sum; a term without a weight, or a weight without a term, is a bug."""
        assert terms.keys() == self.weights.keys(), (sorted(terms), sorted(self.weights))
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()

    def train(self) -> None:
        """Put the encoder into training mode; the others never leave it."""
        self.encoder.train()

    def after_step(self) -> None:
        """Move the target encoder after an optimiser step."""
        self.target.update(self.encoder)

    def parts(self) -> dict[str, nn.Module]:
        """Everything that training changes, the target included, by name."""
        parts = {"encoder": self.encoder, "companion": self.predictor, "target": self.target.module}
        drawing = {name: one for name, one in self.regularise.items() if isinstance(one, nn.Module)}
        return parts | drawing | ({} if self.inverse is None else {"inverse": self.inverse})

    def parameters(self) -> Iterator[nn.Parameter]:
        """Everything the optimiser trains (the target is not among it)."""
        for module in (self.encoder, self.predictor, self.inverse):
            if module is not None:
                yield from module.parameters()
