"""What the user sees: notes, tables, progress, and the one JSON document of ``--json``.

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
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Protocol, TextIO

if TYPE_CHECKING:  # rich costs 80 ms; it is imported when something is drawn
    from rich.console import Console
    from rich.progress import Progress as RichProgress

HEARTBEAT_S = 10.0
MISSING = "-"
FOLD_AT = 24  # a text column may be squeezed to this many characters
GAP = 2  # blanks between columns


class Advance(Protocol):
    """What :meth:`Screen.progress` hands to its ``with`` block."""

    def advance(self, count: int = 1, **fields: float) -> None:
        """Count ``count`` more units; ``fields`` (``loss=0.1``) are shown beside them."""


class Screen:
    """The only way this program writes to the terminal.

    Args:
        quiet: show results and errors only.
        json: everything except :meth:`emit` goes to stderr.
        stdout, stderr: streams, for tests; by default the process's own.
    """

    def __init__(
        self,
        quiet: bool = False,
        json: bool = False,
        *,
        stdout: TextIO | None = None,
        stderr: TextIO | None = None,
    ) -> None:
        self.quiet = quiet
        self.json = json
        self._stdout = stdout or sys.stdout
        self._stderr = stderr or sys.stderr
        self._bars: RichProgress | None = None

    @property
    def is_terminal(self) -> bool:
        """Somebody watches, in a window where pictures can be redrawn."""
        return _is_terminal(self._results)

    def say(self, text: str) -> None:
        """Print one line about the work; silent when quiet."""
        if self.quiet:
            return
        if self._bars is not None:
            self._bars.console.print(
                one_line(text), markup=False, highlight=False, emoji=False, soft_wrap=True
            )
        else:
            print(one_line(text), file=self._stderr, flush=True)

    def result(self, text: str) -> None:
        """Print one line of the outcome, also when quiet."""
        self._print_result(one_line(text))

    def error(self, message: str, hint: str | None = None) -> None:
        """Print what was wrong and, on a second line, what to do next."""
        print(f"error: {one_line(message)}", file=self._stderr)
        if hint:
            print(f"hint: {one_line(hint)}", file=self._stderr)
        self._stderr.flush()

    def emit(self, document: Mapping[str, Any]) -> None:
        """Print the JSON document of ``--json``: one line, no NaN, undefined values are null."""
        print(json.dumps(plain(document), allow_nan=False), file=self._stdout, flush=True)

    def table(self, title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
        """Print a table, also when quiet.

        Args:
            title: one line above it.
            columns: headings; they may wrap at spaces.
            rows: cells; numbers are set right-aligned, ``None`` and NaN as ``-``. Where numbers do
                not fit the width of the terminal, the table continues in a second block that
                repeats the first column.
        """
        cells = [[_cell(value) for value in row] for row in rows]
        width = shutil.get_terminal_size((80, 24)).columns
        lines = textwrap.wrap(one_line(title), width) + layout(columns, cells, width)
        self._print_result("\n".join(lines))

    @contextmanager
    def progress(
        self, label: str, total: int, unit: str = "", *, done: int = 0
    ) -> Iterator[Advance]:
        """Show how far a loop is: a bar on a terminal, otherwise a line every ten seconds.

        Inside another one, a bar gives way to a line when it is full.

        Args:
            label: what is being done, one word or two.
            total: units of work.
            unit: their name, for the rate ("traj" → "310 traj/s"); without one, units are nothing
                that people count, and only the share of them is shown.
            done: units done before, by a run that is continued.
        """
        if self.quiet:
            yield _Silent()
        elif not _is_terminal(self._stderr):
            heartbeat = _Heartbeat(self._stderr, label, total, unit, done)
            yield heartbeat
            heartbeat.finish()
        else:
            is_inner = self._bars is not None
            with self._open_bars() as bars:
                task = bars.add_task(
                    label, total=total, completed=done, count="", rate="", fields=""
                )
                bar = _Bar(bars, task, total, unit, done)
                bar.advance(0)
                yield bar
                bars.refresh()
                if is_inner:
                    bars.remove_task(task)
                    self.say(f"{label} {bar}")

    @contextmanager
    def _open_bars(self) -> Iterator["RichProgress"]:
        """The live display; an inner ``progress`` adds a line to the outer one's."""
        if self._bars is not None:
            yield self._bars
            return
        from rich.progress import (
            BarColumn,
            Progress,
            TextColumn,
            TimeRemainingColumn,
        )

        with Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[count]}", markup=False),
            TextColumn("{task.fields[rate]}", markup=False),
            TextColumn("{task.fields[fields]}", markup=False),
            TimeRemainingColumn(elapsed_when_finished=True),
            console=_console(self._stderr),
        ) as bars:
            self._bars = bars
            try:
                yield bars
            finally:
                self._bars = None

    def _print_result(self, text: str) -> None:
        """To stdout; above the bars, where they are in the same terminal."""
        if self._bars is not None and self._results.isatty():
            self._bars.console.print(
                text, markup=False, highlight=False, emoji=False, soft_wrap=True
            )
        else:
            print(text, file=self._results, flush=True)

    @property
    def _results(self) -> TextIO:
        return self._stderr if self.json else self._stdout


