"""The paper's Fig. 3 from measured curves: error, bits and score of every method side by side.

Two columns of a paper wide (7.16 in). In (a) and (c) the narrow panel on the left is the case
without prediction, a packet at every step; the wide one shows what happens when packets are few.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from hjepa_cli.output.figures import RC, ZERO_ERROR, draw_line, method_style

WIDTH_IN, HEIGHT_IN = 7.16, 3.0

Entries = Mapping[str, Mapping[str, Any]]


def comparison_figure(
    entries: Entries, *, acceptable_score: float, step_s: float, title: str = ""
) -> Figure:
    """Draw (a) NMAE, (b) bits per transmission and (c) normalised score, with 95 % intervals.

    Args:
        entries: of ``eval --json``, by method.
        acceptable_score: drawn as a level in (c).
        step_s: length of a control step.
        title: one line above the panels.
    """
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), layout="constrained")
        figure.suptitle(title, fontsize=RC["axes.titlesize"])
        error, bits, score = figure.subfigures(1, 3, width_ratios=(3, 1.5, 3))
        step_ms = 1e3 * step_s
        _error_panels(error, entries, step_ms)
        _bits_panel(bits, entries)
        _score_panels(score, entries, step_ms, acceptable_score)
        lines: dict[str, Any] = {}
        for axes in figure.axes:
            lines |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        handles = [lines[name] for name in entries if name in lines]
        labels = [name for name in entries if name in lines]
        figure.legend(
            handles, labels, loc="outside lower center", ncols=7, frameon=False, handlelength=2.4
        )
        return figure


def _error_panels(figure: SubFigure, entries: Entries, step_ms: float) -> None:
    """(a): control error with a packet at every step, and over the time since the only packet."""
    at_once, later = _pair(figure)
    shown = {name: entry for name, entry in entries.items() if max(entry["nmae"]) > ZERO_ERROR}
    _points(at_once, shown, list(entries), "nmae_every_step", "nmae_every_step_ci95")
    for name, entry in shown.items():
        errors = np.array(entry["nmae"], float)
        band = np.array(entry["nmae_ci95"], float)
        draw_line(later, name, list(entries), step_ms * np.arange(len(errors)), errors, band)
    at_once.set_yscale("log")
    at_once.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    at_once.yaxis.set_minor_formatter(NullFormatter())
    at_once.set_ylabel("NMAE of the force")
    later.set_xlabel("Time since the packet (ms)")
    later.set_title("(a) control error")


def _bits_panel(figure: SubFigure, entries: Entries) -> None:
    """(b): what a transmission costs."""
    axes = figure.subplots()
    sending = {
        name: entry["bits_per_transmission"]
        for name, entry in entries.items()
        if entry["bits_per_transmission"]
    }
    names = list(sending)[::-1]
    colours = [method_style(name, list(entries)).colour for name in names]
    axes.barh(names, [sending[name] for name in names], color=colours, height=0.7)
    axes.set_xscale("log")
    axes.set_xlim(left=10)
    axes.tick_params(axis="y", length=0, labelsize=6)
    axes.xaxis.set_major_locator(LogLocator(numticks=4))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set_xlabel("Bits per transmission")
    axes.set_title("(b) communication cost")
    axes.grid(visible=True, axis="x")


def _score_panels(figure: SubFigure, entries: Entries, step_ms: float, acceptable: float) -> None:
    """(c): normalised control score with a packet at every step, and against the gap."""
    at_once, later = _pair(figure)
    _points(at_once, entries, list(entries), "score", "score_ci95")
    for name, entry in entries.items():
        curve = entry["gap_curve"]
        if entry["tolerance_gap_steps"] is None or len(curve) < 2:
            continue  # no link to be sparse: a line at its score
        where = step_ms * np.array([point["d"] for point in curve], float)
        scores = np.array([point["score"] for point in curve], float)
        band = np.array([point["ci95"] for point in curve], float)
        draw_line(later, name, list(entries), where, scores, band)
    for axes in (at_once, later):
        axes.axhline(acceptable, color="black", linewidth=0.6, linestyle=(0, (6, 3)))
    at_once.set_ylim(bottom=0)
    at_once.set_ylabel("Normalised control score")
    later.set_xscale("log")
    later.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    later.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    later.xaxis.set_minor_formatter(NullFormatter())
    later.tick_params(axis="x", labelsize=6)
    later.set_xlabel("Time between packets (ms)")
    later.set_title("(c) control score")


def _pair(figure: SubFigure) -> tuple[Axes, Axes]:
    """A narrow panel for packets at every step beside a wide one, with one vertical axis."""
    at_once, later = figure.subplots(1, 2, sharey=True, width_ratios=(1, 2.6))
    at_once.set_xticks([])
    at_once.set_xlabel("packet at\nevery step")
    for axes in (at_once, later):
        axes.grid(visible=True)
    return at_once, later


def _points(
    axes: Axes, entries: Entries, methods: Sequence[str], value: str, interval: str
) -> None:
    """One mark with its 95 % interval per method that has the value, side by side."""
    for place, (name, entry) in enumerate(entries.items()):
        if value not in entry:
            continue  # measured by a version that did not take it
        style = method_style(name, list(methods))
        low, high = entry[interval]
        axes.errorbar(
            [place],
            [entry[value]],
            yerr=[[max(entry[value] - low, 0)], [max(high - entry[value], 0)]],
            color=style.colour,
            marker=style.marker,
            markerfacecolor="white" if style.hollow else style.colour,
            markersize=3.5,
            elinewidth=0.9,
        )
