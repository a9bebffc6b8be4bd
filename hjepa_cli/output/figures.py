"""Figures for papers: one column wide (3.5 in), readable in black and white, equal byte for byte.

This is the only module that imports matplotlib (extra ``plot``). Figures are built without pyplot,
so no display, backend or global state is involved.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from hjepa_cli.errors import UsageError
from hjepa_cli.storage.files import write_bytes

WIDTH_IN = 3.5  # an IEEE column
DPI = 300
MARKERS = 8  # per line at most
ZERO_ERROR = 1e-5  # NMAE below which a method plays what the teacher plays
RC: dict[Any, Any] = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 7,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.4,
    "grid.alpha": 0.5,
    "lines.linewidth": 1.1,
    "pdf.fonttype": 42,  # TrueType: IEEE refuses Type 3
    "ps.fonttype": 42,
    "svg.hashsalt": "hjepa",  # element ids depend on the content only
}
# Dates would make two runs differ.
METADATA: dict[str, dict[str, Any]] = {
    "png": {},
    "svg": {"Date": None},
    "pdf": {"CreationDate": None},
}


@dataclass(frozen=True)
class Style:
    """How one method is drawn everywhere. Hollow markers: controllers that see the true state.

    Curves of equally good methods lie on each other. So solid lines with large markers are drawn
    first, dashed ones with smaller markers over them, and all stay visible.
    """

    colour: str  # Okabe and Ito's palette, safe for colour-blind readers
    marker: str
    line: Any = "-"
    hollow: bool = False
    size: float = 4.0  # of the marker, in points

    def looks(self, scale: float = 1.0) -> dict[str, Any]:
        """What ``Axes.plot`` takes."""
        return {
            "color": self.colour,
            "linestyle": self.line,
            "marker": self.marker,
            "markersize": scale * self.size,
            "markerfacecolor": "none" if self.hollow else self.colour,
            "markeredgecolor": self.colour if self.hollow else "white",
            "markeredgewidth": 1.0 if self.hollow else 0.4,
            "zorder": 3.0 - 0.1 * self.size,
        }


DASH_DOT_DOT = (0, (3, 1, 1, 1, 1, 1))
STYLES = {
    "hjepa": Style("#0072B2", "o", size=7.0),
    "ts-jepa-1": Style("#D55E00", "s", "--", size=2.8),
    "ts-jepa-4": Style("#009E73", "^", "-.", size=5.0),
    "hold": Style("#CC79A7", "v", ":"),
    "zero": Style("#E69F00", "D", DASH_DOT_DOT, size=3.5),
    "oracle": Style("#000000", "o", "-", hollow=True, size=8.5),
    "hold-true": Style("#7F7F7F", "v", ":", hollow=True, size=6.5),
    "zero-true": Style("#7F7F7F", "D", DASH_DOT_DOT, hollow=True, size=6.5),
    "ts-jepa-2": Style("#56B4E9", "<", "--"),
    "ts-jepa-3": Style("#56B4E9", ">", "-."),
    "ts-jepa-5": Style("#56B4E9", "p", ":"),
    "supervised-2": Style("#882255", "P", "--"),
    "supervised-4": Style("#882255", "X", "-."),
    "autoencoder-2": Style("#999933", "h", "--"),
    "hold-decay": Style("#CC79A7", "^", "-.", hollow=True, size=5.0),
    "hold-decay-linear": Style("#CC79A7", ">", "--", hollow=True, size=5.0),
    "chunk": Style("#117733", "X", "--", hollow=True, size=5.0),
    "chunk-forces": Style("#117733", "P", "-.", hollow=True, size=5.0),
    "linear": Style("#44AA99", "d", "--"),
    "state-kf": Style("#332288", "*", "--", size=5.5),
    "state-48": Style("#332288", "8", "-."),
    "local": Style("#000000", "s", ":", hollow=True, size=6.5),
    "optimal": Style("#000000", "x", ":"),
}
OTHERS = [Style("#7F7F7F", marker, ":") for marker in "<>phd*PX"]
LONGEST_OF_THREE = 15  # characters of a label, for three columns of a legend

SCHEDULER_STYLES = {
    "round-robin": Style("#7F7F7F", "s", ":", hollow=True),
    "opportunistic": Style("#E69F00", "D", DASH_DOT_DOT, hollow=True),
    "max-aoi": Style("#009E73", "^", "-."),
    "drift-plus-penalty": Style("#CC79A7", "v", "--", hollow=True),
    "whittle": Style("#D55E00", "s", "--"),
    "innovation": Style("#0072B2", "o"),
}


def scale_figure(result: Mapping[str, Any], *, title: str = "") -> Figure:
    """Draw what ``scale --json`` counted, as fits its law."""
    if result["law"] == "scheduled":
        return schedulers_figure(result["rows"], title=title)
    snr_label = "Target SNR (dB)" if result["law"] == "duty" else "Mean SNR (dB)"
    return devices_figure(result["rows"], title=title, snr_label=snr_label)


def devices_figure(
    rows: Sequence[Mapping[str, Any]], *, title: str = "", snr_label: str = "Target SNR (dB)"
) -> Figure:
    """Draw supported devices against the SNR, one line per method, as the paper's Fig. 4.

    Args:
        rows: of ``scale --json``: ``snr_db``, ``method``, ``devices``, ``devices_ci95``. Methods
            that support nobody anywhere are named in the legend only; ``at_least`` is, too.
        title: one line above the axes.
        snr_label: what the SNR is under the law.
    """
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
        axes = figure.add_subplot()
        curves = _curves(rows)
        bounds = {row["method"] for row in rows if row.get("at_least")}
        for method, points in sorted(curves.items(), key=lambda item: -item[1][-1, 1]):
            label = method if points[:, 1].any() else f"{method} (0)"
            label += " (at least)" if method in bounds else ""
            _draw(axes, label, points, method_style(method, list(curves)))
        _scale_counts(axes, [row for row in rows if row["devices"]])
        axes.set_xlabel(snr_label)
        axes.set_ylabel("Supported devices")
        axes.set_title(title)
        grid_db = sorted({row["snr_db"] for row in rows})
        if len(grid_db) <= MARKERS:
            axes.set_xticks(grid_db)
        axes.grid(visible=True)
        _legend(figure, axes)
        return figure


def schedulers_figure(rows: Sequence[Mapping[str, Any]], *, title: str = "") -> Figure:
    """Draw supported devices against the SNR under each scheduler: a panel per method.

    Schedulers lie side by side at each SNR, so that intervals of equally good ones stay apart.

    Args:
        rows: of ``scale --law scheduled --json``.
        title: one line above the panels.
    """
    methods = list(dict.fromkeys(row["method"] for row in rows))
    schedulers = [name for name in SCHEDULER_STYLES if name in {row["scheduler"] for row in rows}]
    grid_db = sorted({row["snr_db"] for row in rows})
    apart_db = 0.06 * min(np.diff(grid_db), default=1.0)
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, 0.9 + 1.5 * len(methods)), layout="constrained")
        panels = figure.subplots(len(methods), 1, sharex=True, squeeze=False)[:, 0]
        for axes, method in zip(panels, methods, strict=True):
            for place, scheduler in enumerate(schedulers):
                mine = [
                    {
                        **row,
                        "snr_db": row["snr_db"] + apart_db * (place - len(schedulers) / 2 + 0.5),
                    }
                    for row in rows
                    if (row["method"], row["scheduler"]) == (method, scheduler)
                ]
                _bars(axes, scheduler, _curves(mine)[method], SCHEDULER_STYLES[scheduler])
            most = max(row["devices_ci95"][1] for row in rows if row["method"] == method)
            axes.set_ylim(0, 1.1 * most or 1)  # the highest interval ends below the frame
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
            axes.set_ylabel("Devices")
            axes.annotate(
                method, (0.02, 0.96), xycoords="axes fraction", va="top", fontweight="bold"
            )
            axes.grid(visible=True, axis="y")
        panels[0].set_title(title)
        panels[-1].set_xlabel("Target SNR (dB)")
        if len(grid_db) <= MARKERS:
            panels[-1].set_xticks(grid_db)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=2, frameon=False, handlelength=2.4
        )
        return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as .png, .svg or .pdf, atomically; equal figures give equal bytes."""
    kind = path.suffix.removeprefix(".")
    if kind not in METADATA:
        raise UsageError(f"no figure format '{path.suffix}'; choose one of .png, .svg, .pdf")
    write_bytes(path, encoded(figure, kind))
    return path


