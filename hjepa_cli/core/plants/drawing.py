"""Anti-aliased rods are enough to draw the camera's picture of a mechanical system.

The cart-pole's own camera computes exact areas; this one is for every other system. What counts is
the same: a picture must change with the smallest motion, or the encoder sees no velocity.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX

Colour = tuple[int, int, int]

BACKGROUND: Colour = (255, 255, 255)
TOGETHER = 32  # frames drawn at a time: the work stays in the cache


@dataclasses.dataclass(frozen=True)
class Rod:
    """A straight rod has round ends.

    ``start`` and ``end`` of its axis are (column, row) in pixels ``[n, 2]``; pixel i spans
    i … i + 1.
    """

    start: Floats
    end: Floats
    width_px: float
    colour: Colour


def draw(rods: Sequence[Rod]) -> Pixels:
    """Draw rods one over the other into frames ``[n, 64, 128, 3]``.

    A pixel's share of a rod is ½ + (half its width − distance to its axis), within 0 … 1: the area
    of a straight edge through the pixel, up to a small error where it runs diagonally.
    """
    count = len(rods[0].start)
    frames = np.empty((count, HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    for first in range(0, count, TOGETHER):
        part = slice(first, first + TOGETHER)
        canvas = np.empty((len(frames[part]), HEIGHT_PX, WIDTH_PX, 3), np.float32)
        canvas[:] = BACKGROUND
        for rod in rods:
            _paint(canvas, rod.start[part], rod.end[part], rod.width_px, rod.colour)
        np.rint(canvas, out=canvas)
        frames[part] = canvas
    return frames


def _paint(
    canvas: NDArray[np.float32], start: Floats, end: Floats, width_px: float, colour: Colour
) -> None:
    """Draw one rod into each frame, inside the box of pixels that it can touch."""
    margin = width_px / 2 + 1
    reach = np.ceil(np.abs(end - start).max(axis=0) + 2 * margin).astype(int) + 1
    corner = np.floor(np.minimum(start, end) - margin).astype(int)
    columns = corner[:, :1] + np.arange(reach[0])
    rows = corner[:, 1:] + np.arange(reach[1])
    seen = ((columns >= 0) & (columns < WIDTH_PX))[:, None] & ((rows >= 0) & (rows < HEIGHT_PX))[
        ..., None
    ]
    frame, row, column = np.nonzero(seen)
    place = frame, rows[frame, row], columns[frame, column]

    along = end - start
    x = columns[:, None] + 0.5 - start[:, :1, None]
    y = rows[..., None] + 0.5 - start[:, 1:, None]
    length_2 = np.maximum((along**2).sum(axis=1), 1e-12)[:, None, None]
    share = ((x * along[:, :1, None] + y * along[:, 1:, None]) / length_2).clip(0, 1)
    distance = np.hypot(x - share * along[:, :1, None], y - share * along[:, 1:, None])
    cover = (0.5 + width_px / 2 - distance).clip(0, 1)[seen][:, None].astype(np.float32)
    canvas[place] += cover * (np.array(colour, np.float32) - canvas[place])
