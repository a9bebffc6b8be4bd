"""Pictures of any usual kind become uint8 with one channel or three."""

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Pixels
from hjepa_cli.errors import DataError

CHANNELS = (1, 3, 4)
MODES = {"L", "RGB", "RGBA", "1", "I;16", "F"}  # that numpy makes arrays of as we take them
SIDES_PX = (1, 16_384)


def decoded(source: Path | bytes, where: str) -> NDArray[Any]:
    """Return a picture file, or its bytes, as [H, W] or [H, W, C].

    Raises:
        DataError: it does not decode; the message says ``where`` it is.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
            return np.asarray(image if image.mode in MODES else image.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        named = source if isinstance(source, Path) else "the picture"
        raise DataError(f"{where}: {named} does not decode: {error}") from None


def as_pixels(block: NDArray[Any], name: str, row: int) -> tuple[Pixels, set[str]]:
    """Return pictures uint8 [n, H, W, C], C = 1 or 3, and what was converted, in words.

    Args:
        block: pictures [n, H, W, C], [n, C, H, W] or [n, H, W].
        name: of their episode, for messages.
        row: of the first one.

    Raises:
        DataError: they are no pictures.
    """
    said = set()
    if block.ndim == 3:
        block = block[..., None]
    if block.ndim == 4 and block.shape[-1] not in CHANNELS and block.shape[1] in CHANNELS:
        block = np.moveaxis(block, 1, -1)
    sound = block.ndim == 4 and block.shape[-1] in CHANNELS
    if not sound or not all(SIDES_PX[0] <= side <= SIDES_PX[1] for side in block.shape[1:3]):
        shape = tuple(block.shape[1:])
        raise DataError(
            f"{name}, row {row}: a picture of shape {shape}; expected (H, W, C) with 1, 3 or 4 "
            "channels"
        )
    if block.shape[-1] == 4:
        block = block[..., :3]
        said.add("the alpha channel was dropped")
    if block.dtype == np.uint8:
        return np.ascontiguousarray(block), said
    if block.dtype == bool:
        said.add("black-and-white pictures became 0 and 255")
        return block.astype(np.uint8) * 255, said
    if block.dtype == np.uint16:
        said.add("16-bit pictures became 8-bit ones")
        return np.rint(block / 257).astype(np.uint8), said
    if block.dtype.kind != "f":
        raise DataError(
            f"{name}, row {row}: pictures of {block.dtype}; expected uint8, uint16 or floats "
            "from 0 to 1"
        )
    for place, picture in enumerate(block):
        low, high = float(picture.min()), float(picture.max())
        if not (0 <= low and high <= 1):  # of NaN too
            raise DataError(
                f"{name}, row {row + place}: a float picture from {low:g} to {high:g}; expected "
                "0 to 1"
            )
    said.add("float pictures from 0 to 1 became 0 to 255")
    return np.rint(block * 255).astype(np.uint8), said
