"""Figures compare many methods: a row for each, and in each column one thing that was measured.

So no line lies on another, and a name stands once, beside all that is said of it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from hjepa_cli.output import figures, lettering, looks  # isort: skip - before matplotlib
import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from hjepa_cli.output.figures import Entries
from hjepa_cli.output.looks import Looks

ROW_IN, AROUND_IN, LEAST_IN = 0.17, 0.85, 2.6  # height of a row, of all else, of a figure at least
AT, AFTER = "error at", "error after"  # begin the headings of errors
DELIVERY = "delivery\np*"  # spans decades, as errors do
Column = tuple[str, Callable[[Mapping[str, Any]], Sequence[Any] | None]]
"""A heading, and of an entry the value with its interval, or ``None`` where it was not measured."""


@matplotlib.rc_context(figures.RC)
def comparison_figure(
    entries: Entries, *, acceptable_score: float, step_s: float, asked: Looks = looks.PLAIN
) -> Figure:
    """Draw the paper's Fig. 3: (a) NMAE, (b) bits per transmission, (c) score, with 95 % intervals.

    Errors are with a packet at every step, and by window of the time since the only one. Bits are
    exact and mostly equal: a line of text says them.
    """
    height_in = max(AROUND_IN + ROW_IN * len(entries), LEAST_IN)
    figure = Figure(figsize=(looks.PAGE_IN, height_in), layout="constrained")
    title, text = asked.titled(""), bits_text(entries, asked)
    _close(figure)
    figure.suptitle("\n".join(filter(None, (title, text))), fontsize=figures.RC["axes.titlesize"])
    left, right = figure.subfigures(1, 2, width_ratios=(4.1, 3.0))
    logarithmic = asked.logarithmic(usual=True)
    columns = error_columns(entries, step_s)
    exact = rows_panel(left, entries, columns, asked, logarithmic=logarithmic)
    left.supxlabel("(a) NMAE of the force", fontsize=figures.RC["axes.titlesize"])
    axes = right.subplots()
    named = figures.draw_scores(axes, entries, "gap", acceptable_score, step_s, asked)
    axes.set_ylabel("Normalised control score")
    axes.set_title("(c) control score")
    axes.grid(visible=True)
    notes = [f"no error: {', '.join(exact)}"] if exact else []
    lettering.name_ends(figure, axes, named, notes)
    return figure


@matplotlib.rc_context(figures.RC)
def trainings_figure(entries: Entries, *, step_s: float, asked: Looks = looks.PLAIN) -> Figure:
    """Draw means over trainings with intervals: NMAE by windows, and what losses are tolerated."""
    height_in = max(AROUND_IN + ROW_IN * len(entries), LEAST_IN)
    figure = Figure(figsize=(looks.PAGE_IN, height_in), layout="constrained")
    _close(figure)
    figure.suptitle(asked.titled(""), fontsize=figures.RC["axes.titlesize"])
    gap = lambda of: _scaled(of, "tolerance_gap_steps", "tolerance_gap_ci95", step_s)  # noqa: E731
    least = lambda of: _scaled(of, "tolerance_p", "tolerance_p_ci95", 1e-3)  # noqa: E731
    columns = [*error_columns(entries, step_s), ("gap D*\n(ms)", gap), (DELIVERY, least)]
    logarithmic = asked.logarithmic(usual=True)
    if exact := rows_panel(figure, entries, columns, asked, logarithmic=logarithmic):
        lettering.note(figure, f"no error: {', '.join(exact)}")
    lettering.tidy(figure)
    return figure


def _close(figure: Figure) -> None:
    """Set panels closer to each other than matplotlib would."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(wspace=0.01, w_pad=0.02)


def error_columns(entries: Entries, step_s: float) -> list[Column]:
    """Return the columns of errors: with a packet at every step, then by windows."""

    def every(entry: Mapping[str, Any]) -> Sequence[Any] | None:
        if "nmae_every_step" not in entry:  # measured by a version that did not take it
            return None
        return [entry["nmae_every_step"], *entry["nmae_every_step_ci95"]]

    def of(window: str) -> Column:
        def value(entry: Mapping[str, Any]) -> Sequence[Any]:
            return [entry["nmae_windows"][window], *entry["nmae_windows_ci95"][window]]

        return f"{AFTER}\n{figures.in_ms(window, step_s)} ms", value

    return [(f"{AT}\nevery step", every), *map(of, figures.windows_of(entries))]


