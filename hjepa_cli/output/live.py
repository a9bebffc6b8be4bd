"""The terminal shows closed loops in pictures of two pixels a character, with rich.

They show what :mod:`hjepa_cli.output.animation` draws, coarser: the true plant in its colours,
beside it, paler, what the controller believes, and a strip with a character per picture. Poles that
would be too small to tell anything are left out: a small terminal shows fewer devices.
"""

import dataclasses
import math
import time

import numpy as np
from PIL import Image
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hjepa_cli.output.animation import ARRIVED, FLAGGED, LOST, VIEW_PX, Pictures
from hjepa_cli.output.film import Film

GAP = 2  # characters between panels
LEAST_COLUMNS = 22  # for what is said below a scene
LEAST_ROWS, MOST_ROWS = 9, 28  # characters that a scene is high; below the least, poles look alike
NOTES, CAPTIONS = 2, 4  # lines above everything; of a panel: method, strip, age, error


@dataclasses.dataclass(frozen=True)
class Layout:
    """So many devices are shown, scenes of ``rows`` lines, ``across`` panels beside each other."""

    devices: int
    across: int
    rows: int

    @property
    def columns(self) -> int:
        """Return how many characters a panel is wide: truth, a blank, belief."""
        return max(2 * self.scene_columns + 1, LEAST_COLUMNS)

    @property
    def scene_columns(self) -> int:
        """Return how many characters a scene is wide; they are twice as high as wide."""
        return round(2 * self.rows * VIEW_PX[0] / VIEW_PX[1])


def layout(devices: int, methods: int, width: int, height: int) -> Layout:
    """Return what fits: as many devices as possible that can be made out, one at least."""
    found = None
    for shown in range(devices, 0, -1):
        found = max(
            (
                _fitted(shown, methods, across, width, height)
                for across in range(1, shown * methods + 1)
            ),
            key=lambda one: one.rows,
        )
        if found.rows >= LEAST_ROWS:
            return found
    assert found is not None
    return found


def _fitted(devices: int, methods: int, across: int, width: int, height: int) -> Layout:
    """Return the largest scenes with which so many panels fit beside each other."""
    lines = math.ceil(devices * methods / across)
    for rows in range(MOST_ROWS, 1, -1):
        one = Layout(devices, across, rows)
        high = NOTES + 1 + lines * (rows + CAPTIONS)  # the last line of a terminal stays free
        if across * (one.columns + GAP) - GAP <= width and high <= height - 1:
            return one
    return Layout(devices, across, 1)


def play(pictures: Pictures, fps: int) -> None:
    """Show the animation in the terminal, as coloured half blocks."""
    with Live(refresh_per_second=fps, transient=False) as live:
        for k in pictures.steps:
            started_s = time.monotonic()
            live.update(terminal_picture(pictures, k, *live.console.size))
            time.sleep(max(0.0, 1 / fps - (time.monotonic() - started_s)))


def terminal_picture(pictures: Pictures, k: int, width: int, height: int) -> Group:
    """Return one picture as rich text and tables for a terminal of so many characters."""
    laid = layout(pictures.devices, len(pictures.films), width, height)
    panels = [
        (_scenes(pictures, shot, device, k, laid), _captions(pictures, shot, device, k, laid))
        for shot in pictures.films
        for device in range(laid.devices)
    ]
    some = f"{laid.devices} of {pictures.devices} devices fit here   "
    some *= laid.devices < pictures.devices
    time_ms = 1e3 * k * pictures.kind.step_s
    parts: list[Text | Table] = [
        Text(
            f"{time_ms:.0f} ms   {some}{pictures.link.label}{pictures.link.late}",
            style="dim",
            no_wrap=True,
            overflow="crop",
        ),
        _legend(pictures),
    ]
    for first in range(0, len(panels), laid.across):
        table = Table.grid(padding=(0, GAP, 0, 0))
        row = panels[first : first + laid.across]
        for _ in row:
            table.add_column(width=laid.columns, no_wrap=True, overflow="crop")
        table.add_row(*(scene for scene, _ in row))
        table.add_row(*(caption for _, caption in row))
        parts.append(table)
    return Group(*parts)


def _legend(pictures: Pictures) -> Text:
    """Say what stands where, and what the marks of packets mean."""
    text = Text("left true, right believed   ", style="dim", no_wrap=True, overflow="crop")
    text.append("█", style=_rgb(ARRIVED)).append(" packet   ")
    if pictures.link.sends_always:
        text.append("·", style=_rgb(LOST)).append(" lost   ")
    else:
        text.append("· none sent   ")
    if pictures.flags:
        text.append("█", style=_rgb(FLAGGED)).append(" unfamiliar   ")
    return text


def _rgb(colour: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)


def _captions(pictures: Pictures, shot: Film, device: int, k: int, laid: Layout) -> Text:
    """Say whose device it is, what came of late, a character per picture, age, SNR and error."""
    columns, score = laid.columns, shot.score[: k + 1].mean()
    text, delivered = Text(), pictures.link.delivered[:, device]
    for back in range(columns - 1, -1, -1):
        end = k + 1 - back * pictures.every
        start = max(end - pictures.every, 0)
        if end < 1:
            text.append(" ")
        elif delivered[start:end].any():
            strange = shot.flagged is not None and shot.flagged[start:end, device].any()
            text.append("█", style=_rgb(FLAGGED if strange else ARRIVED))
        else:
            text.append("·", style=_rgb(LOST) if pictures.link.sends_always else "dim")
    whose = f" {device}" if pictures.devices > 1 else ""
    text.append(f"\n{shot.method}{whose}, {score:.0%} in band", style="bold")
    snr_db = pictures.link.snr_db[k, device]
    text.append(f"\n{pictures.age(device, k).removeprefix('packet ')}, {snr_db:.0f} dB")
    text.append(f"\n{pictures.error(shot, device, k)}", style="dim")
    return text


def _scenes(pictures: Pictures, shot: Film, device: int, k: int, laid: Layout) -> Text:
    """Return truth and belief beside each other: a character shows two pixels of a column."""
    size = laid.scene_columns, 2 * laid.rows
    shown = [
        np.asarray(scene.resize(size, Image.Resampling.BOX))
        for scene in pictures.scenes(shot, device, k)
    ]
    text = Text()
    for row in range(laid.rows):
        for place, pixels in enumerate(shown):
            text.append(" " * place)
            for above, below in zip(*pixels[2 * row : 2 * row + 2].tolist(), strict=True):
                text.append("▀", style=f"{_rgb(tuple(above))} on {_rgb(tuple(below))}")
        text.append("\n")
    text.rstrip()
    return text
