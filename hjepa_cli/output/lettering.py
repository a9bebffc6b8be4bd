"""Letters of a figure neither collide nor repeat: numbers at ticks, names at the ends of lines."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from hjepa_cli.core.arrays import Floats

NAME_PT, NOTE_PT = 7, 6
LINE_HEIGHT = 1.2
AWAY = 0.05  # of a panel's width, from its edge to the names
SAME = 0.02  # of a panel's height: lines no further apart anywhere are drawn on each other
LIES_ON = "≈ overlaps the line of the label above it"
DIGIT_PT = 0.7  # of a letter's size, about
APART_PT = 5  # between the numbers at two ticks


@dataclasses.dataclass(frozen=True)
class Named:
    """A line that is drawn has this name; ``x`` and ``y`` are its points that can be seen."""

    text: str
    colour: str
    x: Floats
    y: Floats


def name_ends(figure: Figure, axes: Axes, lines: Sequence[Named], notes: Sequence[str]) -> None:
    """Write the name of each line at its right end, in its colour, and notes below the figure.

    Names that would collide are moved apart, each with a thin line to its own. A line that cannot
    be told from the one named above it is marked so, and a note says what the mark means.
    """
    lines = [line for line in lines if len(line.x)]
    reached = [_fractions(axes, line) for line in lines]
    ends = [curve[-1, 1] for curve in reached]
    highest = sorted(
        range(len(lines)),
        key=lambda one: (-round(ends[one] / SAME), -reached[one][:, 1].mean()),
    )
    lying: list[bool] = []
    upper = None  # the last line that lies on no other
    for one in highest:
        lying.append(upper is not None and _same(reached[upper], reached[one]))
        upper = upper if lying[-1] else one
    notes = [*notes, *([LIES_ON] if any(lying) else [])]
    if notes:
        note(figure, "; ".join(notes))
    written: list[Any] = []
    for one, on_another in zip(highest, lying, strict=True):
        line = lines[one]
        written.append(
            axes.annotate(
                f"≈ {line.text}" if on_another else line.text,
                (line.x[-1], line.y[-1]),
                (1 + AWAY, 0.5),
                textcoords="axes fraction",
                color=line.colour,
                fontsize=NAME_PT,
                va="center",
                annotation_clip=False,
                arrowprops={
                    "arrowstyle": "-",
                    "color": line.colour,
                    "linewidth": 0.5,
                    "shrinkA": 0,
                    "shrinkB": 0,
                    "relpos": (0, 0.5),
                },
                bbox={"pad": 0.5, "facecolor": "none", "edgecolor": "none"},  # the line ends there
            )
        )
    tidy(figure)
    figure.draw_without_rendering()  # only a layout knows how high the panel is
    height_pt = axes.bbox.height * 72 / figure.dpi
    apart = LINE_HEIGHT * NAME_PT / height_pt
    wanted = np.minimum.accumulate([ends[one] for one in highest]).tolist() if highest else []
    for name, at in zip(written, spread(wanted, apart), strict=True):
        name.set_position((1 + AWAY, at))


def note(figure: Figure, text: str) -> None:
    """Write a line of small letters below a figure, once."""
    if text in (legend.get_title().get_text() for legend in figure.legends):
        return
    figure.legend(
        [],
        [],
        title=text,
        title_fontsize=NOTE_PT,
        loc="outside lower center",
        borderaxespad=0,
        borderpad=0.1,
    )


def spread(wanted: Sequence[float], apart: float) -> list[float]:
    """Return places near those wanted, given from the highest down, at least so far apart.

    They stay between 0 and 1 as far as they have room there; the sum of squared moves is least.
    """
    count = len(wanted)
    blocks: list[list[float]] = []  # sum and number of what moves together
    for place, value in enumerate(wanted):
        blocks.append([value + place * apart, 1])
        while len(blocks) > 1 and blocks[-2][0] / blocks[-2][1] < blocks[-1][0] / blocks[-1][1]:
            total, number = blocks.pop()
            blocks[-1] = [blocks[-1][0] + total, blocks[-1][1] + number]
    high, low = 1 - apart / 2, (count - 0.5) * apart
    if low > high:  # more than there is room for: around the middle
        high = low = (1 + low) / 2
    found: list[float] = []
    for total, number in blocks:
        found += [min(max(total / number, low), high)] * int(number)
    return [value - place * apart for place, value in enumerate(found)]


def _fractions(axes: Axes, line: Named) -> Floats:
    """Return a line's points in shares of the panel ``[points, 2]``, its end inside of it."""
    points = axes.transData.transform(np.column_stack([line.x, line.y]))
    shares = axes.transAxes.inverted().transform(points)
    shares = shares[np.argsort(shares[:, 0], kind="stable")]
    return np.asarray(np.clip(np.nan_to_num(shares, neginf=0.0), -0.02, 1.02))