def _scaled(
    entry: Mapping[str, Any], value: str, interval: str, step_s: float
) -> Sequence[Any] | None:
    """Return a tolerance in thousands of ``step_s``: a gap in ms, a probability as it is."""
    if entry[value] is None or entry[interval] is None:
        return None
    return [1e3 * step_s * number for number in (entry[value], *entry[interval])]


def bits_text(entries: Entries, asked: Looks) -> str:
    """Say how many bits a transmission has, of each method whose number is not the usual one."""
    sent: dict[int, list[str]] = {}
    for name, entry in entries.items():
        if entry["bits_per_transmission"]:
            sent.setdefault(entry["bits_per_transmission"], []).append(asked.named(name))
    usual = max(sent, key=lambda bits: len(sent[bits]), default=0)
    others = [f"{bits:,} {', '.join(names)}" for bits, names in sent.items() if bits != usual]
    if not sent:
        return ""
    if not others:
        return f"(b) every method sends {usual:,} bits per transmission"
    return f"(b) bits per transmission: {'; '.join([*others, f'all others {usual:,}'])}"


def rows_panel(
    figure: Figure | SubFigure,
    entries: Entries,
    columns: Sequence[Column],
    asked: Looks,
    *,
    logarithmic: bool,
) -> list[str]:
    """Draw a panel per column with a row per method: a mark and its 95 % interval.

    Columns of errors share their axis. Return the methods that make none and have no mark there.
    """
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    methods = list(entries)
    windows = figures.windows_of(entries)
    exact = [
        name
        for name, entry in entries.items()
        if max((entry["nmae_windows"][of] for of in windows), default=1) <= figures.ZERO_ERROR
    ]
    found: dict[str, dict[str, Sequence[Any] | None]] = {}
    for title, value in columns:
        found[title] = {name: value(entry) for name, entry in entries.items()}
        if _is_error(title):
            found[title] |= dict.fromkeys(exact)
    shown = [name for name in methods if any(of[name] for of in found.values())]
    errors = [panel for panel, (title, _) in zip(panels, columns, strict=True) if _is_error(title)]
    for panel, (title, _) in zip(panels, columns, strict=True):
        for row, name in enumerate(shown):
            if values := found[title][name]:
                _mark(panel, figures.method_style(name, methods), row, *values)
        panel.set_title(title)
        panel.tick_params(axis="x", labelsize=6)
        panel.tick_params(axis="y", length=0)
        panel.grid(visible=True)
        if logarithmic and (panel in errors or title == DELIVERY):
            panel.set_xscale("log")
        elif panel not in errors:
            panel.set_xlim(left=0)
    ends = [of for title in found if _is_error(title) for of in found[title].values() if of]
    if ends:
        # An interval down to nothing has no end on a logarithmic axis: there its mark decides.
        lowest = min(low if low > figures.ZERO_ERROR else value / 2 for value, low, _ in ends)
        highest = max(high for _, _, high in ends)
        for panel in errors:
            panel.set_xlim(0.7 * max(lowest, figures.ZERO_ERROR) * logarithmic, 1.4 * highest)
    panels[0].set_ylim(max(len(shown), 1) - 0.5, -0.5)
    panels[0].set_yticks(range(len(shown)), [asked.named(name) for name in shown])
    for label, name in zip(panels[0].get_yticklabels(), shown, strict=True):
        label.set_color(figures.method_style(name, methods).colour)
    return [asked.named(name) for name in exact]


def _is_error(title: str) -> bool:
    return title.startswith((AT, AFTER))


def _mark(panel: Axes, style: Any, row: int, value: float, low: float, high: float) -> None:
    panel.errorbar(
        [value],
        [row],
        xerr=[[max(value - low, 0)], [max(high - value, 0)]],
        color=style.colour,
        marker=style.marker,
        markerfacecolor="white" if style.hollow else style.colour,
        markersize=2.8,
        elinewidth=0.8,
    )
