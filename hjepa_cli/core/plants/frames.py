"""Camera frames have a usual size, and a device remembers some of them for its network."""

import json
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.config.checks import FARTHEST_BACK
from hjepa_cli.core.arrays import Floats, Integers, Pixels, finite

HEIGHT_PX, WIDTH_PX, CHANNELS = 64, 128, 3
FRAME_SHAPE = (HEIGHT_PX, WIDTH_PX, CHANNELS)
LONGEST = FARTHEST_BACK + 1  # frames that a device keeps, from which its network sees κ


class Camera(Protocol):
    """A camera sees a system from the side."""

    def render(self, states: ArrayLike) -> Pixels:
        """Return RGB frames ``[n, 64, 128, 3]`` of states ``[n, S]``.

        Raises:
            NumericalError: a state is not finite.
        """

    def manifest(self) -> dict[str, Any]:
        """Return all that fixes a picture besides the state, plain; ``version`` among it."""

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return a state ``[S]`` as lines through points ``[k, 2]`` (column, row) of its picture.

        Drawn over a picture to show what a controller believes; the first line is the axis whose
        lean matters.
        """


def same_camera(recorded: object, camera: Camera) -> bool:
    """Say whether a file's pictures are of a camera, by the manifest that it holds."""
    return bool(recorded == json.loads(json.dumps(camera.manifest())))


def frame_bits(frame_shape: tuple[int, int, int]) -> int:
    """Return the bits of an uncompressed frame of (H, W, C) values."""
    return 8 * math.prod(frame_shape)


def frames_seen(k: ArrayLike, frames: int, gap: int = 1) -> Integers:
    """Return the stored frames that a device looks at in step k: int64 [*K, κ], the oldest first.

    They are ``gap`` steps apart; the last of the κ is that of step k [*K] itself. Frame 0 is the
    one before k = 0, where a device is switched on; what would lie before it is a copy of it.
    """
    return np.maximum(np.asarray(k)[..., None] + 2 + frames_back(frames, gap), 0)


def remembers_from(frames: int, gap: int = 1) -> int:
    """Return the first step k in which a device has seen as many frames, and needs no copies.

    What is fitted to embeddings begins there: those of copies are of their own kind.
    """
    return max(gap * (frames - 1) - 1, 0)


def frames_back(frames: int, gap: int = 1) -> Integers:
    """Return the indices [κ] of what a network sees among the last frames of a device."""
    return gap * np.arange(1 - frames, 1) - 1


def frames_of(camera: Camera, states: ArrayLike, batch: int | None = None) -> Pixels:
    """Render states [N, …, S] into frames uint8 [N, …, H, W, C]: 64 × 128 × 3, or ``frame_shape``.

    ``batch`` of the N are rendered at a time, which bounds the memory; all by default. A camera
    that has ``film`` is told which states [N, κ, S] belong to one packet.

    Raises:
        NumericalError: a state is not finite.
    """
    states = finite(states, "states")
    shape = getattr(camera, "frame_shape", FRAME_SHAPE)
    frames = np.empty((*states.shape[:-1], *shape), np.uint8)
    film = getattr(camera, "film", None) if states.ndim == 3 else None
    for start in range(0, len(states), batch or max(len(states), 1)):
        part = slice(start, start + (batch or len(states)))
        if film is not None:
            frames[part] = film(states[part])
            continue
        frames[part].reshape(-1, *shape)[:] = camera.render(
            states[part].reshape(-1, states.shape[-1])
        )
    return frames
