"""The levels of the hierarchy learn on frozen embeddings: P^H and flat predictors by rollouts,
P^M and P^L by filling the gaps between P^H's own predictions."""

import dataclasses

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.networks.hierarchy import Step, fill_gap, rollout
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.batches import stride_actions, window_indices
from hjepa_cli.core.training.losses import cosine_loss, rollout_loss


@dataclasses.dataclass(frozen=True)
class EmbeddedTrajectories:
    """Frozen embeddings [N, T, D] go with the applied actions ÷ force limit [N, T, *A]."""

    z: Tensor
    actions: Tensor

    def first(self, count: int) -> "EmbeddedTrajectories":
        """Return the first ``count`` trajectories."""
        return EmbeddedTrajectories(self.z[:count], self.actions[:count])

    def since(self, k: int) -> "EmbeddedTrajectories":
        """Return the trajectories from step k on."""
        return EmbeddedTrajectories(self.z[:, k:], self.actions[:, k:])

    def choose(self, count: int, generator: np.random.Generator) -> Tensor:
        """Draw the trajectories [B] of a batch: what a loss below draws first."""
        total = len(self.z)
        return torch.from_numpy(generator.choice(total, size=count, replace=count > total))

    def windows(
        self, count: int, frames: int, stride: int, generator: np.random.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Draw windows of ``frames`` embeddings, ``stride`` steps apart.

        Returns:
            Trajectory indices [B, 1], steps k [B, F] and stride actions [B, F − 1, stride, *A].
        """
        chosen, length = self.choose(count, generator), self.z.shape[1]
        k = torch.from_numpy(window_indices(length, frames, stride, generator, count))
        return chosen[:, None], k, stride_actions(self.actions[chosen], k, stride)

    def window_frames(self, stride: int) -> int:
        """Count the frames of the longest window at ``stride``."""
        return (self.z.shape[1] - 1) // stride + 1


def flat_loss(
    predictor: Predictor,
    data: EmbeddedTrajectories,
    stride: int,
    *,
    horizon_steps: int,
    trajectories: int,
    starts: int,
    generator: np.random.Generator,
) -> Tensor:
    """Return the cosine loss of rollouts in random windows (P^H, TS-JEPA of any depth).

    Args:
        predictor: one that takes ``stride`` control steps per call.
        horizon_steps: K_p, in control steps.
        trajectories: windows drawn, as long as the trajectories allow.
        starts: rollouts started per window, at frames drawn without replacement.
    """
    frames = data.window_frames(stride)
    rows, k, actions = data.windows(trajectories, frames, stride, generator)
    begin = np.sort(generator.choice(frames - 1, size=min(starts, frames - 1), replace=False))
    z = data.z[rows, k]
    horizon = max(horizon_steps // stride, 1)
    return rollout_loss(predictor, z, z, actions, torch.from_numpy(begin), horizon)


def medium_loss(
    medium: Step,
    high: Step,
    data: EmbeddedTrajectories,
    h: int,
    m: int,
    *,
    horizon_steps: int,
    trajectories: int,
    generator: np.random.Generator,
) -> Tensor:
    """Return the cosine loss of P^M inside the gaps of P^H's own rollouts."""
    left, right, actions, steps = high_gaps(
        high, data, h, horizon_steps=horizon_steps, trajectories=trajectories, generator=generator
    )
    filled = fill_gap(medium, left, right, split(actions, m))
    return cosine_loss(filled[:, 1:-1], interior(data, steps, h, m))


def low_loss(
    low: Step,
    medium: Step,
    high: Step,
    data: EmbeddedTrajectories,
    h: int,
    m: int,
    l: int,
    *,
    horizon_steps: int,
    trajectories: int,
    generator: np.random.Generator,
) -> Tensor:
    """Return the cosine loss of P^L inside the m-steps that P^M laid between P^H's waypoints."""
    left, right, actions, steps = high_gaps(
        high, data, h, horizon_steps=horizon_steps, trajectories=trajectories, generator=generator
    )
    by_medium = split(actions, m)
    with torch.no_grad():
        grid = fill_gap(medium, left, right, by_medium)
    rows, begin = steps
    begin = (begin[:, None] + m * torch.arange(h // m)).flatten()
    filled = fill_gap(
        low,
        grid[:, :-1].flatten(0, 1),
        grid[:, 1:].flatten(0, 1),
        split(by_medium.flatten(0, 1), l),
    )
    targets = interior(data, (rows.repeat_interleave(h // m), begin), m, l)
    return cosine_loss(filled[:, 1:-1], targets)


def high_gaps(
    high: Step,
    data: EmbeddedTrajectories,
    h: int,
    *,
    horizon_steps: int,
    trajectories: int,
    generator: np.random.Generator,
) -> tuple[Tensor, Tensor, Tensor, tuple[Tensor, Tensor]]:
    """Roll P^H out from random starts over K_p steps and cut the rollouts into gaps of h steps.

    No gradient reaches P^H.

    Returns:
        Left and right ends [G, D] (z̃ at a and a + h), actions [G, h, *A] of steps a … a + h − 1,
        and where that is: (trajectory index [G], step a [G]).
    """
    frames = min(max(horizon_steps // h, 1) + 1, data.window_frames(h))
    rows, k, actions = data.windows(trajectories, frames, h, generator)
    with torch.no_grad():
        waypoints = rollout(high, data.z[rows[:, 0], k[:, 0]], actions)
    trajectory = rows.expand_as(k[:, :-1]).flatten()
    return (
        waypoints[:, :-1].flatten(0, 1),
        waypoints[:, 1:].flatten(0, 1),
        actions.flatten(0, 1),
        (trajectory, k[:, :-1].flatten()),
    )


def interior(
    data: EmbeddedTrajectories, begin: tuple[Tensor, Tensor], gap: int, stride: int
) -> Tensor:
    """Return true embeddings inside gaps, at a + stride, …, a + gap − stride: [G, C − 1, D]."""
    rows, a = begin
    inside = a[:, None] + torch.arange(stride, gap, stride)
    return data.z[rows[:, None], inside]


def split(actions: Tensor, stride: int) -> Tensor:
    """Cut actions of gaps [G, steps, *A] into sub-strides [G, steps / stride, stride, *A]."""
    return actions.reshape(len(actions), -1, stride, *actions.shape[2:])
