"""Flaws of pictures between a scene and an encoder, each a function of a severity.

A function takes pictures float32 [m, κ, H, W, C] in grey levels, 0 to 255, the κ of one packet in
a row, a severity and a generator, and returns pictures of the same shape. What is fast (flicker,
jitter, noise) is drawn for every frame, what is slow (where a rectangle is) for every packet.
"""

import io
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from hjepa_cli.compute.seeding import generator
from hjepa_cli.errors import require

Pictures = NDArray[np.float32]
Corrupt = Callable[[Pictures, float, Generator], Pictures]

GREY, DARK = 128.0, 20.0
_TEXTURE_KEY = 0x7E87
_ROWS, _COLUMNS = 2, 3  # axes


def light(pictures: Pictures, factor: float, random: Generator) -> Pictures:
    """Multiply all values."""
    return np.float32(factor) * pictures


def gamma(pictures: Pictures, exponent: float, random: Generator) -> Pictures:
    """Bend the camera's curve: v ↦ v^γ of values between black 0 and white 1."""
    share = np.clip(pictures, 0, 255).astype(np.float32) / 255
    bent: Pictures = (255 * np.power(share, exponent)).astype(np.float32)
    return bent


def colour(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Make light warmer by a share: red by 1, blue by 1/(1 + share)², green between them."""
    return pictures / (1 + np.float32(share)) ** np.arange(3, dtype=np.float32)


def gradient(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Let the light fall off by a share from the left edge to the right one."""
    along = np.linspace(0, 1, pictures.shape[_COLUMNS], dtype=np.float32)[:, None]
    return pictures * (1 - np.float32(share) * along)


def flicker(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Let the light of each frame be less by a share, or not, at random."""
    dim = random.integers(2, size=pictures.shape[:2])[:, :, None, None, None]
    dimmed: Pictures = pictures * (1 - np.float32(share) * dim.astype(np.float32))
    return dimmed


def noise(pictures: Pictures, width: float, random: Generator) -> Pictures:
    """Add white noise of a standard deviation in grey levels to every value."""
    return pictures + np.float32(width) * random.standard_normal(pictures.shape, np.float32)


def shot(pictures: Pictures, width: float, random: Generator) -> Pictures:
    """Add noise whose variance grows with the value, of this standard deviation at white."""
    root = np.sqrt(np.clip(pictures, 0, 255) / np.float32(255))
    drawn: Pictures = root * random.standard_normal(pictures.shape, np.float32)
    return pictures + np.float32(width) * drawn


def bayer(pictures: Pictures, width: float, random: Generator) -> Pictures:
    """See one colour per pixel (RGGB), with noise in each, and fill in the others by neighbours."""
    return demosaiced(noise(pictures, width, random))


def demosaiced(raw: Pictures) -> Pictures:
    """Keep one colour per pixel (RGGB), and fill in the others by neighbours.

    Each colour is the mean of what is seen of it in 3 × 3 pixels, weighted [1 2 1] both ways.
    """
    from scipy import ndimage

    seen = np.zeros(raw.shape[2:], np.float32)
    seen[0::2, 0::2, 0] = seen[0::2, 1::2, 1] = seen[1::2, 0::2, 1] = seen[1::2, 1::2, 2] = 1
    near = np.outer([1, 2, 1], [1, 2, 1]).astype(np.float32)[:, :, None]
    weight = ndimage.convolve(seen, near, mode="nearest")
    filled = ndimage.convolve(raw * seen, near[None, None], mode="nearest")
    return cast(Pictures, filled / weight)


def blur(pictures: Pictures, width_px: float, random: Generator) -> Pictures:
    """Blur by a Gaussian of a standard deviation in pixels."""
    from scipy import ndimage

    width = (0, 0, width_px, width_px, 0)
    return cast(Pictures, ndimage.gaussian_filter(pictures, width, mode="nearest"))


def shift(pictures: Pictures, right_px: float, random: Generator) -> Pictures:
    """Move what is seen to the right."""
    rows, columns = _grid(pictures)
    return warped(pictures, rows, columns - right_px)


def shift_down(pictures: Pictures, down_px: float, random: Generator) -> Pictures:
    """Move what is seen down."""
    rows, columns = _grid(pictures)
    return warped(pictures, rows - down_px, columns)


def jitter(pictures: Pictures, width_px: float, random: Generator) -> Pictures:
    """Move every frame for itself, both ways, by a standard deviation in pixels."""
    moves_px = width_px * random.standard_normal((*pictures.shape[:2], 2))
    moved, (rows, columns) = np.empty_like(pictures), _grid(pictures)
    for packet, frame in np.ndindex(pictures.shape[:2]):
        down_px, right_px = moves_px[packet, frame]
        one = pictures[packet, frame][None, None]
        moved[packet, frame] = warped(one, rows - down_px, columns - right_px)[0, 0]
    return moved


def rotation(pictures: Pictures, degrees: float, random: Generator) -> Pictures:
    """Turn what is seen clockwise around the middle of the picture."""
    (rows, columns), angle = _grid(pictures), np.radians(degrees)
    down, right = rows - rows.mean(), columns - columns.mean()
    return warped(
        pictures,
        rows.mean() + np.cos(angle) * down - np.sin(angle) * right,
        columns.mean() + np.sin(angle) * down + np.cos(angle) * right,
    )


def lens(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Distort like a barrel: corners are seen nearer to the middle by a share."""
    rows, columns = _grid(pictures)
    down, right = rows - rows.mean(), columns - columns.mean()
    reach = (down**2 + right**2) / (down**2 + right**2).max()
    further = 1 + share * reach
    return warped(pictures, rows.mean() + further * down, columns.mean() + further * right)


def vignette(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Darken towards the corners, there by a share, with the square of the distance."""
    rows, columns = _grid(pictures)
    reach = (rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2
    left: Pictures = (1 - share * reach / reach.max())[..., None].astype(np.float32)
    return pictures * left


def texture(pictures: Pictures, depth: float, random: Generator) -> Pictures:
    """Paint one and the same pattern of stains over all, up to so many grey levels darker."""
    from scipy import ndimage

    drawn = generator(_TEXTURE_KEY).standard_normal(pictures.shape[2:4])
    stains = ndimage.gaussian_filter(drawn, 3, mode="wrap")
    stains = (stains - stains.min()) / np.ptp(stains)
    left: Pictures = (1 - depth / 255 * stains[..., None]).astype(np.float32)
    return pictures * left


def jpeg(pictures: Pictures, quality: float, random: Generator) -> Pictures:
    """Send every frame as a JPEG of a quality."""
    require("PIL", "JPEG needs Pillow", "plot")
    from PIL import Image

    received = np.empty_like(pictures)
    for place in np.ndindex(pictures.shape[:2]):
        file = io.BytesIO()
        plain = as_bytes(pictures[place])
        grey = plain.shape[-1] == 1
        Image.fromarray(plain[..., 0] if grey else plain).save(file, "JPEG", quality=round(quality))
        received[place] = np.asarray(Image.open(file)).reshape(plain.shape)
    return received


def pixelate(pictures: Pictures, size_px: float, random: Generator) -> Pictures:
    """Average squares of pixels."""
    size = round(size_px)
    for axis in (_ROWS, _COLUMNS):
        cuts = np.arange(0, pictures.shape[axis], size)
        counts = np.diff([*cuts, pictures.shape[axis]])
        means = np.add.reduceat(pictures, cuts, axis) / counts.reshape(
            [-1 if other == axis else 1 for other in range(5)]
        )
        pictures = np.repeat(means, counts, axis).astype(np.float32)
    return pictures


def dead_pixels(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Turn a share of all pixels black or white, others in every frame."""
    drawn = random.random(pictures.shape[:4], np.float32)[..., None]
    return np.where(drawn < share / 2, 0, np.where(drawn > 1 - share / 2, 255, pictures))


def contrast(pictures: Pictures, factor: float, random: Generator) -> Pictures:
    """Draw all values towards mid-grey by a factor, as fog does, or away from it."""
    return np.float32(factor) * (pictures - np.float32(GREY)) + np.float32(GREY)


def brightness(pictures: Pictures, levels: float, random: Generator) -> Pictures:
    """Add grey levels to all values."""
    return pictures + np.float32(levels)


def corner(pictures: Pictures, size_px: float, random: Generator) -> Pictures:
    """Put a grey square into the lower left corner."""
    size = round(size_px)
    return _covered(pictures, np.s_[max(pictures.shape[_ROWS] - size, 0) :], np.s_[:size], GREY)


def dark_object(pictures: Pictures, size_px: float, random: Generator) -> Pictures:
    """Put a dark square at the top in the middle, where an upright pole ends."""
    size = round(size_px)
    left = max((pictures.shape[_COLUMNS] - size) // 2, 0)
    return _covered(pictures, np.s_[:size], np.s_[left : left + size], DARK)


def bar(pictures: Pictures, height_px: float, random: Generator) -> Pictures:
    """Lay a grey bar across the picture, above its middle, before a part of the pole."""
    top = pictures.shape[_ROWS] * 3 // 8
    return _covered(pictures, np.s_[top : top + round(height_px)], np.s_[:], GREY)


def post(pictures: Pictures, width_px: float, random: Generator) -> Pictures:
    """Stand a grey post upright before the middle of the picture."""
    left = max((pictures.shape[_COLUMNS] - round(width_px)) // 2, 0)
    return _covered(pictures, np.s_[:], np.s_[left : left + round(width_px)], GREY)


def top(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Hide a share of the picture behind grey, from above."""
    return _covered(pictures, np.s_[: round(share * pictures.shape[_ROWS])], np.s_[:], GREY)


def rectangle(pictures: Pictures, size_px: float, random: Generator) -> Pictures:
    """Put a square of one grey level before each packet's pictures, anywhere in them."""
    size, hidden = min(round(size_px), *pictures.shape[2:4]), pictures.copy()
    for packet in hidden:
        row, column = (random.integers(0, packet.shape[axis] - size + 1) for axis in (1, 2))
        packet[:, row : row + size, column : column + size] = random.uniform(0, 255)
    return hidden


def black(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Blacken a share of all packets."""
    return np.where(_chosen(pictures, share, random), np.float32(0), pictures)


def saturated(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Make a share of all packets white."""
    return np.where(_chosen(pictures, share, random), np.float32(255), pictures)


def frozen(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Repeat the first frame in a share of all packets."""
    return np.where(_chosen(pictures, share, random), pictures[:, :1], pictures)


def torn(pictures: Pictures, share: float, random: Generator) -> Pictures:
    """Move the lower half of the last frame aside in a share of all packets."""
    rows, columns = pictures.shape[2:4]
    moved = pictures.copy()
    moved[:, -1, rows // 2 :] = np.roll(pictures[:, -1, rows // 2 :], columns // 4, axis=2)
    return np.where(_chosen(pictures, share, random), moved, pictures)


def as_bytes(pictures: Pictures) -> NDArray[np.uint8]:
    """Return values as a camera has them: whole, from 0 to 255."""
    return cast(NDArray[np.uint8], np.clip(np.rint(pictures), 0, 255).astype(np.uint8))


def warped(pictures: Pictures, rows: Any, columns: Any) -> Pictures:
    """Return what lies at rows and columns [H, W] of all pictures, between pixels on lines.

    Beyond the edges it is the same as on them.
    """
    height, width = pictures.shape[2:4]
    rows, columns = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
    row, column = (
        np.minimum(at.astype(int), size - 2) for at, size in ((rows, height), (columns, width))
    )
    down, right = (
        (at - whole)[..., None].astype(np.float32) for at, whole in ((rows, row), (columns, column))
    )
    upper = pictures[:, :, row, column] * (1 - right) + pictures[:, :, row, column + 1] * right
    row = row + 1
    lower = pictures[:, :, row, column] * (1 - right) + pictures[:, :, row, column + 1] * right
    return cast(Pictures, upper * (1 - down) + lower * down)


def _grid(pictures: Pictures) -> Any:
    return np.meshgrid(*map(np.arange, pictures.shape[2:4]), indexing="ij")


def _covered(pictures: Pictures, rows: slice, columns: slice, level: float) -> Pictures:
    covered = pictures.copy()
    covered[:, :, rows, columns] = level
    return covered


def _chosen(pictures: Pictures, share: float, random: Generator) -> NDArray[np.bool_]:
    return (random.random(len(pictures)) < share)[:, None, None, None, None]