@contextmanager
def ticking(screen: Screen, label: str, total: int) -> Iterator[Callable[[int], None]]:
    """A progress bar over device-steps whose number is a guess: it ends full, never overfull."""
    left = total
    with screen.progress(label, total, "device-steps") as bar:

        def tick(steps: int) -> None:
            nonlocal left
            bar.advance(min(steps, left))
            left -= min(steps, left)

        yield tick
        tick(total)


class _Silent:
    def advance(self, count: int = 1, **fields: float) -> None:
        pass


class _Bar:
    """One line of the live display."""

    def __init__(self, bars: "RichProgress", task: Any, total: int, unit: str, done: int) -> None:
        self._bars, self._task, self._total, self._unit = bars, task, total, unit
        self._done = self._before = done
        self._fields = ""
        self._started_s = time.monotonic()

    def __str__(self) -> str:
        """How far it is, since when."""
        elapsed_s = time.monotonic() - self._started_s
        return f"{self._counted} {self._fields} in {_clock(elapsed_s)}".replace("  ", " ")

    @property
    def _counted(self) -> str:
        share = _percent(self._done, self._total)
        return f"{self._done}/{self._total}" if self._unit else share

    def advance(self, count: int = 1, **fields: float) -> None:
        self._done += count
        self._fields = _fields(fields) or self._fields
        rate = (self._done - self._before) / max(time.monotonic() - self._started_s, 1e-9)
        self._bars.update(
            self._task,
            advance=count,
            count=self._counted,
            rate=f"{_significant(rate)} {self._unit}/s" if self._unit else "",
            fields=self._fields,
        )


class _Heartbeat:
    """Lines for log files: one every :data:`HEARTBEAT_S` and one at the end."""

    def __init__(self, stream: TextIO, label: str, total: int, unit: str, done: int) -> None:
        self._stream, self._label, self._total, self._unit = stream, label, total, unit
        self._done = self._before = done
        self._fields = ""
        self._started_s = self._printed_s = time.monotonic()

    def advance(self, count: int = 1, **fields: float) -> None:
        self._done += count
        self._fields = _fields(fields) or self._fields
        if time.monotonic() - self._printed_s >= HEARTBEAT_S:
            left_s = (self._total - self._done) / max(self._rate(), 1e-9)
            self._print(f"eta {_clock(left_s)}")

    def finish(self) -> None:
        self._print(f"in {_clock(time.monotonic() - self._started_s)}")

    def _rate(self) -> float:
        elapsed_s = time.monotonic() - self._started_s
        return (self._done - self._before) / max(elapsed_s, 1e-9)

    def _print(self, when: str) -> None:
        self._printed_s = time.monotonic()
        done = _percent(self._done, self._total)
        if self._unit:
            rate = f"{_significant(self._rate())} {self._unit}/s"
            done = f"{self._done}/{self._total} ({done}) {rate}"
        line = f"{self._label} {done} {self._fields} {when}"
        print(" ".join(one_line(line).split()), file=self._stream, flush=True)


