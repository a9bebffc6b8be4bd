"""The joint-embedding objective trains context encoder and companion P^H on a moving target."""

import copy
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.batches import TrajectoryBatch
from hjepa_cli.core.training.losses import InverseDynamics, rollout_loss
from hjepa_cli.core.training.regularisers import REGULARISERS, Regulariser


class EmaTarget:
    """θ̄ ← η θ̄ + (1 − η) θ moves a target, equal at the start, without gradient; buffers follow.

    The target stays in the online network's mode at construction, training: it normalises by the
    statistics of the batch, as the context encoder does on the same frames (ours). Its running
    statistics are averaged all the same, so that it can be evaluated too; integers are copied.
    """

    def __init__(self, online: nn.Module, decay: float) -> None:
        self.decay = decay
        self.module = copy.deepcopy(online).requires_grad_(False)

    @torch.no_grad()
    def update(self, online: nn.Module) -> None:
        """Move the target one step towards ``online``."""
        mine, theirs = ([*m.parameters(), *m.buffers()] for m in (self.module, online))
        for mean, value in zip(mine, theirs, strict=True):
            if mean.is_floating_point():
                mean.lerp_(value, 1.0 - self.decay)
            else:
                mean.copy_(value)


class Jepa:
    """Ψ_θ and P^H are trained together (paper eqs. 5-7), with an optional auxiliary task.

    Args:
        encoder: the context encoder; the target starts as its copy.
        predictor: companion P^H, one stride per call.
        ema_decay: η.
        inverse_dynamics: weight of the inverse-dynamics loss; 0 leaves it out.
        rollout_strides: length of the training rollouts in strides.
        forces, mirror: number and signs of a device's forces, for the auxiliary task.
        regulariser: ``"none"``, or a name in ``REGULARISERS``; with its weight and seed.
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
        """Return scalar loss terms of a batch, before weighting, under the names of ``weights``.

        Frames are [B · F, κ, H, W, 3], actions [B, F − 1, h, *A].
        """
        frames, actions = batch.frames.to(self.device), batch.actions.to(self.device)
        windows, strides = actions.shape[0], actions.shape[1]
        z = self.encoder(frames).unflatten(0, (windows, strides + 1))
        with torch.no_grad():
            targets = self.target.module(frames).unflatten(0, (windows, strides + 1))
        starts = torch.arange(strides, device=self.device)
        rolled = rollout_loss(self.predictor, z, targets, actions, starts, self.rollout_strides)
        terms = {"prediction": rolled}
        if self.inverse is not None:
            terms["inverse_dynamics"] = self.inverse.loss(
                z[:, :-1].flatten(0, 1), z[:, 1:].flatten(0, 1), actions.mean(2).flatten(0, 1)
            )
        for name, regularise in self.regularise.items():
            terms[name] = regularise(z.flatten(0, 1))
        return terms

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Return the weighted sum; a term without a weight, or the reverse, is a bug."""
        assert terms.keys() == self.weights.keys(), (sorted(terms), sorted(self.weights))
        return torch.stack([self.weights[name] * term for name, term in terms.items()]).sum()

    def train(self) -> None:
        """Put the encoder into training mode; the others never leave it."""
        self.encoder.train()

    def after_step(self) -> None:
        """Move the target encoder after an optimiser step."""
        self.target.update(self.encoder)

    def parts(self) -> dict[str, nn.Module]:
        """Return everything that training changes, the target included, by name."""
        parts = {"encoder": self.encoder, "companion": self.predictor, "target": self.target.module}
        drawing = {name: one for name, one in self.regularise.items() if isinstance(one, nn.Module)}
        return parts | drawing | ({} if self.inverse is None else {"inverse": self.inverse})

    def parameters(self) -> Iterator[nn.Parameter]:
        """Yield everything the optimiser trains (the target is not among it)."""
        for module in (self.encoder, self.predictor, self.inverse):
            if module is not None:
                yield from module.parameters()
