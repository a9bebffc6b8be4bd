"""Camera frames have a usual size, and a device remembers some of them for its network."""

import json
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.config.checks import FARTHEST_BACK
from hjepa_cli.config.schema import Look
from hjepa_cli.core.arrays import Floats, Integers, Pixels, finite

HEIGHT_PX, WIDTH_PX, CHANNELS = 64, 128, 3
FRAME_SHAPE = (HEIGHT_PX, WIDTH_PX, CHANNELS)
EVERY = tuple(range(FARTHEST_BACK, -1, -1))  # what a device remembers, as a network would see it
LONGEST = len(EVERY)


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


def frames_seen(k: ArrayLike, look: Look) -> Integers:
    """Return the stored frames that a device looks at in step k [*K]: int64 [*K, κ].

    Frame 0 is the one before k = 0, where a device is switched on; what would lie before it is a
    copy of it.
    """
    back: Integers = np.array(look)
    return np.maximum(np.asarray(k)[..., None] + 1 - back, 0)


def remembers_from(look: Look) -> int:
    """Return the first step k in which a device has seen as many frames, and needs no copies.

    What is fitted to embeddings begins there: those of copies are of their own kind.
    """
    return max(look[0] - 1, 0)


def frames_back(look: Look) -> Integers:
    """Return the indices [κ] of what a network sees among the last frames of a device."""
    return -1 - np.array(look)


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
