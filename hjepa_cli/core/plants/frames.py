"""Camera frames: their size, and those that a device remembers for its network."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

HEIGHT_PX, WIDTH_PX, CHANNELS = 64, 128, 3
FRAME_SHAPE = (HEIGHT_PX, WIDTH_PX, CHANNELS)
LONGEST = 4  # frames, κ; a device keeps so many


def frames_seen(k: ArrayLike, frames: int) -> NDArray[np.int64]:
    """The stored frames that a device looks at in step k: int64 [*K, κ], the oldest first.

    Frame 0 is the one before k = 0, where a device is switched on; what would lie before it is a
    copy of it.

    Args:
        k: steps [*K], 0 or later.
        frames: κ, of which the last one is that of step k itself.
    """
    return np.maximum(np.asarray(k)[..., None] + np.arange(2 - frames, 2), 0)
