"""``--dry-run`` tells what a command would read, do and write, and about how long it would take.

Each stage has a function ``plan`` beside its ``run``, which counts what ``run`` would compute; here
is what they share. Times come from rates measured on two cores, so elsewhere they are right within
a factor of a few.
"""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from hjepa_cli.errors import HjepaError
from hjepa_cli.output.screen import Screen

T = TypeVar("T")

RATES_PER_S = {  # two cores of a server CPU; frames of an encoder are its inputs, of κ pictures
    "simulated steps": 400_000.0,
    "rendered frames": 6_000.0,
    "encoder training frames": 800.0,
    "encoder hardening frames": 1_200.0,
    "encoded frames": 7_000.0,
    "level training steps": 25.0,
    "reflex training samples": 80_000.0,
    "device-steps of searches": 3_000_000.0,
    "closed-loop frames": 7_000.0,
    "device-steps on embeddings": 60_000.0,
    "device-steps on states": 600_000.0,
    "exported frames": 2_000.0,
}


@dataclasses.dataclass(frozen=True)
class Plan:
    """It says in lines what a command reads, does and writes, taking ``seconds`` on two cores.

    ``memory_bytes`` is what grows with sizes, besides the program and its libraries.
    """

    command: str
    reads: list[str]
    work: list[str]
    writes: list[str]
    writes_bytes: int
    seconds: float
    memory_bytes: float = 0

    def show(self, screen: Screen) -> None:
        """Print the plan, one line per item, or as one JSON document."""
        if screen.json:
            minutes = round(self.seconds / 60, 2)
            screen.emit({"plan": dataclasses.asdict(self) | {"minutes": minutes}})
            return
        screen.result(f"hjepa {self.command} would")
        for verb, lines in (("read", self.reads), ("do", self.work), ("write", self.writes)):
            for line in lines or ["nothing"]:
                screen.result(f"  {verb:6}{line}")
        held = f", {size(self.memory_bytes)} of memory" if self.memory_bytes else ""
        on_disk = size(self.writes_bytes)
        screen.result(f"  in about {duration(self.seconds)}, {on_disk} on disk{held}")


def seconds_of(amounts: Mapping[str, float]) -> float:
    """Return about how long some work takes, by the names of :data:`RATES_PER_S`."""
    return sum(amount / RATES_PER_S[kind] for kind, amount in amounts.items())


def found(what: str, find: Callable[[], T], named: object, made_by: str) -> tuple[T | None, str]:
    """Return an input that has a ``path``, and the line of a plan about it.

    One that the user has not ``named`` need not be there, or readable, yet.
    """
    try:
        one = find()
    except HjepaError:
        if named is not None:
            raise
        return None, f"{what}: none yet ({made_by})"
    return one, f"{what} {one.path}"  # type: ignore[attr-defined]


def run_directory(stage: str, out: Path | None) -> str:
    """Return where a run would be written. Raises UsageError if ``out`` holds something else."""
    if out is None:
        return f"runs/{stage}/<next number>"
    from hjepa_cli.storage.runs import check_ours

    check_ours(out)
    return str(out)


def size(count: float) -> str:
    """Return a number of bytes for people: 12 kB, 3.4 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000 or unit == "GB":
            break
        count /= 1000
    return f"{count:.0f} {unit}" if count >= 10 or unit == "B" else f"{count:.1f} {unit}"


def duration(seconds: float) -> str:
    """Return a rough time for people: 20 s, 7 min, 3 h."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h"
