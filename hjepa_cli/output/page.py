"""A report is a page for people: the result first, methods in words, tables that fit on paper."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hjepa_cli.output.screen import percent, span
from hjepa_cli.output.tables import described_cell
from hjepa_cli.plugins import METHODS

MOST_COLUMNS = 8  # of a table beside the first, so that it is never cut on paper
TEXT_BEGINS = "0123456789-+<>≥≤−"  # what does not begin so is no number


def explained(name: str) -> str:
    """Say in a few words what a method does."""
    method = name.partition("+")[0]  # without the delay at which its packets arrive
    if method not in METHODS:
        return ""
    one = METHODS[method]
    return one.does or f"a plugin's method; it sends: {one.sends}"


def methods_of(result: Mapping[str, Any]) -> list[str]:
    """Return the methods that a result speaks of, each once."""
    named = [row["method"] for row in result.get("rows", ())]
    stress = result.get("stress") or {}
    found = [*result.get("methods", ()), *stress.get("methods", ()), *named]
    return list(dict.fromkeys(str(name) for name in found))


@dataclasses.dataclass(frozen=True)
class Part:
    """It is a table, or a part of one that was too wide: texts, and whether they are no numbers."""

    columns: list[tuple[str, bool]]
    rows: list[list[tuple[str, bool]]]


def parts(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> list[Part]:
    """Return a table as parts that fit on paper, each with the first column; no empty rows."""
    texts = [[_text(cell) for cell in row] for row in rows]
    texts = [row for row in texts if any(row[1:]) or (row[0] and len(row) == 1)]
    if not texts:
        return []
    beside = len(columns) - 1
    count = max(-(-beside // MOST_COLUMNS), 1)
    size = -(-beside // count)
    found = []
    for start in range(1, beside + 1, size) if beside else (1,):
        chosen = [0, *range(start, min(start + size, len(columns)))]
        kept = [row for row in texts if any(row[i] for i in chosen[1:]) or not chosen[1:]]
        worded = [all(_is_text(row[i]) for row in kept if row[i]) for i in chosen]
        found.append(
            Part(
                [(columns[i], words) for i, words in zip(chosen, worded, strict=True)],
                [[(row[i], _is_text(row[i])) for i in chosen] for row in kept],
            )
        )
    return found


def _text(cell: Any) -> str:
    if cell is None:
        return ""
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _is_text(text: str) -> bool:
    return text[:1] not in TEXT_BEGINS


def gain_rows(gains: Iterable[Mapping[str, Any]]) -> list[list[str]]:
    """Return rows of gains in devices: who, over whom, at which SNR, how many more, interval."""
    return [
        [
            *(gain["method"], gain["over"], f"{gain['snr_db']:g}", percent(gain["ratio"])),
            " to ".join(percent(end) for end in gain["ratio_ci95"]),
        ]
        for gain in gains
        if gain["ratio"]
    ]


def headline(runs: Sequence[Mapping[str, Any]]) -> str:
    """Say what was found, in one or two sentences; nothing where no loop was closed.

    The runs, as :func:`hjepa_cli.stages.report.describe` tells them, are in the pipeline's order.
    """
    told = {"scale": _of_scale, "survive": _of_survival, "eval": _of_evaluation}
    for stage, say in told.items():
        for run in reversed(runs):
            if run["stage"] == stage and (said := say(run["result"])):
                return said
    return ""


def _of_scale(result: Mapping[str, Any]) -> str:
    rows = [row for row in result["rows"] if row["devices"] is not None]
    if not rows:
        return ""
    at_db = max(row["snr_db"] for row in rows)
    at_db = 20.0 if any(row["snr_db"] == 20.0 for row in rows) else at_db
    at: dict[str, Mapping[str, Any]] = {}  # by method, with its best scheduler
    for row in sorted(rows, key=lambda row: -row["devices"]):
        if row["snr_db"] == at_db:
            at.setdefault(row["method"], row)
    best = at.pop("hjepa") if "hjepa" in at else at.pop(next(iter(at)))
    count = span(best["devices"], best["devices_ci95"], 0, "≥" if best["at_least"] else "")
    said = f"One cell ({described_cell(result)}) supports {count} devices "
    said += f"with {best['method']} at {at_db:g} dB"
    compared = [f"{row['devices']:.0f} with {name}" for name, row in at.items() if row["devices"]]
    said = f"{'; '.join([said, *compared])}."
    return said if best["devices_ci95"] is None else f"{said} In brackets: 95 % interval."


def _of_survival(result: Mapping[str, Any]) -> str:
    first = result["rows"][0]
    time_ms = 1e3 * result["step_s"] * first["survival_steps"]
    return (
        f"With {first['method']} a loop goes on for {time_ms:g} ms without expected messages and "
        f"is lost with a probability of {first['loss_probability']:g} at most."
    )


def _of_evaluation(result: Mapping[str, Any]) -> str:
    entries = result["methods"]
    name = "hjepa" if "hjepa" in entries else next(iter(entries), None)
    if name is None or result.get("offline"):
        return ""
    entry = entries[name]
    if entry.get("tolerance_gap_steps") is None:
        return ""
    gap = span(entry["tolerance_gap_steps"], entry["tolerance_gap_ci95"], 1)
    bound = " at least" * bool(entry.get("tolerance_gap_censored"))
    return (
        f"{name} tolerates gaps of{bound} {gap} steps between packets. In brackets: 95 % interval."
    )
