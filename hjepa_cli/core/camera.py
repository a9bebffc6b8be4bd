"""The camera: exact anti-aliased pictures of a cart-pole, straight from its state.

The colour of a pixel is that of the scene averaged over the pixel's square, so a pole tip that
moves by a hundredth of a pixel (1 ms of motion) changes the picture. Coverages are exact areas:

- the cart is an axis-aligned box, so its coverage is one overlap in x times one in y;
- the pole is a rotated rectangle. Seen from one pixel it is the sum over its four edges of the
  area between the edge and the pixel's far side, counted with the edge's direction (Green's
  theorem). Only a band of a few pixels around the pole is visited.

Everything is computed relative to the pixel that holds the pivot, whose place is a multiple of
2⁻²⁰ px, and for poles that lean right: leaning left is the mirrored picture. Shifts by whole
pixels and reflections are therefore exact to the last bit.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core import plant as plants
from hjepa_cli.core.plant import Plant

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

VERSION = 1  # raise it whenever a pixel of any picture changes
HEIGHT_PX = 64
WIDTH_PX = 128
PIVOT_ROW_PX = 48  # from the top: the upright pole ends 5 px below the upper edge
SUBPIXELS = 2.0**20

BACKGROUND_RGB = (255, 255, 255)
CART_RGB = (0, 114, 178)
POLE_RGB = (160, 0, 0)

_CHUNK = 16  # frames at a time, so that the work stays in the cache
_FLAT = 1e-7  # px: an edge that crosses a pixel row over less than this counts as upright


class Camera:
    """A fixed camera in front of the track; the picture's centre column is x = 0.

    Args:
        plant: a plant or its name: fixes the window and the sizes of cart and pole.

    Raises:
        UsageError: unknown plant.
    """

    def __init__(self, plant: Plant | str) -> None:
        kind = plants.plant(plant) if isinstance(plant, str) else plant
        self.plant = kind
        self.scale_px_m = WIDTH_PX / kind.window_m[0]
        scale = self.scale_px_m
        self._cart_half_px = [_dyadic(size / 2 * scale) for size in kind.cart_size_m]
        self._pole_half_px = _dyadic(kind.pole_width_m / 2 * scale)
        self._pole_length_px = _dyadic(2 * kind.half_length_m * scale)
        reach_x, reach_y = (math.ceil(half) for half in self._cart_half_px)
        self._cart_rows = np.arange(-reach_y, reach_y, dtype=float)[None, :, None]
        self._cart_columns = np.arange(-reach_x, reach_x + 1, dtype=float)[None, None, :]
        width_px, length_px = 2 * self._pole_half_px, self._pole_length_px
        # A band holds the pole along its steeper axis (lines) and a few pixels across it.
        self._lines = math.ceil(math.hypot(width_px, length_px)) + 1
        self._across = math.ceil(width_px * math.sqrt(2) + 1) + 1

    def render(self, states: ArrayLike) -> NDArray[np.uint8]:
        """Return one RGB frame per state.

        Args:
            states: ``[n, 4]`` x [m], x_dot, theta [rad], theta_dot; the velocities are not seen.

        Returns:
            ``[n, 64, 128, 3]`` uint8. What lies outside of the window is cut off.
        """
        states = np.asarray(states, float)
        count = len(states)
        # One pixel more than the frames have: what is cut off goes there.
        pixels = np.empty((count * HEIGHT_PX * WIDTH_PX + 1, 3), np.uint8)
        pixels[:] = BACKGROUND_RGB
        for first in range(0, count, _CHUNK):
            some = states[first : first + _CHUNK]
            self._draw(pixels, first, some[:, 0], some[:, 2])
        return pixels[:-1].reshape(count, HEIGHT_PX, WIDTH_PX, 3)

    def manifest(self) -> dict[str, Any]:
        """Return all that fixes a picture besides the state, as plain data."""
        return {
            "version": VERSION,
            "height_px": HEIGHT_PX,
            "width_px": WIDTH_PX,
            "scale_px_m": self.scale_px_m,
            "pivot_row_px": PIVOT_ROW_PX,
            "cart_size_m": list(self.plant.cart_size_m),
            "pole_size_m": [self.plant.pole_width_m, 2 * self.plant.half_length_m],
            "background_rgb": list(BACKGROUND_RGB),
            "cart_rgb": list(CART_RGB),
            "pole_rgb": list(POLE_RGB),
        }

    def _draw(self, pixels: NDArray[np.uint8], first: int, x: Floats, theta: Floats) -> None:
        """Draw a chunk of frames into ``pixels``: the cart, and over it the pole."""
        mirrored = theta < 0
        x_px = np.rint(x * (self.scale_px_m * SUBPIXELS)) / SUBPIXELS
        x_px = np.where(mirrored, -x_px, x_px)
        column = np.floor(x_px)
        pivot_px = (x_px - column)[:, None, None]  # right of its pixel's left edge, 0 … 1

        def places(rows: Floats, columns: Floats) -> Integers:
            """Index local rows and columns into ``pixels``."""
            row = rows.astype(np.int64) + PIVOT_ROW_PX
            place = (columns + column[:, None, None]).astype(np.int64) + WIDTH_PX // 2
            place = np.where(mirrored[:, None, None], WIDTH_PX - 1 - place, place)
            seen = (row >= 0) & (row < HEIGHT_PX) & (place >= 0) & (place < WIDTH_PX)
            frame = np.arange(first, first + len(x))[:, None, None]
            return np.where(seen, (frame * HEIGHT_PX + row) * WIDTH_PX + place, len(pixels) - 1)

        rows, columns = self._cart_rows, self._cart_columns
        cart = self._cart(rows, columns, pivot_px)
        pixels[places(rows, columns)] = _rounded(_over(BACKGROUND_RGB, CART_RGB, cart))

        rows, columns, pole = self._pole(pivot_px, np.abs(theta))
        behind = _over(BACKGROUND_RGB, CART_RGB, self._cart(rows, columns, pivot_px))
        pixels[places(rows, columns)] = _rounded(_over(behind, POLE_RGB, pole))

    def _cart(self, rows: Floats, columns: Floats, pivot_px: Floats) -> Floats:
        """Return the cart's coverage of the pixels at local rows and columns."""
        half_width, half_height = self._cart_half_px
        return _overlap(columns - pivot_px, half_width) * _overlap(rows, half_height)

    def _pole(self, pivot_px: Floats, theta: Floats) -> tuple[Floats, Floats, Floats]:
        """Return local rows, columns and the pole's coverage there, each ``[n, lines, across]``."""
        sin, cos = np.sin(theta), np.cos(theta)
        upright = np.abs(cos) >= np.abs(sin)
        # From here on: a runs along the image axis that is nearer to the pole's, b across it.
        pivot_a, pivot_b = _swap(upright, np.zeros(len(theta)), pivot_px[:, 0, 0])
        pole_a, pole_b = _swap(upright, -cos, sin)
        side_a, side_b = _swap(upright, sin, cos)
        side, end = _CORNER_SIDES * self._pole_half_px, _CORNER_ENDS * self._pole_length_px
        corner_a = pivot_a[:, None] + side_a[:, None] * side + pole_a[:, None] * end
        corner_b = pivot_b[:, None] + side_b[:, None] * side + pole_b[:, None] * end

        lines = np.floor(corner_a.min(axis=1))[:, None] + np.arange(self._lines)
        slope = (pole_b / pole_a)[:, None]
        middle = pivot_b[:, None] + (lines + 0.5 - pivot_a[:, None]) * slope
        reach = self._pole_half_px / np.abs(pole_a)[:, None] + np.abs(slope) / 2
        band = np.floor(middle - reach)[..., None] + np.arange(self._across)

        coverage = np.abs(_polygon(corner_a, corner_b, lines, band))
        along = np.broadcast_to(lines[..., None], band.shape)
        rows, columns = _swap(upright[:, None, None], along, band)
        return rows, columns, coverage


