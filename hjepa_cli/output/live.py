"""The terminal shows closed loops in pictures of two pixels a character, with rich.

They show what :mod:`hjepa_cli.output.animation` draws, coarser: the true plant in its colours, over
it the pole that the controller believes in (black), and a strip with a character per picture.
"""

import time

import numpy as np
from PIL import Image, ImageDraw
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.output.animation import Pictures
from hjepa_cli.output.film import Film

COLUMNS, GAP = (16, 64), 2  # characters of a panel, at least and at most, and between panels
SKY_PX = 4  # of a frame, above any pole


def play(pictures: Pictures, fps: int) -> None:
    """Show the animation in the terminal, as coloured half blocks."""
    with Live(refresh_per_second=fps, transient=False) as live:
        for k in pictures.steps:
            started_s = time.monotonic()
            live.update(terminal_picture(pictures, k, *live.console.size))
            time.sleep(max(0.0, 1 / fps - (time.monotonic() - started_s)))


def terminal_picture(pictures: Pictures, k: int, width: int, height: int) -> Group:
    """Return one picture as rich text and tables for a terminal of so many characters."""
    columns = panel_columns(pictures, width, height)
    nothing = "none did" if pictures.link.sends_always else "none sent"
    parts: list[Text | Table] = [
        Text(pictures.link.label + pictures.link.late, style="dim", no_wrap=True),
        Text(f"black: what the controller believes; █ packet arrived, · {nothing}", style="dim",
             no_wrap=True),
    ]  # fmt: skip
    for shot in pictures.films:
        score = shot.score[: k + 1].mean()
        title = f"{shot.method}, {1e3 * k * pictures.kind.step_s:.0f} ms, {score:.0%} in the band"
        table = Table.grid(padding=(0, GAP, 0, 0))
        for _ in range(pictures.devices):
            table.add_column(width=columns, no_wrap=True)
        devices = range(pictures.devices)
        table.add_row(*(_scene(pictures, shot, device, k, columns) for device in devices))
        table.add_row(*(_captions(pictures, shot, device, k, columns) for device in devices))
        parts += [Text(title, style="bold", no_wrap=True), table]
    return Group(*parts)


def panel_columns(pictures: Pictures, width: int, height: int) -> int:
    """Return how wide a panel can be, so that all of them fit; small terminals cut some off."""
    least, most = COLUMNS
    across = (width + GAP) // pictures.devices - GAP
    rows = (height - 3) // len(pictures.films) - 4  # the notes; a title and three lines of captions
    down = rows * 2 * WIDTH_PX // (HEIGHT_PX - SKY_PX)
    return max(min(across, down, most), least)


def _captions(pictures: Pictures, shot: Film, device: int, k: int, columns: int) -> Text:
    """Say what came of late, a character per picture, its age and SNR, and the belief's error."""
    text, delivered = Text(), pictures.link.delivered[:, device]
    for back in range(columns - 1, -1, -1):
        end = k + 1 - back * pictures.every
        if end < 1:
            text.append(" ")
        elif delivered[max(end - pictures.every, 0) : end].any():
            text.append("█", style="green")
        else:
            text.append("·", style="red" if pictures.link.sends_always else "dim")
    snr_db = pictures.link.snr_db[k, device]
    text.append(f"\n{pictures.age(device, k).removeprefix('packet ')}, {snr_db:.0f} dB")
    text.append(f"\n{pictures.error(shot, device, k)}", style="dim")
    return text


def _scene(pictures: Pictures, shot: Film, device: int, k: int, columns: int) -> Text:
    """Return a frame and the belief over it: a character shows two pixels, one over the other."""
    image = Image.fromarray(pictures.frame(shot, device, k)).crop((0, SKY_PX, WIDTH_PX, HEIGHT_PX))
    rows = columns * (HEIGHT_PX - SKY_PX) // (2 * WIDTH_PX)
    image = image.resize((columns, 2 * rows), Image.Resampling.BOX)
    axis, *_ = pictures.sketch(shot, device, k)
    line = [tuple((point - (0, SKY_PX)) * columns / WIDTH_PX) for point in axis]
    ImageDraw.Draw(image).line(line, fill=(0, 0, 0))
    text = Text()
    pixels = np.asarray(image)
    for row, next_row in zip(pixels[::2].tolist(), pixels[1::2].tolist(), strict=True):
        for above, below in zip(row, next_row, strict=True):
            upper, lower = ("#{:02x}{:02x}{:02x}".format(*colour) for colour in (above, below))
            text.append("▀", style=f"{upper} on {lower}")
        text.append("\n")
    text.rstrip()
    return text
