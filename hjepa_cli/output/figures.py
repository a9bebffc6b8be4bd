"""Figures are for papers: a column wide or two, readable in black and white, equal byte for byte.

This is the only module that imports matplotlib (extra ``plot``). Figures are built without pyplot,
so no display, backend or global state is involved.
"""

# ruff: noqa: E402 (matplotlib is imported with care)
import contextlib
import io
import itertools
import os
from collections.abc import Mapping, Sequence, Sized
from pathlib import Path
from typing import Any

import numpy as np

# matplotlib cannot be imported where MPLBACKEND names the backend of a notebook that is not
# installed here. None is used for files; whoever shows figures in this process still gets theirs.
_wanted = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib
finally:
    if _wanted is not None:
        os.environ["MPLBACKEND"] = _wanted
if _wanted is not None:
    with contextlib.suppress(ValueError):
        matplotlib.rcParams["backend"] = _wanted
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import ArrayLike

from hjepa_cli.core.plants.stress import CONDITIONS
from hjepa_cli.core.style import PLAIN, Style
from hjepa_cli.errors import UsageError
from hjepa_cli.plugins import LAWS, METHODS, SCHEDULERS
from hjepa_cli.storage.files import write_bytes

WIDTH_IN, TWO_COLUMNS_IN = 3.5, (7.16, 3.0)  # of an IEEE page
DPI = 300
MARKERS = 8  # per line at most
ZERO_ERROR = 1e-5  # NMAE below which a method plays what the teacher plays
RC: dict[Any, Any] = {
    **dict.fromkeys(("font.size", "axes.labelsize"), 8),
    **dict.fromkeys(("axes.titlesize", "legend.fontsize", "xtick.labelsize", "ytick.labelsize"), 7),
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.5,
    "lines.linewidth": 1.1,
    "pdf.fonttype": 42,  # TrueType: IEEE refuses Type 3
    "svg.hashsalt": "hjepa",  # element ids depend on the content only
}
# Dates would make two runs differ.
METADATA: dict[str, Any] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
THOUSANDS = FuncFormatter(lambda value, _: f"{value:,.0f}")

Entries = Mapping[str, Mapping[str, Any]]
"""Entries of ``eval --json`` by method."""

OTHERS = [Style("#7F7F7F", marker, ":") for marker in "<>phd*PX"]
LINES = (  # of a training, whose losses are drawn like these
    *("hjepa", "ts-jepa-1", "ts-jepa-4", "hold", "zero", "oracle", "hold-true", "zero-true"),
    *("ts-jepa-2", "ts-jepa-3", "ts-jepa-5", "supervised-2", "supervised-4", "autoencoder-2"),
)
STRESS_COLUMNS = 6  # panels beside each other
GAP_STYLES = [Style("#0072B2", "o"), Style("#D55E00", "s", "--"), Style("#009E73", "^", "-.")]
LONGEST_OF_THREE = 15  # characters of a label, for three columns of a legend


def scale_figure(result: Mapping[str, Any], *, title: str = "") -> Figure:
    """Draw the counts of ``scale --json``: by scheduler where there are some, else by method."""
    if any("scheduler" in row for row in result["rows"]):
        return schedulers_figure(result["rows"], title=title)
    law = result["law"]  # of a plugin, perhaps, that was in force there and is not here
    snr_label = LAWS[law].snr_label if law in LAWS else "SNR (dB)"
    return devices_figure(result["rows"], title=title, snr_label=snr_label)


