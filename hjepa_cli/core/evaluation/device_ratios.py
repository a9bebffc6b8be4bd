"""Ratios of rows, with their intervals, tell how many times the devices of one another has."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.core.statistics import student_interval
from hjepa_cli.plugins import METHODS


def gain(rows: Sequence[Row], method: str, over: str, snr_db: float) -> Row | None:
    """Return the ratio of two methods' devices; ``None`` where one has none, or has a bound only.

    Returns:
        ``snr_db``, ``method``, ``over``, ``ratio``, ``ratio_ci95`` (``None``: unbounded above).
    """
    at = {row["method"]: row for row in rows if row["snr_db"] == snr_db and row["devices"]}
    if method not in at or over not in at or not comparable(at[method], at[over]):
        return None
    return {"snr_db": snr_db, "method": method, "over": over, **ratio_of(at[method], at[over])}


def comparable(above: Row, below: Row) -> bool:
    """Tell whether two rows with devices have a ratio: of a bound there is none."""
    return not (above["at_least"] or below["at_least"])


def ratio_of(above: Row, below: Row) -> Row:
    """Return ``ratio`` and ``ratio_ci95`` of the devices of two rows that have some.

    Rows counted on the same seeds, two or more (``devices_by_seed``), are compared seed by seed, by
    Student's interval of the logarithm.
    """
    ratio = above["devices"] / below["devices"]
    pairs = list(zip(*(row.get("devices_by_seed", ()) for row in (above, below)), strict=False))
    if len(pairs) > 1 and all(min(pair) > 0 for pair in pairs):
        logs = np.log([above / below for above, below in pairs])
        return {"ratio": ratio, "ratio_ci95": [math.exp(end) for end in student_interval(logs)]}
    ends = [(row["devices"], *row["devices_ci95"]) for row in (above, below)]
    return {"ratio": ratio, "ratio_ci95": ratio_interval(ends[0], ends[1])}


def best_flat(rows: Sequence[Row], snr_db: float) -> Row | None:
    """Return the row of the flat predictor (``ts-jepa-…``) with the most devices at one SNR."""
    return _best((row for row in rows if row["method"].startswith("ts-jepa-")), snr_db)


def best_reflex(rows: Sequence[Row], snr_db: float) -> Row | None:
    """Return the row of the reflex with the most devices at one SNR."""
    return _best(
        (row for row in rows if row["method"] in METHODS and METHODS[row["method"]].reflex), snr_db
    )


def _best(rows: Iterable[Row], snr_db: float) -> Row | None:
    at = (row for row in rows if row["snr_db"] == snr_db)
    return max(at, key=lambda row: row["devices"] or 0, default=None)


def ratio_interval(
    above: tuple[float, float, float], below: tuple[float, float, float]
) -> list[float | None]:
    """Return the 95 % interval of a ratio of independent parts, each (value, low, high).

    The method of variance estimates recovery (Zou and Donner, Statistics in Medicine 27, 2008) on
    the logarithm, which keeps lopsided intervals lopsided. Methods share their draws, so that their
    tolerances rise and fall together: this interval is then wider than it had to be.
    """
    a, a_low, a_high = (_log(value) for value in above)
    b, b_low, b_high = (_log(value) for value in below)
    low = a - b - math.hypot(a - a_low, b_high - b)
    high = a - b + math.hypot(a_high - a, b - b_low)
    return [math.exp(low), None if high == math.inf else math.exp(high)]


def _log(value: float) -> float:
    return math.log(value) if value > 0 else -math.inf
