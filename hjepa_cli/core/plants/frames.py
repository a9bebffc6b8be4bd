"""Camera frames have a usual size, and a device remembers some of them for its network."""

import math

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Integers, Pixels, finite
from hjepa_cli.core.plants.system import Camera

HEIGHT_PX, WIDTH_PX, CHANNELS = 64, 128, 3
FRAME_SHAPE = (HEIGHT_PX, WIDTH_PX, CHANNELS)
LONGEST = 4  # frames, κ; a device keeps so many


def frame_bits(frame_shape: tuple[int, int, int]) -> int:
    """Return the bits of an uncompressed frame of (H, W, C) values."""
    return 8 * math.prod(frame_shape)


def frames_seen(k: ArrayLike, frames: int) -> Integers:
    """Return the stored frames that a device looks at in step k: int64 [*K, κ], the oldest first.

    The last of the κ is that of step k [*K] itself. Frame 0 is the one before k = 0, where a
    device is switched on; what would lie before it is a copy of it.
    """
    return np.maximum(np.asarray(k)[..., None] + np.arange(2 - frames, 2), 0)


def frames_of(camera: Camera, states: ArrayLike, batch: int | None = None) -> Pixels:
    """Render states [N, …, S] into frames uint8 [N, …, H, W, C]: 64 × 128 × 3, or ``frame_shape``.

    ``batch`` of the N are rendered at a time, which bounds the memory; all by default.

    Raises:
        NumericalError: a state is not finite.
    """
    states = finite(states, "states")
    shape = getattr(camera, "frame_shape", FRAME_SHAPE)
    frames = np.empty((*states.shape[:-1], *shape), np.uint8)
    for start in range(0, len(states), batch or max(len(states), 1)):
        part = slice(start, start + (batch or len(states)))
        frames[part].reshape(-1, *shape)[:] = camera.render(
            states[part].reshape(-1, states.shape[-1])
        )
    return frames
