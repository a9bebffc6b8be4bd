"""Training batches are whole sub-sampled trajectories: one encoding of a frame serves as start,
target and inverse-dynamics sample at once."""

import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.schema import Look
from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.plants.frames import frames_seen

Labels = Callable[[Tensor, Tensor, Integers], Tensor]
"""It maps trajectories [B, 1], steps k [B, F] and shifts [B, 1] in px to the teacher's actions ÷
force limit [B, F, *A] in the states that the shifted pictures show."""


@dataclasses.dataclass(frozen=True)
class TrajectoryBatch:
    """A batch has B windows of F frames, ``stride`` control steps apart.

    Attributes:
        frames: uint8 [B · F, κ, H, W, 3], the current one last, of what a network sees that learns.
        actions: applied actions ÷ force limit [B, F − 1, stride, *A] between the frames.
        drawn: the windows' names, for messages.
        labels: the teacher's actions there ÷ force limit [B · F, *A], if the windows have any.
        worse: what a network shall see instead of ``frames``.
        targets: frames of which targets are made; ``frames`` unless they lie elsewhere.
        sources: which of its κ pictures each is [B · F, κ]; others than itself where a device has
            been switched on too recently to remember κ, and earlier ones are copies.
    """

    frames: Tensor
    actions: Tensor
    drawn: str = ""
    labels: Tensor | None = None
    worse: Tensor | None = None
    targets: Tensor | None = None
    sources: Tensor | None = None

    @property
    def aimed_at(self) -> Tensor:
        """Return the frames, as they were taken, of which targets are made."""
        return self.frames if self.targets is None else self.targets

    @property
    def seen(self) -> Tensor:
        """Return what a network sees that learns."""
        return self.frames if self.worse is None else self.worse

    def shown(self, worse: Tensor) -> "TrajectoryBatch":
        """Return the batch with ``worse`` pictures; a copy of one is worse in the same way."""
        if self.sources is not None:
            worse = worse[torch.arange(len(worse))[:, None], self.sources]
        return dataclasses.replace(self, worse=worse)


def frames_that_fit(steps: int, frames: int, stride: int) -> int:
    """Return how many of a window's frames fit into trajectories of so many steps."""
    return min(frames, (steps - 1) // stride + 1)


def window_indices(
    length: int, frames: int, stride: int, generator: np.random.Generator, count: int
) -> Integers:
    """Draw steps k [count, frames] of windows inside 0 … length − 1."""
    last_start = length - 1 - (frames - 1) * stride
    starts = generator.integers(0, last_start + 1, size=count)
    return starts[:, None] + stride * np.arange(frames)[None, :]


def stride_actions(actions: Tensor, steps: Tensor, stride: int) -> Tensor:
    """Cut actions [B, T, *A] at frame steps [B, F] into strides [B, F − 1, stride, *A].

    Row f holds u_k … u_{k + stride − 1} for k = steps[f], the actions that lead from frame f to
    frame f + 1.
    """
    offsets = steps[:, :-1, None] + torch.arange(stride)
    batch = torch.arange(len(actions))[:, None, None]
    return actions[batch, offsets]


class FrameWindows:
    """It draws :class:`TrajectoryBatch` es from rendered trajectories.

    Args:
        frames: uint8 [N, T + 1, H, W, 3]; index 0 is the frame before k = 0.
        actions: applied actions ÷ force limit [N, T, *A].
        window_frames, stride: F and the control steps between frames.
        mirror: flip half of the windows left to right and their actions with them, which is exact
            physics and doubles the data; ``mirrored_actions`` are the factors of that.
        shift_px: move every window sideways by −shift_px … shift_px whole pixels, the same for all
            its frames: exact physics as well, as long as nothing leaves the picture.
        labels: the teacher in shifted pictures, where that is wanted.
        look: how many steps back the κ frames lie, of which a device remembers those it has seen.
        target_look: how many steps back the frames of targets lie, if that is elsewhere.
    """

    def __init__(
        self,
        frames: Tensor,
        actions: Tensor,
        *,
        window_frames: int,
        stride: int,
        mirror: bool,
        shift_px: int = 0,
        mirrored_actions: float | tuple[float, ...] = -1.0,
        labels: Labels | None = None,
        look: Look = (1, 0),
        target_look: Look | None = None,
    ) -> None:
        self.frames, self.actions = frames, actions
        self.steps = actions.shape[1]
        self.window_frames = frames_that_fit(self.steps, window_frames, stride)
        self.stride, self.mirror, self.shift_px = stride, mirror, shift_px
        self.mirrored_actions = torch.tensor(mirrored_actions)
        self.labels, self.look = labels, look
        self.target_look = look if target_look is None else target_look

    def draw(
        self, count: int, generator: np.random.Generator, share: slice = slice(None)
    ) -> TrajectoryBatch:
        """Draw ``count`` windows of trajectories, without replacement where they suffice.

        Of these the windows ``share`` are cut out: what is drawn does not depend on it.
        """
        total = len(self.frames)
        chosen = generator.choice(total, size=count, replace=count > total)
        steps = window_indices(self.steps, self.window_frames, self.stride, generator, count)
        trajectories = torch.from_numpy(chosen[share])
        k = torch.from_numpy(steps[share])
        actions = stride_actions(self.actions[trajectories], k, self.stride)
        rows = trajectories[:, None]
        flipped, shifts = torch.zeros(len(k), dtype=torch.bool), np.zeros(len(k), dtype=np.int64)
        if self.mirror:
            flipped = torch.from_numpy((generator.random(count) < 0.5)[share])
            actions[flipped] *= self.mirrored_actions
        if self.shift_px:
            shifts = generator.integers(-self.shift_px, self.shift_px + 1, size=count)[share]

        def taken(seen: Tensor) -> Tensor:
            frames = self.frames[rows[..., None], seen]
            frames[flipped] = frames[flipped].flip(-2)
            for window, shift_px in zip(frames, shifts, strict=True):
                if shift_px:
                    window.copy_(shift_sideways(window, int(shift_px)))
            return frames.flatten(0, 1)

        seen, aimed_at = (
            torch.from_numpy(frames_seen(k.numpy(), look)) for look in (self.look, self.target_look)
        )
        copies = (seen == seen[..., :1]).sum(dim=-1, keepdim=True)
        sources = torch.arange(len(self.look)).maximum(copies - 1)
        labels = None
        if self.labels is not None:  # a mirror image moved right is that of one moved left
            before = np.where(flipped.numpy(), -shifts, shifts)
            labels = self.labels(rows, k, before[:, None])
            labels[flipped] *= self.mirrored_actions
        windows = (f"{row} from k = {k[0]}" for row, k in zip(chosen, steps, strict=True))
        return TrajectoryBatch(
            taken(seen),
            actions,
            f"windows of trajectories {', '.join(windows)}",
            None if labels is None else labels.flatten(0, 1),
            targets=taken(aimed_at) if self.target_look != self.look else None,
            sources=sources.flatten(0, 1),
        )


def shift_sideways(frames: Tensor, shift_px: int) -> Tensor:
    """Move frames [..., H, W, 3] right by ``shift_px`` (left: negative), repeating edge columns.

    The scene is the same all along the track, so this is what the camera would have seen.
    """
    width = frames.shape[-2]
    columns = torch.clamp(torch.arange(width) - shift_px, 0, width - 1)
    return frames.index_select(-2, columns)
