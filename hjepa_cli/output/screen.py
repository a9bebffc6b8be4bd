"""The user sees notes, tables, progress, and the one JSON document of ``--json``.

Results (tables, result lines, JSON) go to stdout; everything about the work (notes, progress,
errors) goes to stderr. Under ``json`` stdout carries the JSON document alone. Texts are printed as
they are: rich markup in a path or a name is never interpreted, control characters are made visible.
"""

import itertools
import json
import math
import shutil
import sys
import textwrap
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, TextIO

from hjepa_cli.errors import MissingInputError, require
from hjepa_cli.storage.files import jsonable

if TYPE_CHECKING:  # rich costs 80 ms; it is imported when something is drawn
    from rich.console import Console
    from rich.progress import Progress as RichProgress

HEARTBEAT_S = 10.0
MISSING = "-"
FOLD_AT = 24  # a text column may be squeezed to this many characters
GAP = 2  # blanks between columns


class Advance:
    """Nobody sees this progress; :meth:`Screen.progress` shows a bar or lines."""

    def advance(self, count: int = 1, **fields: float) -> None:
        """Count ``count`` more units; ``fields`` (``loss=0.1``) are shown beside them."""


class Screen:
    """This program writes to the terminal in no other way.

    Args:
        quiet: show results and errors only.
        json: everything except :meth:`emit` goes to stderr.
        stdout, stderr: streams; by default the process's own.
    """

    def __init__(
        self, quiet: bool = False, json: bool = False, *,
        stdout: TextIO | None = None, stderr: TextIO | None = None,
    ) -> None:  # fmt: skip
        self.quiet, self.json = quiet, json
        self._stdout, self._stderr = stdout or sys.stdout, stderr or sys.stderr
        self._bars: RichProgress | None = None

    @property
    def is_terminal(self) -> bool:
        """Return whether somebody watches, in a window where pictures can be redrawn."""
        return _is_terminal(self._results)

    def say(self, text: str) -> None:
        """Print one line about the work; silent when quiet."""
        if not self.quiet:
            self._print(one_line(text), self._stderr)

    def result(self, text: str) -> None:
        """Print one line of the outcome, also when quiet."""
        self._print(one_line(text), self._results)

    def error(self, message: str, hint: str | None = None) -> None:
        """Print what was wrong and, on a second line, what to do next."""
        print(f"error: {one_line(message)}", file=self._stderr)
        if hint:
            print(f"hint: {one_line(hint)}", file=self._stderr)
        self._stderr.flush()

    def emit(self, document: Mapping[str, Any]) -> None:
        """Print the JSON document of ``--json``: one line, no NaN, undefined values are null."""
        print(json.dumps(jsonable(document), allow_nan=False), file=self._stdout, flush=True)

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print a table as :func:`layout` sets it, also when quiet; ``None`` and NaN are ``-``."""
        cells = [[_cell(value) for value in row] for row in rows]
        width = shutil.get_terminal_size((80, 24)).columns
        lines = textwrap.wrap(one_line(title), width) + layout(columns, cells, width)
        self._print("\n".join(lines), self._results)

    @contextmanager
    def progress(
        self, label: str, total: int, unit: str = "", *, done: int = 0
    ) -> Iterator[Advance]:
        """Show how far a loop is: a bar on a terminal, otherwise a line every ten seconds.

        Inside another one, a bar gives way to a line when it is full.

        Args:
            label: what is being done, one word or two.
            total, done: units of work, and those that a continued run has done before.
            unit: their name, for the rate ("traj" → "310 traj/s"); without one, units are nothing
                that people count, and only the share of them is shown.
        """
        if self.quiet:
            yield Advance()
        elif not _is_terminal(self._stderr):
            heartbeat = _Heartbeat(self._stderr, label, total, unit, done)
            yield heartbeat
            heartbeat.print_line(f"in {heartbeat.elapsed}")
        else:
            is_inner = self._bars is not None
            with self._open_bars() as bars:
                bar = _Bar(bars, label, total, unit, done)
                yield bar
                bars.refresh()
                if is_inner:
                    bars.remove_task(bar.task)
                    self.say(f"{label} {bar}")

    @contextmanager
    def _open_bars(self) -> Iterator["RichProgress"]:
        """Open the live display; an inner ``progress`` adds a line to the outer one's."""
        if self._bars is not None:
            yield self._bars
            return
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        fields = ("count", "rate", "fields")
        with Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            *(TextColumn(f"{{task.fields[{name}]}}", markup=False) for name in fields),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=_console(self._stderr),
        ) as bars:
            self._bars = bars
            try:
                yield bars
            finally:
                self._bars = None

    def _print(self, text: str, stream: TextIO) -> None:
        """Print a text; above the bars, where they are in the same terminal."""
        if self._bars is not None and stream.isatty():
            self._bars.console.print(text, soft_wrap=True)  # as plain as _console says
        else:
            print(text, file=stream, flush=True)

    @property
    def _results(self) -> TextIO:
        return self._stderr if self.json else self._stdout


