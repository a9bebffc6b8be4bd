"""Camera frames become contact sheets and animations, with Pillow (extra ``plot``)."""

import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hjepa_cli.core.arrays import Pixels
from hjepa_cli.storage.files import write_bytes

LABEL_PX = 14  # height of the line of text above a frame
MARGIN_PX = 4
INK, FAINT, PAPER = (20, 20, 20), (110, 110, 110), (245, 245, 245)


def font(size_px: int = 10) -> "ImageFont.FreeTypeFont | ImageFont.ImageFont":
    """Return Pillow's own font, so that every machine draws the same letters."""
    return ImageFont.load_default(size_px)


def contact_sheet(frames: Pixels, labels: Sequence[Sequence[str]]) -> Image.Image:
    """Lay frames uint8 [rows, columns, H, W, C] out in a grid, labels [rows][columns] above.

    Frames that are narrower than the longest label are enlarged.
    """
    longest_px = max(font().getlength(text) for texts in labels for text in texts)
    times = max(math.ceil(longest_px / frames.shape[3]), 1)
    frames = frames.repeat(times, axis=2).repeat(times, axis=3)
    frames = np.broadcast_to(frames, (*frames.shape[:-1], 3))  # of grey ones too
    rows, columns, height, width, _ = frames.shape
    step = (width + MARGIN_PX, height + LABEL_PX + MARGIN_PX)
    size = (columns * step[0] + MARGIN_PX, rows * step[1] + MARGIN_PX)
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    for row in range(rows):
        for column in range(columns):
            left, top = MARGIN_PX + column * step[0], MARGIN_PX + row * step[1]
            draw.text((left + 1, top), labels[row][column], INK, font())
            sheet.paste(Image.fromarray(frames[row, column]), (left, top + LABEL_PX))
    return sheet


def save_png(image: Image.Image, path: Path) -> Path:
    """Write an image as PNG, atomically; equal images give equal bytes."""
    buffer = io.BytesIO()
    image.save(buffer, "PNG", optimize=True)
    write_bytes(path, buffer.getvalue())
    return path
