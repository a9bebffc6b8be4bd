"""Training reads rendered trajectories from memory."""

import dataclasses

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.config.schema import Look
from hjepa_cli.core.plants.frames import WIDTH_PX, frames_seen
from hjepa_cli.core.plants.system import System, Teacher
from hjepa_cli.core.training.batches import Labels


@dataclasses.dataclass(frozen=True)
class RenderedSplit:
    """It holds one split in memory, as training reads it.

    Attributes:
        frames: uint8 [N, T + 1, H, W, 3]; index 0 is the frame before k = 0.
        states: float32 [N, T, S] at k = 0 … T − 1.
        actions: applied actions ÷ force limit [N, T, *A].
        labels: teacher's actions ÷ force limit [N, T, *A].
    """

    frames: Tensor
    states: Tensor
    actions: Tensor
    labels: Tensor

    def seen(self, every: int, look: Look = (1, 0), *, mirrored: bool = False) -> Tensor:
        """Return what a device looks at in k = 0, ``every``, …: uint8 [N · K, κ, H, W, 3]."""
        steps = np.arange(0, self.frames.shape[1] - 1, every)
        seen = self.frames[:, torch.from_numpy(frames_seen(steps, look))]
        return (seen.flip(-2) if mirrored else seen).flatten(0, 1)

    def __getitem__(self, rows: slice) -> "RenderedSplit":
        """Return some trajectories, without a copy."""
        arrays = (self.frames, self.states, self.actions, self.labels)
        return RenderedSplit(*(values[rows] for values in arrays))

    def states_at(self, every: int) -> Tensor:
        """Return the states [N · K, S] that go with :meth:`seen`."""
        return self.states[:, ::every].flatten(0, 1)

    def labels_at(self, every: int) -> Tensor:
        """Return the labels [N · K, *A] that go with :meth:`seen`."""
        return self.labels[:, ::every].flatten(0, 1)


def labels_of(split: RenderedSplit, kind: System, act: Teacher) -> Labels:
    """Return a law's actions on a split: as recorded, or asked anew where pictures move.

    The returned function raises a UsageError for a plant whose pictures cannot be moved.
    """

    def labels(trajectories: Tensor, k: Tensor, shifts_px: NDArray[np.int64]) -> Tensor:
        if not shifts_px.any():
            return split.labels[trajectories, k]
        states = split.states[trajectories, k].numpy().astype(float)
        own_px = shifts_px * (WIDTH_PX / split.frames.shape[-2])  # in the camera's own pictures
        forces_n = act(kind.sideways(states, own_px))
        return torch.from_numpy(forces_n / kind.force_limit_n).to(split.labels.dtype)

    return labels


def standardisation_sample(frames: Tensor, look: Look, count: int = 512) -> Tensor:
    """Return evenly spaced inputs [≤ ``count``, κ, H, W, 3] of frames [N, T + 1, H, W, 3]."""
    length = frames.shape[1]
    total = len(frames) * length
    current = np.linspace(1, total - 1, min(count, total - 1)).astype(int)
    rows, stored = np.divmod(current[current % length != 0], length)  # 0 has no predecessor
    seen = torch.from_numpy(frames_seen(stored - 1, look))
    return frames[torch.from_numpy(rows)[:, None], seen]
