"""Figures are for papers: a column wide or two, readable in black and white, equal byte for byte.

Whatever draws with matplotlib (extra ``plot``) imports this module first. Figures are built without
pyplot, so no display, backend or global state is involved.
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
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from hjepa_cli.core.plants.stress import CONDITIONS
from hjepa_cli.core.style import PALETTE, PLAIN, Style
from hjepa_cli.errors import UsageError
from hjepa_cli.output import lettering, looks
from hjepa_cli.output.lettering import Named
from hjepa_cli.output.looks import Looks
from hjepa_cli.plugins import LAWS, METHODS, SCHEDULERS
from hjepa_cli.storage.files import write_bytes

HEIGHT_IN = 2.5
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
    "axes.prop_cycle": matplotlib.cycler(color=PALETTE),
    "pdf.fonttype": 42,  # TrueType: IEEE refuses Type 3
    "svg.hashsalt": "hjepa",  # element ids depend on the content only
}
# Dates would make two runs differ.
METADATA: dict[str, Any] = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}
Entries = Mapping[str, Mapping[str, Any]]
"""Entries of ``eval --json`` by method."""

OTHERS = [Style("#7F7F7F", marker, ":") for marker in "<>phd*PX"]
LINES = ("-", "--", "-.", ":")  # of a training's losses, with the colours of the palette
STRESS_COLUMNS = 6  # panels beside each other
GAP_STYLES = [Style("#0072B2", "o"), Style("#D55E00", "s", "--"), Style("#009E73", "^", "-.")]


def scale_figure(result: Mapping[str, Any], asked: Looks = looks.PLAIN) -> Figure:
    """Draw the counts of ``scale --json``: by scheduler where there are some, else by method."""
    if any("scheduler" in row for row in result["rows"]):
        return schedulers_figure(result["rows"], asked)
    law = result["law"]  # of a plugin, perhaps, that was in force there and is not here
    snr_label = LAWS[law].snr_label if law in LAWS else "SNR (dB)"
    return devices_figure(result["rows"], asked, snr_label=snr_label)


@matplotlib.rc_context(RC)
def devices_figure(
    rows: Sequence[Mapping[str, Any]],
    asked: Looks = looks.PLAIN,
    *,
    snr_label: str = "Target SNR (dB)",
) -> Figure:
    """Draw supported devices against the SNR, one line per method, as the paper's Fig. 4.

    The rows, of ``scale --json``, have ``snr_db``, ``method``, ``devices`` and ``devices_ci95``.
    Methods that support nobody anywhere are named below; a bound says ``(at least)``.
    """
    figure, axes = _panel(asked)
    named, notes = draw_devices(axes, rows, asked)
    axes.set_xlabel(snr_label)
    axes.set_title(asked.titled(""))
    _finish(figure, axes, named, notes)
    return figure


def draw_devices(
    axes: Axes, rows: Sequence[Mapping[str, Any]], asked: Looks = looks.PLAIN
) -> tuple[list[Named], list[str]]:
    """Draw devices against ``snr_db``; return the lines to be named, and notes."""
    curves = _curves(rows)
    bounds = {row["method"] for row in rows if row.get("at_least")}
    named, nobody = [], []
    for method, points in sorted(curves.items(), key=lambda item: -item[1][-1, 1]):
        snr_db, devices = points[:, 0], points[:, 1]
        text = asked.named(method) + " (at least)" * (method in bounds)
        if not devices.any():
            nobody.append(text)
            continue
        seen = np.where(devices > 0, devices, np.nan) if asked.logarithmic() else devices
        named.append(
            draw_line(axes, method, list(curves), snr_db, seen, points[:, 2:], text, scale=0.8)
        )
    drawn = [row for row in rows if row["devices"]]
    least = min((row["devices"] for row in drawn), default=1)
    most = max((points[:, 3].max() for points in curves.values()), default=0) or 1
    if asked.logarithmic():
        axes.set_yscale("log", nonpositive="clip")
        axes.set_ylim(0.7 * least, 1.5 * most)
    else:
        axes.set_ylim(0, 1.1 * most)
        lettering.count_ticks(axes.yaxis)
    axes.set_ylabel("Supported devices")
    _snr_ticks(axes, rows)
    return named, [f"no devices: {', '.join(nobody)}"] if nobody else []


@matplotlib.rc_context(RC)
def survival_figure(result: Mapping[str, Any], asked: Looks = looks.PLAIN) -> Figure:
    """Draw the curves of ``survive --json``: the share of loops lost against the gap.

    Points in which none was lost lie at the lower edge, with their interval.
    """
    figure, axes = _panel(asked)
    step_ms, loops = 1e3 * result["step_s"], result["n_loops"]
    floor = 0.3 / loops
    methods = list(dict.fromkeys(curve["method"] for curve in result["curves"]))
    several = len({curve["interval_steps"] for curve in result["curves"]}) > 1
    named = []
    for curve in result["curves"]:
        gaps_ms = np.array([point["gap_steps"] * step_ms for point in curve["points"]])
        lost = np.array([point["p_lost"] for point in curve["points"]])
        ends = np.array([point["p_lost_ci95"] for point in curve["points"]])
        label = asked.named(curve["method"])
        if several:
            label += f", every {curve['interval_steps'] * step_ms:g} ms"
        shown = np.maximum(lost, floor)
        named.append(draw_line(axes, curve["method"], methods, gaps_ms, shown, ends, label))
    if asked.logarithmic(usual=True):
        axes.set_yscale("log")
    axes.set_ylim(floor, 1.5)
    axes.set_xlabel("Gap between two packets (ms)")
    axes.set_ylabel("Loops lost")
    axes.set_title(asked.titled(""))
    _finish(figure, axes, named)
    return figure


@matplotlib.rc_context(RC)
def schedulers_figure(rows: Sequence[Mapping[str, Any]], asked: Looks = looks.PLAIN) -> Figure:
    """Draw rows of ``scale --law scheduled --json``: devices against the SNR, a panel per method.

    Schedulers lie side by side at each SNR, so that intervals of equally good ones stay apart.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    drawn = dict.fromkeys(row["scheduler"] for row in rows)
    schedulers = sorted(drawn, key=lambda name: [*SCHEDULERS, *drawn].index(name))
    apart_db = 0.06 * min(np.diff(sorted({row["snr_db"] for row in rows})), default=1.0)
    figure, panels = _panels(len(methods), 0.9 + 1.5 * len(methods), asked)
    for axes, method in zip(panels, methods, strict=True):
        for place, scheduler in enumerate(schedulers):
            mine = [r for r in rows if (r["method"], r["scheduler"]) == (method, scheduler)]
            snr_db, *devices = _curves(mine)[method].T
            snr_db = snr_db + apart_db * (place - len(schedulers) / 2 + 0.5)
            style = SCHEDULERS[scheduler].style if scheduler in SCHEDULERS else PLAIN
            how = {"linestyle": style.line, "linewidth": 0.7, "capsize": 1.5}
            draw_bars(axes, style, snr_db, *devices, label=asked.named(scheduler), **how)
        most = _curves(rows)[method][:, 3].max()
        if asked.logarithmic():
            axes.set_yscale("log", nonpositive="clip")
        else:
            axes.set_ylim(0, 1.1 * most or 1)  # the highest interval ends below the frame
            lettering.count_ticks(axes.yaxis)
        axes.set_ylabel("Devices")
        where = {"xycoords": "axes fraction", "va": "top", "fontweight": "bold"}
        axes.annotate(asked.named(method), (0.02, 0.96), **where)
        axes.grid(visible=True, axis="y")
    panels[0].set_title(asked.titled(""))
    panels[-1].set_xlabel("Target SNR (dB)")
    _snr_ticks(panels[-1], rows)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    lettering.tidy(figure)
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
            ends = row["devices_ci95"] or [row["devices"]] * 2  # of a stated gap: no interval
            point = [row["snr_db"], row["devices"], *ends]
            curves.setdefault(row["method"], []).append(point)
    return {method: np.array(sorted(points), float) for method, points in curves.items()}