def can_draw(screen: Screen) -> bool:
    """Tell whether there is matplotlib; without it say what installs it."""
    try:
        require("matplotlib", "a figure needs matplotlib", "plot")
    except MissingInputError as missing:
        screen.say(f"no figure: {missing.message}: {missing.hint}")
        return False
    return True


@contextmanager
def ticking(screen: Screen, label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show progress over device-steps whose number is a guess: it ends full, never overfull."""
    left = total
    with screen.progress(label, total, "device-steps") as bar:

        def tick(steps: int) -> None:
            nonlocal left
            bar.advance(min(steps, left))
            left -= min(steps, left)

        yield tick
        tick(total)


class _Count(Advance):
    """It counts units that are done, and their rate since this process began."""

    def __init__(self, total: int, unit: str, done: int) -> None:
        self._total, self._unit = total, unit
        self._done = self._before = done
        self._fields = ""
        self._started_s = time.monotonic()

    def count(self, units: int, fields: Mapping[str, float]) -> None:
        """Count more units; fields stay as they were where there are none."""
        self._done += units
        if fields:
            self._fields = " ".join(f"{name} {value:.3g}" for name, value in fields.items())

    @property
    def elapsed(self) -> str:
        """Return the time since the start, ``0:00:15``."""
        return _clock(time.monotonic() - self._started_s)

    @property
    def _share(self) -> str:
        return f"{100 * self._done // max(self._total, 1)} %"

    @property
    def _per_s(self) -> float:
        """Return units per second, of this process alone."""
        return (self._done - self._before) / max(time.monotonic() - self._started_s, 1e-9)

    @property
    def _rate(self) -> str:
        return f"{_significant(self._per_s)} {self._unit}/s" if self._unit else ""


class _Bar(_Count):
    """It is a line of the live display."""

    def __init__(self, bars: "RichProgress", label: str, total: int, unit: str, done: int) -> None:
        super().__init__(total, unit, done)
        self._bars = bars
        texts = dict.fromkeys(("count", "rate", "fields"), "")
        self.task = bars.add_task(label, total=total, completed=done, **texts)
        self.advance(0)

    def __str__(self) -> str:
        """Say how far it is, since when."""
        return f"{self._counted} {self._fields} in {self.elapsed}".replace("  ", " ")

    @property
    def _counted(self) -> str:
        return f"{self._done}/{self._total}" if self._unit else self._share

    def advance(self, count: int = 1, **fields: float) -> None:
        self.count(count, fields)
        texts = {"count": self._counted, "rate": self._rate, "fields": self._fields}
        self._bars.update(self.task, advance=count, **texts)


class _Heartbeat(_Count):
    """It prints lines for log files, one every :data:`HEARTBEAT_S` and one at the end."""

    def __init__(self, stream: TextIO, label: str, total: int, unit: str, done: int) -> None:
        super().__init__(total, unit, done)
        self._stream, self._label = stream, label
        self._printed_s = self._started_s

    def advance(self, count: int = 1, **fields: float) -> None:
        self.count(count, fields)
        if time.monotonic() - self._printed_s >= HEARTBEAT_S:
            left_s = (self._total - self._done) / max(self._per_s, 1e-9)
            self.print_line(f"eta {_clock(left_s)}")

    def print_line(self, when: str) -> None:
        """Print how far it is, and a remark on the time."""
        self._printed_s = time.monotonic()
        done = f"{self._done}/{self._total} ({self._share}) {self._rate}"
        line = f"{self._label} {done if self._unit else self._share} {self._fields} {when}"
        print(" ".join(one_line(line).split()), file=self._stream, flush=True)


def one_line(text: str) -> str:
    """Keep a text on one line and harmless: control characters become escapes (``\\n``, ``\\x1b``).

    The Unicode line separators and direction overrides count as control characters too.
    """
    return "".join(
        one if one.isprintable() or one == "\u00a0" else one.encode("unicode_escape").decode()
        for one in text
    )


def span(
    value: float | None, interval: Sequence[float] | None, decimals: int, bound: str = ""
) -> str | None:
    """Set a number with its interval, ``112.5 (104.1 – 118.0)``, or one-sided, ``≥ 320.0 (…)``.

    A number that was stated, not measured, has none: ``100.0``.
    """
    if value is None:
        return None
    text = f"{bound} {value:.{decimals}f}" if bound else f"{value:.{decimals}f}"
    if interval is None:
        return text
    low, high = interval
    return f"{text} ({low:.{decimals}f} – {high:.{decimals}f})"


def tolerance(
    entry: Mapping[str, Any], value_key: str, key: str, decimals: int, bound: str
) -> str | None:
    """Set a tolerance of ``eval --json`` as :func:`span`, a bound where the range ended first."""
    censored, interval = entry[f"tolerance_{key}_censored"], entry[f"tolerance_{key}_ci95"]
    return span(entry[f"tolerance_{value_key}"], interval, decimals, bound if censored else "")


def described_steps(measured: Mapping[str, Any]) -> str:
    """Say which steps were scored; results from before there was a warm-up do not know."""
    if "scored_steps" not in measured:
        return "scored from the start on"
    return f"{measured['scored_steps']} steps scored after {measured['warmup_steps']}"


def percent(ratio: float | None) -> str:
    """Return a ratio of 1.38 as ``+38.0 %``."""
    return "unbounded" if ratio is None else f"{100 * (ratio - 1):+.1f} %"


def in_order(named: Mapping[str, Any], first: Sequence[str]) -> dict[str, Any]:
    """Return what is named ``first`` in that order, then the rest: files keep names sorted."""
    return {name: named[name] for name in dict.fromkeys((*first, *named)) if name in named}


def _console(stream: TextIO) -> "Console":
    from rich.console import Console

    return Console(file=stream, highlight=False, markup=False, emoji=False)


def _is_terminal(stream: TextIO) -> bool:
    """Return whether a bar can be redrawn; FORCE_COLOR makes rich say yes for files too."""
    if not stream.isatty():  # before rich is imported for nothing
        return False
    console = _console(stream)
    return console.is_interactive and not console.is_dumb_terminal


def layout(columns: Sequence[str], rows: Sequence[Sequence[str]], available: int) -> list[str]:
    """Set a table as lines of at most ``available`` characters, as far as its numbers allow.

    Headings wrap at spaces. Texts fold where the table would not fit otherwise; numbers never do.
    What still does not fit goes to further blocks, each repeating the first column.
    """
    right = [all(_is_number(row[index]) for row in rows) for index in range(len(columns))]
    longest = [max((len(row[index]) for row in rows), default=0) for index in range(len(columns))]
    words = [max((len(word) for word in name.split()), default=0) for name in columns]
    widths = [max(pair) for pair in zip(longest, words, strict=True)]
    while sum(widths) + GAP * (len(widths) - 1) > available:
        foldable = [i for i, width in enumerate(widths) if not right[i] and width > FOLD_AT]
        if not foldable:
            break
        widths[max(foldable, key=widths.__getitem__)] -= 1
    lines: list[str] = []
    for block in _blocks(widths, available):

        def set_row(row: Sequence[str], block: Sequence[int] = block) -> list[str]:
            """Return one row as the lines that its tallest cell needs."""
            folded = [textwrap.wrap(row[i], widths[i]) or [""] for i in block]
            form = (" " * GAP).join(f"{{:{'>' if right[i] else '<'}{widths[i]}}}" for i in block)
            lines = itertools.zip_longest(*folded, fillvalue="")
            return [form.format(*parts).rstrip() for parts in lines]

        lines += [""] if lines else []
        lines += set_row(columns)
        lines.append("-" * (sum(widths[i] + GAP for i in block) - GAP))
        for row in rows:
            lines += set_row(row)
    return lines


def _blocks(widths: Sequence[int], available: int) -> list[list[int]]:
    """Split columns into blocks that fit, each starting with column 0."""
    blocks = [[0]]
    for index in range(1, len(widths)):
        used = sum(widths[i] + GAP for i in blocks[-1])
        if len(blocks[-1]) > 1 and used + widths[index] > available:
            blocks.append([0])
        blocks[-1].append(index)
    return blocks


def _is_number(cell: str) -> bool:
    """Return whether a cell is a number, perhaps a bound (>320) or with an interval, or blank."""
    first, *_ = cell.lstrip("<>≤≥~ ").split() or [MISSING]
    try:
        return first == MISSING or math.isfinite(float(first.replace(",", "")))
    except ValueError:
        return False


def _cell(value: object) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if isinstance(value, float):
        return _significant(value)
    return one_line(str(value))


def _significant(value: float) -> str:
    """Set three significant digits, never in exponent form: 0.0123, 1.23, 12.3, 123, 12346."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}"


def _clock(seconds: float) -> str:
    whole = round(min(max(seconds, 0.0), 359_999.0))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
