"""The camera draws exactly anti-aliased pictures of a cart-pole, straight from its state.

The colour of a pixel is that of the scene averaged over the pixel's square, so a pole tip that
moves by a hundredth of a pixel (1 ms of motion) changes the picture. All coverages are areas in
closed form:

- the cart is a box along the image axes: its coverage is one overlap in x times one in y;
- the pole is a rotated rectangle: its area inside a pixel is a sum over its four edges (Green's
  theorem), and only a band of a few pixels around the pole is visited;
- where a pixel is partly cart *and* partly pole, the pole's area is taken inside the cart.

Everything is computed relative to the pixel that holds the pivot, whose place in it is a multiple
of 2⁻²⁰ px, and for poles that lean right: a pole that leans left is drawn in the mirror. Shifts by
whole pixels and reflections are therefore exact to the last bit.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.arrays import Bools, Floats, Integers, Pixels
from hjepa_cli.core.plants.cartpole.parameters import STATE_NAMES, CartPoleParameters
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.system import check_rows, check_states

VERSION = 1  # raise it whenever any picture changes
PIVOT_ROW_PX = 48  # from the top: an upright pole ends 5 px (desktop) or 8 px (gym) below the edge

BACKGROUND_RGB = (255, 255, 255)
CART_RGB = (0, 114, 178)
POLE_RGB = (160, 0, 0)

_CHUNK = 32  # frames drawn together: few calls, and the work stays in the cache
_SUBPIXELS = 2.0**20
_UPRIGHT_PX = 2.0**-17  # an edge that leans less inside a pixel row is spread over this much
_RISE_PX = 1e-12  # an edge that rises less bounds no area
_PIXEL = np.dtype("V3")  # one RGB pixel, copied as a whole

# The pole's corners in order around it: the side of its axis, and the end (pivot 0, tip 1).
_CORNER_SIDES = np.array([1.0, 1.0, -1.0, -1.0])
_CORNER_ENDS = np.array([0.0, 1.0, 1.0, 0.0])


class Camera:
    """The camera stands in front of the track; x = 0 is in the middle of the picture.

    ``parameters`` fix the window and the sizes of cart and pole.
    """

    def __init__(self, parameters: CartPoleParameters) -> None:
        kind = self.plant = parameters
        self.scale_px_m = WIDTH_PX / kind.window_m[0]
        self._cart_px = [_dyadic(size / 2 * self.scale_px_m) for size in kind.cart_size_m]
        self._side_px = _dyadic(kind.pole_width_m / 2 * self.scale_px_m)
        self._length_px = _dyadic(2 * kind.half_length_m * self.scale_px_m)
        # The pole's band: so many pixel rows along the image axis nearer to it, so many across.
        self._lines = math.ceil(math.hypot(2 * self._side_px, self._length_px)) + 1
        self._across = math.ceil(2 * self._side_px * math.sqrt(2) + 1) + 1

    def render(self, states: ArrayLike) -> Pixels:
        """Return RGB frames uint8 ``[n, 64, 128, 3]``, cut off at the edges of the window.

        Args:
            states: ``[n, 4]`` x [m], x_dot, theta [rad], theta_dot; the velocities are not seen.

        Raises:
            NumericalError: a state is not finite.
            ValueError: their shape is another one.
        """
        states = check_rows(states, STATE_NAMES)
        count = len(states)
        # One pixel more than the frames have: whatever is cut off is drawn there.
        pixels = np.empty(count * HEIGHT_PX * WIDTH_PX + 1, _PIXEL)
        frames = pixels[:-1].view(np.uint8).reshape(count, HEIGHT_PX, WIDTH_PX, 3)
        frames[:] = np.full((HEIGHT_PX, WIDTH_PX, 3), BACKGROUND_RGB, np.uint8)
        for first in range(0, count, _CHUNK):
            self._draw(pixels, first, states[first : first + _CHUNK])
        return frames

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

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the pole's axis and the cart's outline of a state ``[4]``, (column, row) in px."""
        x_m, _, theta, _ = check_states(state, (len(STATE_NAMES),), "state")
        pivot = np.array([WIDTH_PX / 2 + x_m * self.scale_px_m, PIVOT_ROW_PX])
        length_px = 2 * self.plant.half_length_m * self.scale_px_m
        tip = pivot + length_px * np.array([np.sin(theta), -np.cos(theta)])
        half = np.array(self.plant.cart_size_m) / 2 * self.scale_px_m
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]])
        return [np.stack([pivot, tip]), pivot + corners * half]

    def _draw(self, pixels: NDArray[Any], first: int, states: Floats) -> None:
        """Draw a chunk of frames: each cart, then the band around its pole, which may cover it."""
        theta = states[:, 2].copy()
        mirrored = theta < 0
        reach_m = 2 * WIDTH_PX / self.scale_px_m  # out of sight
        x_m = states[:, 0].clip(-reach_m, reach_m)
        x_px = np.rint(x_m * (self.scale_px_m * _SUBPIXELS)) / _SUBPIXELS
        x_px = np.where(mirrored, -x_px, x_px).clip(-2 * WIDTH_PX, 2 * WIDTH_PX)
        column = np.floor(x_px)
        pivot_px = x_px - column  # right of the left edge of its pixel, 0 … 1
        canvas = _Canvas(pixels, first, column.astype(np.int64) + WIDTH_PX // 2, mirrored)

        reach_x, reach_y = (math.ceil(half) for half in self._cart_px)
        rows = np.arange(-reach_y, reach_y)
        columns = np.arange(-reach_x, reach_x + 1)
        unturned = np.ones(len(states), bool)
        cart = self._cart(unturned, pivot_px)
        covered = cart.cover(rows[None], columns[None, None])
        canvas.paint(unturned, rows[None], columns[None, None], covered, np.zeros(1))

        pole = self._pole(np.abs(theta), pivot_px)
        cart = self._cart(pole.upright, pivot_px)
        lines, band = pole.band(self._lines, self._across)
        under = cart.cover(lines, band)
        over = pole.area(lines, lines + 1, np.concatenate([band, band[..., -1:] + 1], axis=-1))
        hidden = under * over  # exact unless the pixel is cut by both
        cut = (under > 0) & (under < 1) & (over > 0) & (over < 1)
        frame, line, across = np.nonzero(cut)
        hidden[cut] = _inside(cart, pole, frame, lines[frame, line], band[frame, line, across])
        canvas.paint(pole.upright, lines, band, under - hidden, over)

    def _cart(self, upright: Bools, pivot_px: Floats) -> "_Box":
        half_width, half_height = self._cart_px
        pivot_a, pivot_b = _swap(upright, np.zeros(len(pivot_px)), pivot_px)
        half_a, half_b = _swap(upright, np.asarray(half_height), np.asarray(half_width))
        return _Box(pivot_a - half_a, pivot_a + half_a, pivot_b - half_b, pivot_b + half_b)

    def _pole(self, theta: Floats, pivot_px: Floats) -> "_Pole":
        sin, cos = np.sin(theta), np.cos(theta)
        upright = np.abs(cos) >= np.abs(sin)
        pivot_a, pivot_b = _swap(upright, np.zeros(len(theta)), pivot_px)
        axis_a, axis_b = _swap(upright, -cos, sin)
        side_a, side_b = _swap(upright, sin, cos)
        sides, ends = _CORNER_SIDES * self._side_px, _CORNER_ENDS * self._length_px
        return _Pole(
            upright=upright,
            a=pivot_a[:, None] + side_a[:, None] * sides + axis_a[:, None] * ends,
            b=pivot_b[:, None] + side_b[:, None] * sides + axis_b[:, None] * ends,
            middle=pivot_b - pivot_a * (axis_b / axis_a),
            slope=axis_b / axis_a,
            reach=self._side_px / np.abs(axis_a),
        )


# Below, a frame is seen with its pole upright or nearly so: a runs along the image axis that is
# nearer to the pole's, b along the other one. For lying poles that swaps rows and columns.
# Coordinates are in pixels from the corner of the pivot's pixel; pixel i spans i … i + 1.


@dataclasses.dataclass(frozen=True)
class _Box:
    """The cart of each frame ends at ``[n]`` along a and along b."""

    a_low: Floats
    a_high: Floats
    b_low: Floats
    b_high: Floats

    def cover(self, lines: Integers, band: Integers) -> Floats:
        """Return its coverage of the pixels at a = lines ``[n, A]``, b = band ``[n, A, B]``."""
        along = _overlap(lines, self.a_low[:, None], self.a_high[:, None])
        across = _overlap(band, self.b_low[:, None, None], self.b_high[:, None, None])
        return across * along[..., None]


@dataclasses.dataclass(frozen=True)
class _Pole:
    """The pole of each frame has corners ``[n, 4]`` and the axis b = middle + slope · a ``[n]``."""

    upright: Bools
    a: Floats
    b: Floats
    middle: Floats
    slope: Floats
    reach: Floats  # from the axis to the long edges, along b

    def band(self, lines: int, across: int) -> tuple[Integers, Integers]:
        """Return the pixels that it can touch: a ``[n, lines]``, b ``[n, lines, across]``."""
        a = np.floor(self.a.min(axis=1))[:, None] + np.arange(lines)
        axis = self.middle[:, None] + (a + 0.5) * self.slope[:, None]
        b = np.floor(axis - (self.reach + np.abs(self.slope) / 2)[:, None])
        return a.astype(np.int64), b.astype(np.int64)[..., None] + np.arange(across)

    def area(self, a_low: ArrayLike, a_high: ArrayLike, b_bounds: ArrayLike) -> Floats:
        """Return its area ``[n, A, B]`` [px²] inside cells.

        Rows of cells lie between ``a_low`` and ``a_high`` ``[n, A]``, cells between ``b_bounds``
        ``[n, A, B + 1]``. An edge from b₀ to b₁ over da has the area da · mean(clip(b − c, 0,
        width)) between itself and a cell's far side; around the pole these add up to its own.
        The mean is a difference of ½ max(b − c, 0)² at the edge's ends and the cell's.
        """
        a0, b0 = self.a[:, :, None], self.b[:, :, None]
        a1, b1 = np.roll(self.a, -1, axis=1)[:, :, None], np.roll(self.b, -1, axis=1)[:, :, None]
        rise = a1 - a0
        lean = (b1 - b0) / np.where(np.abs(rise) < _RISE_PX, np.inf, rise)
        first, last = np.minimum(a0, a1), np.maximum(a0, a1)
        start = np.minimum(np.maximum(np.asarray(a_low)[:, None], first), last)
        stop = np.minimum(np.maximum(np.asarray(a_high)[:, None], first), last)
        b_start, b_stop = b0 + lean * (start - a0), b0 + lean * (stop - a0)
        centre = (b_start + b_stop) / 2
        flat = np.abs(b_stop - b_start) < _UPRIGHT_PX
        b_start = np.where(flat, centre - _UPRIGHT_PX / 2, b_start)
        b_stop = np.where(flat, centre + _UPRIGHT_PX / 2, b_stop)
        weight = np.sign(rise) * (stop - start) / (b_stop - b_start) / 2

        bounds = np.asarray(b_bounds, float)
        total = np.zeros(bounds.shape)
        far, near = np.empty_like(bounds), np.empty_like(bounds)  # reused: twice as fast
        for edge in range(len(_CORNER_ENDS)):
            for end, distance in ((b_stop, far), (b_start, near)):
                np.subtract(end[:, edge, :, None], bounds, out=distance)
                np.maximum(distance, 0.0, out=distance)
                distance *= distance
            far -= near
            far *= weight[:, edge, :, None]
            total += far
        return np.abs(total[..., :-1] - total[..., 1:])


def _inside(cart: _Box, pole: _Pole, frames: Integers, a: Integers, b: Integers) -> Floats:
    """Return the area of the pole inside the cart inside single pixels (a, b), all ``[m]``."""
    a_low, a_high = np.maximum(a, cart.a_low[frames]), np.minimum(a + 1, cart.a_high[frames])
    b_low, b_high = np.maximum(b, cart.b_low[frames]), np.minimum(b + 1, cart.b_high[frames])
    bounds = np.stack([b_low, b_high], axis=-1)[:, None]
    fields = (field.name for field in dataclasses.fields(pole))
    cut = _Pole(**{name: getattr(pole, name)[frames] for name in fields})
    return cut.area(a_low[:, None], a_high[:, None], bounds)[:, 0, 0]


@dataclasses.dataclass(frozen=True)
class _Canvas:
    """A chunk of frames is drawn here; ``columns`` ``[n]`` hold the pivots before mirroring."""

    pixels: NDArray[Any]
    first: int
    columns: Integers
    mirrored: Bools

    def paint(
        self, upright: Bools, lines: Integers, band: Integers, cart: Floats, pole: Floats
    ) -> None:
        """Write the pixels at a = lines ``[n, A]``, b = band ``[n, A, B]``.

        Where ``upright`` ``[n]``, a counts rows, else columns; ``cart`` and ``pole`` are the shares
        of each pixel that show them.
        """
        colours = np.empty((*cart.shape, 3), np.uint8)
        for channel, (ground, of_cart, of_pole) in enumerate(
            zip(BACKGROUND_RGB, CART_RGB, POLE_RGB, strict=True)
        ):
            colour = ground + (of_cart - ground) * cart + (of_pole - ground) * pole
            colours[..., channel] = np.rint(colour)
        self.pixels[self._places(upright, lines, band)] = colours.view(_PIXEL)[..., 0]

    def _places(self, upright: Bools, lines: Integers, band: Integers) -> Integers:
        """Return indices ``[n, A, B]`` into ``pixels``; the last stands for all that is cut off."""
        towards = np.where(self.mirrored, -1, 1)
        column = np.where(self.mirrored, WIDTH_PX - 1 - self.columns, self.columns)
        row = np.full(len(column), PIVOT_ROW_PX)
        down = np.ones(len(column), np.int64)
        a_start, b_start = _swap(upright, row, column)
        a_towards, b_towards = _swap(upright, down, towards)
        a_size, b_size = _swap(upright, np.asarray(HEIGHT_PX), np.asarray(WIDTH_PX))
        a_stride, b_stride = _swap(upright, np.asarray(WIDTH_PX), np.asarray(1))
        frame = (self.first + np.arange(len(column))) * (HEIGHT_PX * WIDTH_PX)

        a = a_start[:, None] + a_towards[:, None] * lines
        b = b_start[:, None, None] + b_towards[:, None, None] * band
        seen_a = (a >= 0) & (a < a_size[:, None])
        seen = (b >= 0) & (b < b_size[:, None, None]) & seen_a[..., None]
        places = b * b_stride[:, None, None] + (frame[:, None] + a * a_stride[:, None])[..., None]
        return np.where(seen, places, len(self.pixels) - 1)


def _overlap(pixel: Integers, low: Floats, high: Floats) -> Floats:
    """Return how much of pixel … pixel + 1 lies within low … high."""
    overlap: Floats = np.minimum(pixel + 1, high) - np.maximum(pixel, low)
    return np.maximum(overlap, 0.0)


def _swap(condition: Bools, first: Any, second: Any) -> tuple[Any, Any]:
    """Return (first, second) where ``condition`` holds, else (second, first)."""
    return np.where(condition, first, second), np.where(condition, second, first)


def _dyadic(length_px: float) -> float:
    return round(length_px * _SUBPIXELS) / _SUBPIXELS
