"""Pictures that no device should send: empty ones, those of a camera that hangs, and torn ones.

Half of a torn picture shows another moment, or comes from elsewhere. To an encoder that is a motion
like others. A device knows better: between two pictures so much never changes.
"""

import math

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Bools, Pixels
from hjepa_cli.core.plants.corruptions import torn

LEAST_CONTRAST = 16  # grey levels between the brightest and the darkest value of a picture
CHANGED = 48  # grey levels that a pixel changes by at least: noise and flicker do it by less


def changed(frames: Pixels) -> NDArray[np.float64]:
    """Return the share of pixels that changed before the newest of frames [m, κ, H, W, C]: [m]."""
    after, before = frames[:, -1].astype(np.int16), frames[:, -2]
    by = np.abs((after - before).mean(axis=-1))
    return np.asarray((by >= CHANGED).mean(axis=(1, 2)))


def most_changed(frames: Pixels) -> float:
    """Return the largest share of pixels that a motion changes, by good frames [m, κ, H, W, C].

    It lies between the most that they change and the least that they would if they were torn, the
    same factor from both. Where tearing changes no more than motion nothing is too much.
    """
    pixels = math.prod(frames.shape[2:4])
    moved = max(float(changed(frames).max()), 1 / pixels)
    spoilt = torn(frames.astype(np.float32), 1.0, np.random.default_rng(0))
    least = float(changed(spoilt.astype(np.uint8)).min())
    return math.sqrt(moved * least) if least > moved else math.inf


def empty(pictures: Pixels) -> Bools:
    """Return which pictures [m, H, W, C] show nothing: bool [m]."""
    return np.asarray(np.ptp(pictures, axis=(1, 2, 3)) < LEAST_CONTRAST)


def spoilt(frames: Pixels, most: float) -> Bools:
    """Return which packets of frames [m, κ, H, W, C] are not worth sending: bool [m].

    Args:
        frames: uint8, the newest last.
        most: what :func:`most_changed` returns.
    """
    newest = frames[:, -1]
    frozen = (frames == newest[:, None]).all(axis=(1, 2, 3, 4))
    return np.asarray(empty(newest) | frozen | (changed(frames) > most))