def has_curves(figure: Figure) -> bool:
    """Whether anything is drawn that a legend would name."""
    return any(axes.get_legend_handles_labels()[1] for axes in figure.axes)


def encoded(figure: Figure, kind: str) -> bytes:
    """A figure as ``"png"``, ``"svg"`` or ``"pdf"``."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(RC):
        figure.savefig(buffer, format=kind, dpi=DPI, metadata=METADATA[kind])
    return buffer.getvalue()


def _curves(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Rows by method as arrays [points, (snr, devices, low, high)], ascending in SNR."""
    curves: dict[str, list[list[float]]] = {}
    for row in rows:
        if row["devices"] is not None:
            point = [row["snr_db"], row["devices"], *row["devices_ci95"]]
            curves.setdefault(row["method"], []).append(point)
    return {method: np.array(sorted(points), float) for method, points in curves.items()}


def method_style(method: str, methods: list[str]) -> Style:
    """How a method is drawn; ``methods`` are all of the figure, so that none shares a marker."""
    others = [name for name in methods if name not in STYLES]
    return STYLES.get(method) or OTHERS[others.index(method) % len(OTHERS)]


def _draw(axes: Axes, label: str, points: np.ndarray, style: Style) -> None:
    snr_db, devices, low, high = points.T
    axes.plot(
        snr_db,
        np.where(devices > 0, devices, np.nan),
        markevery=-(-len(points) // MARKERS),
        label=label,
        **style.looks(),
    )
    if len(points) > 1:
        axes.fill_between(snr_db, low, high, color=style.colour, alpha=0.18, linewidth=0)
    else:
        axes.vlines(snr_db, low, high, color=style.colour)


def _bars(axes: Axes, label: str, points: np.ndarray, style: Style) -> None:
    """A line through counts with their intervals as bars [points, (snr, devices, low, high)]."""
    snr_db, devices, low, high = points.T
    axes.errorbar(
        snr_db,
        devices,
        yerr=np.maximum([devices - low, high - devices], 0),
        color=style.colour,
        linestyle=style.line,
        linewidth=0.7,
        marker=style.marker,
        markerfacecolor="white" if style.hollow else style.colour,
        markersize=3.5,
        elinewidth=0.9,
        capsize=1.5,
        label=label,
    )


def _scale_counts(axes: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    """Logarithmic where methods lie more than a decade apart at one SNR, else from zero."""
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
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))