def method_style(method: str, methods: list[str]) -> Style:
    """Return how a method is drawn; ``methods`` are all of the figure: none shares a marker."""
    own = {name: METHODS[name].style for name in methods if name in METHODS}
    others = [name for name in methods if not own.get(name)]
    return own.get(method) or OTHERS[others.index(method) % len(OTHERS)]


@matplotlib.rc_context(RC)
def score_figure(
    entries: Entries,
    kind: str,
    *,
    acceptable_score: float,
    step_s: float,
    asked: Looks = looks.PLAIN,
) -> Figure:
    """Draw the normalised score against the link, one line per method with its 95 % band.

    The link is the time between packets (``kind`` ``"gap"``) or p (``"delivery"``).
    """
    figure, axes = _panel(asked)
    named = draw_scores(axes, entries, kind, acceptable_score, step_s, asked)
    axes.set_ylabel("Normalised control score")
    axes.set_title(asked.titled(""))
    _finish(figure, axes, named)
    return figure


@matplotlib.rc_context(RC)
def error_figure(entries: Entries, *, step_s: float, asked: Looks = looks.PLAIN) -> Figure:
    """Draw the NMAE after a single packet by windows of the time since it, with 95 % bars."""
    figure, axes = _panel(asked)
    named, notes = draw_errors(axes, entries, step_s, asked)
    axes.set_title(asked.titled(""))
    _finish(figure, axes, named, notes)
    return figure