@matplotlib.rc_context(RC)
def devices_figure(
    rows: Sequence[Mapping[str, Any]], *, title: str = "", snr_label: str = "Target SNR (dB)"
) -> Figure:
    """Draw supported devices against the SNR, one line per method, as the paper's Fig. 4.

    The rows, of ``scale --json``, have ``snr_db``, ``method``, ``devices`` and ``devices_ci95``.
    Methods that support nobody anywhere are named in the legend only; ``at_least`` is, too.
    """
    figure, axes = _panel()
    curves = _curves(rows)
    bounds = {row["method"] for row in rows if row.get("at_least")}
    for method, points in sorted(curves.items(), key=lambda item: -item[1][-1, 1]):
        snr_db, devices = points[:, 0], points[:, 1]
        label = method if devices.any() else f"{method} (0)"
        label += " (at least)" if method in bounds else ""
        seen = np.where(devices > 0, devices, np.nan)
        draw_line(axes, method, list(curves), snr_db, seen, points[:, 2:], label, scale=1.0)
    _scale_counts(axes, [row for row in rows if row["devices"]])
    axes.set_xlabel(snr_label)
    axes.set_ylabel("Supported devices")
    _snr_ticks(axes, rows)
    axes.set_title(title)
    _finish(figure, axes)
    return figure


@matplotlib.rc_context(RC)
def survival_figure(result: Mapping[str, Any], *, title: str = "") -> Figure:
    """Draw the curves of ``survive --json``: the share of loops lost against the gap.

    Points in which none was lost lie at the lower edge, with their interval.
    """
    figure, axes = _panel()
    step_ms, loops = 1e3 * result["step_s"], result["n_loops"]
    floor = 0.3 / loops
    methods = list(dict.fromkeys(curve["method"] for curve in result["curves"]))
    several = len({curve["interval_steps"] for curve in result["curves"]}) > 1
    for curve in result["curves"]:
        gaps_ms = np.array([point["gap_steps"] * step_ms for point in curve["points"]])
        lost = np.array([point["p_lost"] for point in curve["points"]])
        ends = np.array([point["p_lost_ci95"] for point in curve["points"]])
        label = curve["method"]
        if several:
            label += f", every {curve['interval_steps'] * step_ms:g} ms"
        shown = np.maximum(lost, floor)
        draw_line(axes, curve["method"], methods, gaps_ms, shown, ends, label, scale=1.0)
    axes.set_yscale("log")
    axes.set_ylim(floor, 1.5)
    axes.set_xlabel("Gap between two packets (ms)")
    axes.set_ylabel("Loops lost")
    axes.set_title(title)
    _finish(figure, axes)
    return figure


@matplotlib.rc_context(RC)
def schedulers_figure(rows: Sequence[Mapping[str, Any]], *, title: str = "") -> Figure:
    """Draw rows of ``scale --law scheduled --json``: devices against the SNR, a panel per method.

    Schedulers lie side by side at each SNR, so that intervals of equally good ones stay apart.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    drawn = dict.fromkeys(row["scheduler"] for row in rows)
    schedulers = sorted(drawn, key=lambda name: [*SCHEDULERS, *drawn].index(name))
    apart_db = 0.06 * min(np.diff(sorted({row["snr_db"] for row in rows})), default=1.0)
    figure, panels = _panels(len(methods), 0.9 + 1.5 * len(methods))
    for axes, method in zip(panels, methods, strict=True):
        for place, scheduler in enumerate(schedulers):
            mine = [r for r in rows if (r["method"], r["scheduler"]) == (method, scheduler)]
            snr_db, *devices = _curves(mine)[method].T
            snr_db = snr_db + apart_db * (place - len(schedulers) / 2 + 0.5)
            style = SCHEDULERS[scheduler].style if scheduler in SCHEDULERS else PLAIN
            looks = {"linestyle": style.line, "linewidth": 0.7, "capsize": 1.5}
            draw_bars(axes, style, snr_db, *devices, label=scheduler, **looks)
        most = max(row["devices_ci95"][1] for row in rows if row["method"] == method)
        axes.set_ylim(0, 1.1 * most or 1)  # the highest interval ends below the frame
        axes.yaxis.set_major_formatter(THOUSANDS)
        axes.set_ylabel("Devices")
        axes.annotate(method, (0.02, 0.96), xycoords="axes fraction", va="top", fontweight="bold")
        axes.grid(visible=True, axis="y")
    panels[0].set_title(title)
    panels[-1].set_xlabel("Target SNR (dB)")
    _snr_ticks(panels[-1], rows)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as .png, .svg or .pdf, atomically; equal figures give equal bytes."""
    kind = path.suffix.removeprefix(".")
    if kind not in METADATA:
        raise UsageError(f"no figure format '{path.suffix}'; choose one of .png, .svg, .pdf")
    write_bytes(path, encoded(figure, kind))
    return path