def score_figure(
    entries: Mapping[str, Mapping[str, Any]],
    kind: str,
    *,
    acceptable_score: float,
    step_s: float,
    title: str = "",
) -> Figure:
    """Draw the normalised score against the link, one line per method with its 95 % band.

    Args:
        entries: of ``eval --json``, by method: ``gap_curve`` or ``delivery_curve``.
        kind: ``"gap"``: against the time between packets; ``"delivery"``: against p.
        acceptable_score: drawn as a level.
        step_s: length of a control step, for the time axis.
        title: one line above the axes.
    """
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
        axes = figure.add_subplot()
        axes.axhline(acceptable_score, color="black", linewidth=0.6, linestyle=(0, (6, 3)))
        axes.annotate(
            f"acceptable: {acceptable_score:g}",
            (0.01, acceptable_score),
            xycoords=("axes fraction", "data"),
            xytext=(2, 2),
            textcoords="offset points",
            fontsize=6,
        )
        for method, entry in entries.items():
            curve = entry[f"{kind}_curve"]
            if len(curve) < 2 or entry["tolerance_gap_steps"] is None:
                continue  # a method without a link (optimal) is a line at 1
            where = [1e3 * step_s * point["d"] if kind == "gap" else point["p"] for point in curve]
            band = np.array([point["ci95"] for point in curve], float)
            scores = np.array([point["score"] for point in curve], float)
            draw_line(axes, method, list(entries), np.array(where), scores, band)
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        if kind == "gap":
            axes.set_xlabel("Time between packets (ms)")
        else:
            axes.set_xlabel("Delivery probability of a slot")
            axes.invert_xaxis()
        axes.set_ylabel("Normalised control score")
        axes.set_ylim(bottom=0)
        _finish(figure, axes, title)
        return figure