@matplotlib.rc_context(RC)
def wire_figure(result: Mapping[str, Any], asked: Looks = looks.PLAIN) -> Figure:
    """Draw ``bench-link --json``: answers by their age, device-steps by who drove."""
    figure = Figure(figsize=(asked.width_in, 3.0), layout="constrained")
    figure.suptitle(asked.titled(""), fontsize=RC["axes.titlesize"])
    left, right = figure.subplots(2, 1)
    ages = {int(age): count for age, count in result["ages"].items()}
    answers = max(sum(ages.values()), 1)
    left.bar(list(ages), [count / answers for count in ages.values()], color="#0072B2")
    lettering.count_ticks(left.xaxis)
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
def training_figure(rows: Sequence[Mapping[str, str]], asked: Looks = looks.PLAIN) -> Figure:
    """Draw a training run's ``metrics.csv``: losses, and health where it was measured.

    The rows, as :class:`csv.DictReader` gives them, have ``step`` and either ``loss_…`` and
    ``probe_r2_…``, or ``level`` and ``loss``.
    """
    losses, health = _series(rows, "loss"), _series(rows, "probe_r2")
    figure, panels = _panels(1 + bool(health), 2.6 + 1.4 * bool(health), asked)
    for axes, lines, label in zip(panels, (losses, health), ("Loss", "Probe R²"), strict=False):
        looks_of = itertools.product(LINES, PALETTE)
        for (line, colour), (name, points) in zip(looks_of, lines.items(), strict=False):
            axes.plot(*np.array(points).T, color=colour, linestyle=line, label=name)
        axes.set_ylabel(label)
        axes.grid(visible=True)
        axes.legend(fontsize=6, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    if all(value > 0 for points in losses.values() for _, value in points):
        panels[0].set_yscale("log")
    panels[-1].set_xlabel("Training step")
    panels[0].set_title(asked.titled(""))
    lettering.tidy(figure)
    return figure


def _series(rows: Sequence[Mapping[str, str]], prefix: str) -> dict[str, list[tuple[float, float]]]:
    """Return columns of ``metrics.csv`` by name without prefix; by level, if there are any.

    Rounds of one level are a single line, one after the other.
    """
    series: dict[str, list[tuple[float, float]]] = {}
    longest = max((float(row["step"]) for row in rows), default=0.0)
    for row in rows:
        level, _, number = (row.get("level") or "").partition(" round ")
        before = (int(number) - 1) * longest if number else 0.0
        for column, text in row.items():
            if column.startswith(prefix) and text:
                name = level or column.removeprefix(prefix).strip("_") or column
                series.setdefault(name, []).append((before + float(row["step"]), float(text)))
    return series


def draw_scores(
    axes: Axes,
    entries: Entries,
    kind: str,
    acceptable_score: float,
    step_s: float,
    asked: Looks = looks.PLAIN,
) -> list[Named]:
    """Draw the scores of all methods with a link, see :func:`score_figure`; return the lines."""
    axes.axhline(acceptable_score, color="black", linewidth=0.6, linestyle=(0, (6, 3)))
    named = []
    for method, entry in entries.items():
        curve = entry[f"{kind}_curve"]
        if len(curve) < 2 or entry["tolerance_gap_steps"] is None:
            continue  # a method without a link (optimal) is a line at its score
        where = [1e3 * step_s * point["d"] if kind == "gap" else point["p"] for point in curve]
        scores, band = ([point[key] for point in curve] for key in ("score", "ci95"))
        text = asked.named(method)
        named.append(draw_line(axes, method, list(entries), where, scores, band, text, 0.8))
    if asked.logarithmic(usual=kind == "delivery"):
        axes.set_xscale("log")
    elif kind == "gap":
        axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.set_xlabel("Time between packets (ms)")
    if kind == "delivery":
        axes.set_xlabel("Delivery probability of a slot")
        axes.invert_xaxis()
    text, edge = f"acceptable: {acceptable_score:g}", np.array(axes.get_xlim())[1:]
    return [*named, Named(text, "#000000", edge, np.array([acceptable_score]))]


def draw_errors(
    axes: Axes, entries: Entries, step_s: float, asked: Looks = looks.PLAIN
) -> tuple[list[Named], list[str]]:
    """Draw mean errors by window of all methods that make one, beside each other in each window.

    Return the lines to be named, and notes.
    """
    exact = [name for name, entry in entries.items() if max(entry["nmae"]) <= ZERO_ERROR]
    shown = {name: entry for name, entry in entries.items() if name not in exact}
    named, windows = [], windows_of(shown)
    for place, (method, entry) in enumerate(shown.items() if windows else ()):
        where = np.arange(len(windows)) + 0.7 * ((place + 0.5) / len(shown) - 0.5)
        values = np.array([entry["nmae_windows"][window] for window in windows], float)
        ends = np.array([entry["nmae_windows_ci95"][window] for window in windows], float)
        style, text = method_style(method, list(entries)), asked.named(method)
        how: dict[str, Any] = {"linestyle": style.line, "linewidth": 0.4, "zorder": 2}
        draw_bars(axes, style, where, values, *ends.T, label=text, **how)
        named.append(Named(text, style.colour, where, values))
    if asked.logarithmic(usual=True):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set_xticks(range(len(windows)), [in_ms(window, step_s) for window in windows])
    axes.set_xlim(-0.5, max(len(windows), 1) - 0.5)
    axes.set_xlabel("Time since the only packet (ms)")
    axes.set_ylabel("NMAE of the force")
    return named, [f"no error: {', '.join(map(asked.named, exact))}"] if exact else []


def windows_of(entries: Entries) -> list[str]:
    """Return the windows of steps that errors were averaged over, in the order of time."""
    first: Mapping[str, Any] = next(iter(entries.values()), {})
    every = [entry["nmae_windows"] for entry in entries.values()]
    measured = [
        name for name in first.get("nmae_windows", {}) if None not in [of[name] for of in every]
    ]
    return sorted(measured, key=lambda window: int(window.split("-")[0]))


def in_ms(window: str, step_s: float) -> str:
    """Return a window of steps, ``"21-40"``, in milliseconds."""
    return "–".join(f"{1e3 * step_s * int(end):g}" for end in window.split("-"))


def draw_line(
    axes: Axes, method: str, methods: list[str], where: ArrayLike, value: ArrayLike,
    band: ArrayLike, label: str | None = None, scale: float = 0.9,
) -> Named:  # fmt: skip
    """Draw one method's line, markers and 95 % band [points, 2] over ``where``; return its name."""
    style = method_style(method, methods)
    where, value, band = (np.array(values, float) for values in (where, value, band))
    every, how = _every(where), style.looks(scale)
    axes.plot(where, value, markevery=every, label=label or method, **how)
    if len(where) > 1:
        axes.fill_between(where, *band.T, color=style.colour, alpha=0.18, linewidth=0)
    else:
        axes.vlines(where, *band.T, color=style.colour)
    seen = ~np.isnan(value)
    return Named(label or method, style.colour, where[seen], value[seen])


def draw_bars(
    axes: Axes, style: Style, where: Any, value: Any, low: Any, high: Any, **how: Any
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
        **how,
    )


def _every(points: Sized) -> int:
    """Return how many points share a marker."""
    return max(-(-len(points) // MARKERS), 1)


def _panel(asked: Looks) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(asked.width_in, HEIGHT_IN), layout="constrained")
    return figure, figure.add_subplot()


def _panels(count: int, height_in: float, asked: Looks) -> tuple[Figure, Sequence[Axes]]:
    figure = Figure(figsize=(asked.width_in, height_in), layout="constrained")
    return figure, figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]


def _snr_ticks(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    grid_db = sorted({row["snr_db"] for row in rows})
    apart = min(np.diff(grid_db), default=1.0)
    if len(grid_db) <= MARKERS and MARKERS * apart >= grid_db[-1] - grid_db[0]:
        axes.set_xticks(grid_db)


def _finish(figure: Figure, axes: Axes, named: Sequence[Named], notes: Sequence[str] = ()) -> None:
    """Add grid, the names of lines at their ends, and ticks for which there is room."""
    axes.grid(visible=True)
    lettering.name_ends(figure, axes, named, notes)


@matplotlib.rc_context(RC)
def stress_figure(stress: Mapping[str, Any], asked: Looks = looks.PLAIN) -> Figure:
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
    figure = Figure(figsize=(looks.PAGE_IN, 0.9 + 1.35 * rows), layout="constrained")
    figure.suptitle(asked.titled(""), fontsize=RC["axes.titlesize"])
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
            label = f"{asked.named(method)}, " * (len(methods) > 1) + f"D = {gaps[gap]}"
            if marks:
                at, value, low, high = np.array(marks, float).T
                if not name:
                    at = at + 0.15 * (line - (len(lines) - 1) / 2)
                how = {"linestyle": style.line if name else "none", "linewidth": 0.9}
                draw_bars(axes, style, at, value, low, high, label=label, **how)
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