def _same(one: Floats, other: Floats) -> bool:
    """Return whether two lines, as shares of the panel, cannot be told apart."""
    alike = one.shape == other.shape and np.allclose(one[:, 0], other[:, 0])
    return bool(alike and np.abs(one[:, 1] - other[:, 1]).max() <= SAME)


def tidy(figure: Figure) -> None:
    """Choose the ticks of logarithmic axes, where nobody has, so that the numbers have room."""
    figure.draw_without_rendering()
    for axes in figure.axes:
        box = axes.bbox
        for axis, length in ((axes.xaxis, box.width), (axes.yaxis, box.height)):
            if axis.get_scale() == "log" and not isinstance(axis.get_major_locator(), FixedLocator):
                across = axis is axes.xaxis
                _log_ticks(axis, length * 72 / figure.dpi, across=across)


def _log_ticks(axis: Axis, length_pt: float, *, across: bool) -> None:
    """Set the ticks of an axis so long: 1, 2, 5 in each decade, or 1 alone, or of every second."""
    low, high = sorted(axis.get_view_interval())
    size_pt = _letters_pt(axis)
    decades = max(math.log10(high / low), 1e-9)
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    inside = low * (1 - 1e-9), high * (1 + 1e-9)
    for subs, every in (((1, 2, 5), 1), ((1, 3), 1), ((1,), 1), ((1,), 2), ((1,), 4)):
        ticks = max(
            (
                [sub * 10.0**power for power in powers if power % every == first for sub in subs]
                for first in range(every)
            ),
            key=lambda ticks: sum(inside[0] <= tick <= inside[1] for tick in ticks),
        )
        ticks = [tick for tick in ticks if inside[0] <= tick <= inside[1]]
        if len(ticks) < 2 and decades < 1:  # between two of them
            ticks = [tick for tick in MaxNLocator(4).tick_values(low, high) if low <= tick <= high]
        places = [math.log10(tick / low) / decades * length_pt for tick in ticks]
        widths = [DIGIT_PT * size_pt * len(_plain(tick)) if across else size_pt for tick in ticks]
        gaps = [
            right - left - (before + after) / 2
            for left, right, before, after in zip(
                places, places[1:], widths, widths[1:], strict=False
            )
        ]
        if all(gap >= (APART_PT if across else APART_PT / 2) for gap in gaps):
            break
    else:
        ticks = ticks[:1]
    axis.set_major_formatter(FuncFormatter(lambda value, _: _plain(value)))
    axis.set_minor_formatter(NullFormatter())
    axis.set_minor_locator(LogLocator(subs=tuple(range(2, 10))))
    if ticks:
        axis.set_ticks(ticks)


def _plain(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:g}"


def _letters_pt(axis: Axis) -> float:
    labels = axis.get_ticklabels()
    return float(labels[0].get_fontsize()) if labels else float(NAME_PT)


def count_ticks(axis: Axis) -> None:
    """Number a linear axis of counts by whole numbers, none of them twice."""
    axis.set_major_locator(MaxNLocator(nbins="auto", integer=True))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
