"""What a server is doing: a table that is redrawn in a terminal, lines elsewhere."""

import time
from collections.abc import Mapping
from typing import Any, Self

from hjepa_cli.output.screen import Screen

ROWS = 16
LINE_S = 10.0
COLUMNS = ("device", "age", "lost", "missed", "skipped", "delay", "last force", "silent [s]")


class Dashboard:
    """It shows snapshots of a server: redrawn, as JSON lines, or as a line now and then."""

    def __init__(self, screen: Screen) -> None:
        self._screen, self._live = screen, None
        self._drawn = screen.is_terminal and not (screen.json or screen.quiet)
        self._line_s = time.monotonic()

    def __enter__(self) -> Self:
        if self._drawn:
            from rich.live import Live

            self._live = Live(auto_refresh=False, transient=True)  # type: ignore[assignment]
            self._live.__enter__()  # type: ignore[attr-defined]
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.__exit__(None, None, None)

    def say(self, line: str) -> None:
        """Print a line above the table."""
        if self._live is not None:
            self._live.console.print(line, markup=False, highlight=False)
        else:
            self._screen.say(line)

    def show(self, found: Mapping[str, Any]) -> None:
        """Show a snapshot."""
        if self._screen.json:
            self._screen.emit(found)
        elif self._live is not None:
            self._live.update(table(found), refresh=True)
        elif time.monotonic() - self._line_s >= LINE_S:
            self._line_s = time.monotonic()
            self._screen.say(headline(found))


def headline(found: Mapping[str, Any]) -> str:
    """Return a snapshot's totals in a line."""
    answered = found["answers"]
    missed = found["missed_deadlines"] / answered if answered else 0.0
    waits = found["answer_ms"]
    return (
        f"{found['devices']} devices, {found['embeddings_per_s']} embeddings/s, "
        f"{found['datagrams_per_s']} datagrams/s, answers in {waits['p50']:.2f} ms (p99 "
        f"{waits['p99']:.2f}), {100 * missed:.1f} % after their step, {found['lost']} lost, "
        f"{found['counts'].get('skipped_strides', 0)} strides skipped"
    )


def table(found: Mapping[str, Any]) -> Any:
    """Return a snapshot as rich draws it: totals, and the devices that fare worst."""
    from rich.table import Table
    from rich.text import Text

    drawn = Table(*map(Text, COLUMNS), title=Text(headline(found)), title_justify="left")
    for one in found["listed"][:ROWS]:
        cells = (
            *(one["device"], one["age_steps"], one["lost"], f"{one['missed']}/{one['answers']}"),
            *(one["skipped"], one["delay_steps"], one["source"], f"{one['silent_s']:.2f}"),
        )
        drawn.add_row(*(Text("-" if cell is None else str(cell)) for cell in cells))
    if found["devices"] > ROWS:
        drawn.caption = f"{found['devices'] - ROWS} more"
    return drawn