def has_curves(figure: Figure) -> bool:
    """Return whether anything is drawn that a legend would name."""
    return any(axes.get_legend_handles_labels()[1] for axes in figure.axes)


@matplotlib.rc_context(RC)
def encoded(figure: Figure, kind: str) -> bytes:
    """Return a figure as ``"png"``, ``"svg"`` or ``"pdf"``."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=DPI, metadata=METADATA[kind])
    return buffer.getvalue()


def _curves(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Return rows by method as arrays [points, (snr, devices, low, high)], ascending in SNR."""
    curves: dict[str, list[list[float]]] = {}
    for row in rows:
        if row["devices"] is not None:
            point = [row["snr_db"], row["devices"], *row["devices_ci95"]]
            curves.setdefault(row["method"], []).append(point)
    return {method: np.array(sorted(points), float) for method, points in curves.items()}


def method_style(method: str, methods: list[str]) -> Style:
    """Return how a method is drawn; ``methods`` are all of the figure: none shares a marker."""
    own = {name: METHODS[name].style for name in methods if name in METHODS}
    others = [name for name in methods if not own.get(name)]
    return own.get(method) or OTHERS[others.index(method) % len(OTHERS)]


def _scale_counts(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Set a logarithmic axis where methods lie over a decade apart at one SNR, else from zero."""
    at: dict[float, list[int]] = {}
    for row in rows:
        at.setdefault(row["snr_db"], []).append(row["devices"])
    least = min((row["devices"] for row in rows), default=1)
    most = max((row["devices_ci95"][1] for row in rows), default=1)
    if any(max(counts) > 10 * min(counts) for counts in at.values()):
        axes.set_yscale("log", nonpositive="clip")
        axes.set_ylim(0.7 * least, 1.5 * most)
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(0, 1.1 * most)
    axes.yaxis.set_major_formatter(THOUSANDS)


@matplotlib.rc_context(RC)
def score_figure(entries: Entries, kind: str, *, acceptable_score: float, step_s: float) -> Figure:
    """Draw the normalised score against the link, one line per method with its 95 % band.

    The link is the time between packets (``kind`` ``"gap"``) or p (``"delivery"``).
    """
    figure, axes = _panel()
    where = {"xycoords": ("axes fraction", "data"), "textcoords": "offset points"}
    text, point = f"acceptable: {acceptable_score:g}", (0.01, acceptable_score)
    axes.annotate(text, point, xytext=(2, 2), fontsize=6, **where)
    draw_scores(axes, entries, kind, acceptable_score, step_s)
    if kind == "delivery":
        axes.set_xlabel("Delivery probability of a slot")
        axes.invert_xaxis()
    axes.set_ylabel("Normalised control score")
    axes.set_ylim(bottom=0)
    _finish(figure, axes)
    return figure


@matplotlib.rc_context(RC)
def error_figure(entries: Entries, *, step_s: float) -> Figure:
    """Draw the NMAE after a single packet against the time since it, with 95 % bands."""
    figure, axes = _panel()
    draw_errors(axes, entries, step_s)
    shown = np.concatenate([line.get_ydata() for line in axes.lines] or [np.ones(1)])
    axes.set_ylim(bottom=0.5 * shown[shown > ZERO_ERROR].min())
    axes.set_xlabel("Time since the only packet (ms)")
    axes.set_ylabel("NMAE of the force")
    _finish(figure, axes)
    return figure


@matplotlib.rc_context(RC)
def wire_figure(result: Mapping[str, Any]) -> Figure:
    """Draw ``bench-link --json``: answers by their age, device-steps by who drove."""
    figure = Figure(figsize=(WIDTH_IN, 3.0), layout="constrained")
    left, right = figure.subplots(2, 1)
    ages = {int(age): count for age, count in result["ages"].items()}
    answers = max(sum(ages.values()), 1)
    left.bar(list(ages), [count / answers for count in ages.values()], color="#0072B2")
    left.set_xlabel("Steps from picture to force")
    left.set_ylabel("Share of answers")
    driven = {name: count for name, count in result["sources"].items() if count}
    steps = max(sum(driven.values()), 1)
    names = list(driven)
    right.barh(names, [driven[name] / steps for name in names], color="#0072B2")
    right.set_xlabel("Share of device-steps")
    right.set_xlim(0, 1)
    for axes in (left, right):
        axes.grid(False)
    return figure


@matplotlib.rc_context(RC)
def training_figure(rows: Sequence[Mapping[str, str]]) -> Figure:
    """Draw a training run's ``metrics.csv``: losses, and health where it was measured.

    The rows, as :class:`csv.DictReader` gives them, have ``step`` and either ``loss_…`` and
    ``probe_r2_…``, or ``level`` and ``loss``.
    """
    losses, health = _series(rows, "loss"), _series(rows, "probe_r2")
    figure, panels = _panels(1 + bool(health), 2.6 + 1.4 * bool(health))
    for axes, lines, label in zip(panels, (losses, health), ("Loss", "Probe R²"), strict=False):
        for like, (name, points) in zip(itertools.cycle(LINES), lines.items()):
            style = METHODS[like].style
            axes.plot(
                *np.array(points).T,
                color=style.colour,
                linestyle=style.line,
                marker=style.marker,
                markerfacecolor="none",
                markersize=4,
                markevery=_every(points),
                label=name,
            )
        axes.set_ylabel(label)
        axes.grid(visible=True)
        axes.legend(fontsize=6, ncols=2)
    if all(value > 0 for points in losses.values() for _, value in points):
        panels[0].set_yscale("log")
    panels[-1].set_xlabel("Training step")
    return figure


def _series(rows: Sequence[Mapping[str, str]], prefix: str) -> dict[str, list[tuple[float, float]]]:
    """Return columns of ``metrics.csv`` by name without prefix; by level, if there are any."""
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for column, text in row.items():
            if column.startswith(prefix) and text:
                name = row.get("level") or column.removeprefix(prefix).strip("_") or column
                series.setdefault(name, []).append((float(row["step"]), float(text)))
    return series


def draw_scores(
    axes: Axes, entries: Entries, kind: str, acceptable_score: float, step_s: float
) -> None:
    """Draw the scores of all methods with a link; see :func:`score_figure`."""
    axes.axhline(acceptable_score, color="black", linewidth=0.6, linestyle=(0, (6, 3)))
    for method, entry in entries.items():
        curve = entry[f"{kind}_curve"]
        if len(curve) < 2 or entry["tolerance_gap_steps"] is None:
            continue  # a method without a link (optimal) is a line at its score
        where = [1e3 * step_s * point["d"] if kind == "gap" else point["p"] for point in curve]
        scores, band = ([point[key] for point in curve] for key in ("score", "ci95"))
        draw_line(axes, method, list(entries), where, scores, band)
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    plain_ticks(axes.xaxis)
    axes.set_xlabel("Time between packets (ms)")


def draw_errors(axes: Axes, entries: Entries, step_s: float) -> None:
    """Draw the NMAE of all methods that make an error; see :func:`error_figure`."""
    for method, entry in entries.items():
        if max(entry["nmae"]) > ZERO_ERROR:  # not oracle and optimal, which know the future
            time_ms = 1e3 * step_s * np.arange(len(entry["nmae"]))
            draw_line(axes, method, list(entries), time_ms, entry["nmae"], entry["nmae_ci95"])
    axes.set_yscale("log")
    plain_ticks(axes.yaxis)


def draw_line(
    axes: Axes, method: str, methods: list[str], where: ArrayLike, value: ArrayLike,
    band: ArrayLike, label: str | None = None, scale: float = 0.9,
) -> None:  # fmt: skip
    """Draw one method's line, markers and 95 % band [points, 2] over ``where``."""
    style = method_style(method, methods)
    where, value, band = (np.array(values, float) for values in (where, value, band))
    every, looks = _every(where), style.looks(scale)
    axes.plot(where, value, markevery=every, label=label or method, **looks)
    if len(where) > 1:
        axes.fill_between(where, *band.T, color=style.colour, alpha=0.18, linewidth=0)
    else:
        axes.vlines(where, *band.T, color=style.colour)


def draw_bars(
    axes: Axes, style: Style, where: Any, value: Any, low: Any, high: Any, **looks: Any
) -> None:
    """Draw marks with their intervals as bars."""
    axes.errorbar(
        where,
        value,
        yerr=np.maximum([np.subtract(value, low), np.subtract(high, value)], 0),
        color=style.colour,
        marker=style.marker,
        markerfacecolor="white" if style.hollow else style.colour,
        markersize=3.5,
        elinewidth=0.9,
        **looks,
    )


def plain_ticks(axis: Axis) -> None:
    """Label a logarithmic axis with plain numbers, its minor ticks with none."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def _every(points: Sized) -> int:
    """Return how many points share a marker."""
    return max(-(-len(points) // MARKERS), 1)


def _panel() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
    return figure, figure.add_subplot()


def _panels(count: int, height_in: float) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(WIDTH_IN, height_in), layout="constrained")
    return figure, figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]


def _snr_ticks(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    grid_db = sorted({row["snr_db"] for row in rows})
    if len(grid_db) <= MARKERS:
        axes.set_xticks(grid_db)


def _finish(figure: Figure, axes: Axes) -> None:
    """Add grid and a legend of as many columns as a paper's column has room for."""
    axes.grid(visible=True)
    if has_curves(figure):
        longest = max(len(label) for label in axes.get_legend_handles_labels()[1])
        ncols = 3 if longest <= LONGEST_OF_THREE else 2
        figure.legend(loc="outside lower center", ncols=ncols)


@matplotlib.rc_context(RC)
def stress_figure(stress: Mapping[str, Any], *, title: str = "") -> Figure:
    """Draw ``stress`` of ``eval --json``: score ÷ nominal score against severity, by condition.

    There is a line for each gap of the only method, or for each method at the middle gap; and a
    panel for each condition, the last one for conditions that are composed of several.
    """
    methods, gaps = list(stress["methods"]), stress["gaps"]
    lines = [(methods[0], number) for number in range(len(gaps))]
    if len(methods) > 1:
        lines = [(method, len(gaps) // 2) for method in methods]
    panels: dict[str, list[tuple[str, int]]] = {}
    for place, text in enumerate(stress["conditions"]):
        name, _, severity = text.partition("=")
        alone = "+" not in text
        panels.setdefault(name if alone else "", []).append((severity if alone else text, place))
    panels = dict(sorted(panels.items(), key=lambda item: not item[0]))
    columns = min(len(panels), STRESS_COLUMNS)
    rows = -(-len(panels) // columns)
    figure = Figure(figsize=(TWO_COLUMNS_IN[0], 0.9 + 1.35 * rows), layout="constrained")
    figure.suptitle(title, fontsize=RC["axes.titlesize"])
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    for axes, (name, severities) in zip(grid.flat, panels.items(), strict=False):
        nominal = CONDITIONS[name].nominal if name in CONDITIONS else None
        for line, (method, gap) in enumerate(lines):
            style = method_style(method, methods) if len(methods) > 1 else GAP_STYLES[line % 3]
            entry = stress["methods"][method]
            points = [(place, entry["rows"][place]["points"][gap]) for _, place in severities]
            where = [float(at) for at, _ in severities] if name else [*range(len(severities))]
            marks = [
                (at, point["relative"], *(point["relative_ci95"] or (None, None)))
                for at, (_, point) in zip(where, points, strict=True)
            ]
            marks = sorted(mark for mark in marks if mark[1] is not None)
            if name and nominal is not None and nominal <= CONDITIONS[name].high:
                marks = sorted([*marks, (nominal, 1.0, 1.0, 1.0)])
            label = f"{method}, " * (len(methods) > 1) + f"D = {gaps[gap]}"
            if marks:
                at, value, low, high = np.array(marks, float).T
                if not name:
                    at = at + 0.15 * (line - (len(lines) - 1) / 2)
                looks = {"linestyle": style.line if name else "none", "linewidth": 0.9}
                draw_bars(axes, style, at, value, low, high, label=label, **looks)
        axes.axhline(1, color="black", linewidth=0.5)
        axes.set_ylim(0, 1.15)
        axes.set_title(name.replace("_", " ") or "several together", fontsize=7)
        axes.tick_params(labelsize=6)
        if not name:
            axes.set_xlim(-0.5, len(severities) - 0.5)
            axes.set_xticks(range(len(severities)), [text for text, _ in severities], rotation=20)
        axes.grid(visible=True)
    for axes in grid[:, 0]:
        axes.set_ylabel("÷ nominal", fontsize=7)
    handles = dict(zip(*reversed(grid.flat[0].get_legend_handles_labels()), strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=7)
    return figure


@matplotlib.rc_context(RC)
def comparison_figure(
    entries: Entries, *, acceptable_score: float, step_s: float, title: str = ""
) -> Figure:
    """Draw the paper's Fig. 3: (a) NMAE, (b) bits per transmission, (c) score, with 95 % intervals.

    In (a) and (c) the narrow panel on the left is the case without prediction, a packet at every
    step; the wide one shows what happens when packets are few.
    """
    figure = Figure(figsize=TWO_COLUMNS_IN, layout="constrained")
    figure.suptitle(title, fontsize=RC["axes.titlesize"])
    error, bits, score = figure.subfigures(1, 3, width_ratios=(3, 1.5, 3))
    _error_panels(error, entries, step_s)
    _bits_panel(bits, entries)
    _score_panels(score, entries, step_s, acceptable_score)
    lines: dict[str, Any] = {}
    for axes in figure.axes:
        lines |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    shown = {name: lines[name] for name in entries if name in lines}
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=7)
    return figure


def _error_panels(figure: SubFigure, entries: Entries, step_s: float) -> None:
    """Draw (a): control error with a packet at every step, and over the time since the only one."""
    at_once, later = _pair(figure)
    shown = {name: entry for name, entry in entries.items() if max(entry["nmae"]) > ZERO_ERROR}
    _points(at_once, shown, list(entries), "nmae_every_step")
    draw_errors(later, entries, step_s)
    at_once.set_ylabel("NMAE of the force")
    later.set_xlabel("Time since the packet (ms)")
    later.set_title("(a) control error")


def _bits_panel(figure: SubFigure, entries: Entries) -> None:
    """Draw (b): what a transmission costs."""
    axes = figure.subplots()
    bits = {name: entry["bits_per_transmission"] for name, entry in entries.items()}
    sending = {name: sent for name, sent in bits.items() if sent}
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


def _score_panels(figure: SubFigure, entries: Entries, step_s: float, acceptable: float) -> None:
    """Draw (c): normalised control score with a packet at every step, and against the gap."""
    at_once, later = _pair(figure)
    _points(at_once, entries, list(entries), "score")
    at_once.axhline(acceptable, color="black", linewidth=0.6, linestyle=(0, (6, 3)))
    draw_scores(later, entries, "gap", acceptable, step_s)
    at_once.set_ylim(bottom=0)
    at_once.set_ylabel("Normalised control score")
    later.tick_params(axis="x", labelsize=6)
    later.set_title("(c) control score")


def _pair(figure: SubFigure) -> tuple[Axes, Axes]:
    """Return a narrow panel for packets at every step beside a wide one, with one vertical axis."""
    at_once, later = figure.subplots(1, 2, sharey=True, width_ratios=(1, 2.6))
    at_once.set_xticks([])
    at_once.set_xlabel("packet at\nevery step")
    for axes in (at_once, later):
        axes.grid(visible=True)
    return at_once, later


def _points(axes: Axes, entries: Entries, methods: list[str], value: str) -> None:
    """Draw one mark with its 95 % interval per method that has the value, side by side."""
    for place, (name, entry) in enumerate(entries.items()):
        if value in entry:  # else measured by a version that did not take it
            marks = [entry[value]], *np.reshape(entry[f"{value}_ci95"], (2, 1))
            draw_bars(axes, method_style(name, methods), [place], *marks)