def one_line(text: str) -> str:
    """Keep a text on one line and harmless: control characters become escapes (``\\n``, ``\\x1b``).

    The Unicode line separators and direction overrides count as control characters too.
    """
    return "".join(
        character if character.isprintable() or character == "\u00a0" else _escape(character)
        for character in text
    )


def span(
    value: float | None, interval: Sequence[float] | None, decimals: int, bound: str = ""
) -> str | None:
    """Set a number with its interval: ``112.5 (104.1 – 118.0)``.

    ``bound`` stands before a number that is only known to lie on one side: ``≥ 320.0 (…)``.
    """
    if value is None:
        return None
    low, high = interval or (value, value)
    text = f"{bound} {value:.{decimals}f}" if bound else f"{value:.{decimals}f}"
    return f"{text} ({low:.{decimals}f} – {high:.{decimals}f})"


def tolerance(
    entry: Mapping[str, Any], value_key: str, key: str, decimals: int, bound: str
) -> str | None:
    """Set a tolerance of ``eval --json``: ``112.5 (104.1 – 118.0)``.

    ``bound`` stands before it where the measured range ended first.
    """
    censored, interval = entry[f"tolerance_{key}_censored"], entry[f"tolerance_{key}_ci95"]
    return span(entry[f"tolerance_{value_key}"], interval, decimals, bound if censored else "")


def described_steps(measured: Mapping[str, Any]) -> str:
    """Say which steps were scored; results from before there was a warm-up do not know."""
    if "scored_steps" not in measured:
        return "scored from the start on"
    return f"{measured['scored_steps']} steps scored after {measured['warmup_steps']}"


def percent(ratio: float | None) -> str:
    """1.38 → ``+38.0 %``."""
    return "unbounded" if ratio is None else f"{100 * (ratio - 1):+.1f} %"


def in_order(named: Mapping[str, Any], first: Sequence[str]) -> dict[str, Any]:
    """What is named ``first`` in that order, then the rest: files keep names sorted."""
    return {name: named[name] for name in dict.fromkeys((*first, *named)) if name in named}


def plain(value: Any) -> Any:
    """Turn a result into JSON values: arrays to lists, paths to strings, NaN and ±inf to None.

    Raises:
        TypeError: for anything that has no JSON form.
    """
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):  # numpy and torch scalars and arrays
        return plain(value.tolist())
    raise TypeError(f"{type(value).__name__} has no JSON form")


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


def _console(stream: TextIO) -> "Console":
    from rich.console import Console

    return Console(file=stream, highlight=False, markup=False, emoji=False)


def _is_terminal(stream: TextIO) -> bool:
    """Can a bar be redrawn here? FORCE_COLOR makes rich say yes for files; a file cannot."""
    console = _console(stream)
    return stream.isatty() and console.is_interactive and not console.is_dumb_terminal


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
            """One row as the lines its tallest cell needs."""
            folded = [textwrap.wrap(row[i], widths[i]) or [""] for i in block]
            return [
                (" " * GAP)
                .join(
                    text.rjust(widths[i]) if right[i] else text.ljust(widths[i])
                    for i, text in zip(block, parts, strict=True)
                )
                .rstrip()
                for parts in itertools.zip_longest(*folded, fillvalue="")
            ]

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
    """Set right-aligned: numbers, also bounds (>320) or with an interval after them, and blanks."""
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
    """Three significant digits, never in exponent form: 0.0123, 1.23, 12.3, 123, 12346."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    decimals = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(decimals, 6)}f}"


def _fields(fields: Mapping[str, float]) -> str:
    return " ".join(f"{name} {value:.3g}" for name, value in fields.items())


def _percent(done: int, total: int) -> str:
    return f"{100 * done // max(total, 1)} %"


def _clock(seconds: float) -> str:
    whole = round(min(max(seconds, 0.0), 359_999.0))
    return f"{whole // 3600}:{whole // 60 % 60:02d}:{whole % 60:02d}"