# The pole's corners, in order around it: which side of its axis, and which end.
_CORNER_SIDES = np.array([1.0, 1.0, -1.0, -1.0])
_CORNER_ENDS = np.array([0.0, 1.0, 1.0, 0.0])


def _polygon(corner_a: Floats, corner_b: Floats, lines: Floats, band: Floats) -> Floats:
    """Return the signed area of a polygon inside each pixel of a band.

    Args:
        corner_a, corner_b: ``[n, corners]`` in order around the polygon.
        lines: ``[n, lines]`` a of each line's lower edge.
        band: ``[n, lines, across]`` b of each pixel's lower edge.

    Returns:
        ``[n, lines, across]``, all of one sign per polygon.
    """
    area = np.zeros(band.shape)
    for edge in range(corner_a.shape[1]):
        a0, b0 = corner_a[:, edge, None], corner_b[:, edge, None]
        a1, b1 = np.roll(corner_a, -1, 1)[:, edge, None], np.roll(corner_b, -1, 1)[:, edge, None]
        rise = np.where(a1 == a0, 1.0, a1 - a0)
        low, high = np.minimum(a0, a1), np.maximum(a0, a1)
        start, stop = np.clip(lines, low, high), np.clip(lines + 1, low, high)
        b_start = b0 + (b1 - b0) * ((start - a0) / rise)
        b_stop = b0 + (b1 - b0) * ((stop - a0) / rise)
        area += (np.sign(a1 - a0) * (stop - start))[..., None] * _mean_share(
            b_start[..., None] - band, b_stop[..., None] - band
        )
    return area


def _mean_share(start: Floats, stop: Floats) -> Floats:
    """Return the mean of clip(t, 0, 1) over t from start to stop."""
    span = stop - start
    flat = np.abs(span) < _FLAT
    low, high = np.clip(start, 0.0, 1.0), np.clip(stop, 0.0, 1.0)
    integral = high * (stop - high / 2) - low * (start - low / 2)
    return np.where(flat, (low + high) / 2, integral / np.where(flat, 1.0, span))


def _overlap(edge: Floats, half: float) -> Floats:
    """Return how much of the pixel from ``edge`` to ``edge + 1`` lies within ± ``half``."""
    return np.clip(np.minimum(edge + 1, half) - np.maximum(edge, -half), 0.0, 1.0)


def _over(behind: ArrayLike, colour: ArrayLike, coverage: Floats) -> Floats:
    """Paint ``colour`` over ``behind``; returns ``[..., 3]``."""
    behind = np.asarray(behind, float)
    return behind + (np.asarray(colour, float) - behind) * coverage[..., None]


def _rounded(colour: Floats) -> NDArray[np.uint8]:
    return np.rint(colour).astype(np.uint8)


def _swap(condition: NDArray[np.bool_], first: Floats, second: Floats) -> tuple[Floats, Floats]:
    """Return (first, second) where ``condition`` holds, else (second, first)."""
    return np.where(condition, first, second), np.where(condition, second, first)


def _dyadic(length_px: float) -> float:
    return round(length_px * SUBPIXELS) / SUBPIXELS