def error_figure(
    entries: Mapping[str, Mapping[str, Any]], *, step_s: float, title: str = ""
) -> Figure:
    """Draw the NMAE after a single packet against the time since it, with 95 % bands.

    Args:
        entries: of ``eval --json``, by method: ``nmae`` and ``nmae_ci95`` over the horizon.
        step_s: length of a control step.
        title: one line above the axes.
    """
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(WIDTH_IN, 2.9), layout="constrained")
        axes = figure.add_subplot()
        for method, entry in entries.items():
            errors = np.array(entry["nmae"], float)
            if errors.max() < ZERO_ERROR:
                continue  # oracle and optimal know the noise-free future but for rounding
            band = np.array(entry["nmae_ci95"], float)
            draw_line(
                axes, method, list(entries), 1e3 * step_s * np.arange(len(errors)), errors, band
            )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        shown = np.concatenate([line.get_ydata() for line in axes.lines] or [np.ones(1)])
        axes.set_ylim(bottom=0.5 * shown[shown > ZERO_ERROR].min())
        axes.set_xlabel("Time since the only packet (ms)")
        axes.set_ylabel("NMAE of the force")
        _finish(figure, axes, title)
        return figure


def training_figure(rows: Sequence[Mapping[str, str]], *, title: str = "") -> Figure:
    """Draw a training run's ``metrics.csv``: losses, and health where it was measured.

    Args:
        rows: as :class:`csv.DictReader` gives them, with ``step`` and either ``loss_…`` and
            ``probe_r2_…`` columns, or ``level`` and ``loss``.
        title: one line above the axes.
    """
    losses = _series(rows, "loss")
    health = _series(rows, "probe_r2")
    with matplotlib.rc_context(RC):
        count = 1 + bool(health)
        figure = Figure(figsize=(WIDTH_IN, 1.2 + 1.4 * count), layout="constrained")
        panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
        for axes, lines, label in zip(panels, (losses, health), ("Loss", "Probe R²"), strict=False):
            for number, (name, points) in enumerate(lines.items()):
                style = list(STYLES.values())[number % len(STYLES)]
                axes.plot(
                    *np.array(points).T,
                    color=style.colour,
                    linestyle=style.line,
                    marker=style.marker,
                    markerfacecolor="none",
                    markersize=4,
                    markevery=max(-(-len(points) // MARKERS), 1),
                    label=name,
                )
            axes.set_ylabel(label)
            axes.grid(visible=True)
            axes.legend(fontsize=6, ncols=2, frameon=False, handlelength=2.4)
        if all(value > 0 for points in losses.values() for _, value in points):
            panels[0].set_yscale("log")
        panels[0].set_title(title)
        panels[-1].set_xlabel("Training step")
        return figure


def _series(rows: Sequence[Mapping[str, str]], prefix: str) -> dict[str, list[tuple[float, float]]]:
    """Columns of ``metrics.csv`` by name without their prefix; by level where there are levels."""
    series: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for column, text in row.items():
            if column.startswith(prefix) and text:
                name = row.get("level") or column.removeprefix(prefix).strip("_") or column
                series.setdefault(name, []).append((float(row["step"]), float(text)))
    return series


def draw_line(
    axes: Axes, method: str, methods: list[str], where: np.ndarray, value: np.ndarray,
    band: np.ndarray,
) -> None:  # fmt: skip
    """Draw one method's line, markers and 95 % band [points, 2] over ``where``."""
    style = method_style(method, methods)
    axes.plot(
        where,
        value,
        markevery=-(-len(where) // MARKERS),
        label=method,
        **style.looks(0.9),
    )
    axes.fill_between(where, band[:, 0], band[:, 1], color=style.colour, alpha=0.18, linewidth=0)


def _finish(figure: Figure, axes: Axes, title: str) -> None:
    axes.set_title(title)
    axes.grid(visible=True)
    _legend(figure, axes)


def _legend(figure: Figure, axes: Axes) -> None:
    """Below the axes, in as many columns as the column of a paper has room for."""
    if not has_curves(figure):
        return
    longest = max(len(label) for label in axes.get_legend_handles_labels()[1])
    ncols = 3 if longest <= LONGEST_OF_THREE else 2
    figure.legend(loc="outside lower center", ncols=ncols, frameon=False, handlelength=2.4)
