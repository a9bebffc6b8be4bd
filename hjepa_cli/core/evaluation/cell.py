"""One radio cell full of control loops: what a loop needs of the link, and how many the cell fits.

Joins a method's measured tolerance with a law of :mod:`hjepa_cli.core.radio.capacity` and puts
the count beside the bits that control needs in theory. The rows are those of ``scale --json``.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hjepa_cli.config.checks import REFLEXES, split_late
from hjepa_cli.core.control.loop import packets_per_step
from hjepa_cli.core.radio.capacity import (
    Noise,
    duty_devices,
    equal_delivery_probability,
    equal_devices,
    late_slots,
    slot_capacity,
)
from hjepa_cli.core.statistics import student_interval

Law = Literal["duty", "equal"]
Row = dict[str, Any]


@dataclass(frozen=True)
class Need:
    """What one loop of a method needs of the link to stay at the acceptable score.

    Attributes:
        tolerance: D* in steps (``duty``) or p* (``equal``); ``None`` for a method without a link.
        interval: its 95 % interval, ordered so that device counts ascend.
        at_least: the score was still acceptable where the measured range ends; there may be more.
        payload_bits: b.
        delay_steps: how late its packets were when the tolerance was measured.
        warmup_steps, scored_steps: of the loops that the tolerance was measured on.
    """

    method: str
    tolerance: float | None
    interval: tuple[float, float] | None
    at_least: bool
    payload_bits: int | None
    delay_steps: int = 0
    warmup_steps: int = 1
    scored_steps: int = 1

    @classmethod
    def under(cls, law: Law, method: str, entry: Mapping[str, Any]) -> "Need":
        """Read the entry of ``eval --json`` of a method, on time or late."""
        name, delay_steps = split_late(method)
        key, kind = ("tolerance_gap_steps", "gap") if law == "duty" else ("tolerance_p", "p")
        tolerance, ends = entry[key], entry[f"tolerance_{kind}_ci95"]
        ordered = None if ends is None else sorted(ends, reverse=law == "equal")
        return cls(
            method=name,
            tolerance=tolerance,
            interval=None if ordered is None else (ordered[0], ordered[1]),
            at_least=bool(entry[f"tolerance_{kind}_censored"]),
            payload_bits=entry["bits_per_transmission"],
            delay_steps=delay_steps,
            warmup_steps=entry["warmup_steps"],
            scored_steps=entry["scored_steps"],
        )

    def period_as_sent(self, gap_steps: float) -> float:
        """Mean steps between the packets that a loop with this tolerated gap really sent."""
        if gap_steps < 1:
            return gap_steps
        sent = packets_per_step(gap_steps, self.scored_steps, self.warmup_steps)
        return float(1 / sent)


@dataclass(frozen=True)
class Cell:
    """The radio cell.

    Attributes:
        law: ``"duty"`` or ``"equal"``.
        noise: ``"fixed"`` or ``"scaled"``; only ``equal`` looks at it.
        bandwidth_hz: W.
        slot_s: τ_o, one control step.
        limit_bits_per_s: λ/ln 2, what stabilising one plant takes at least; 0 if it is stable.
    """

    law: Law
    noise: Noise
    bandwidth_hz: float
    slot_s: float
    limit_bits_per_s: float

    def row(self, need: Need, snr_db: float) -> Row:
        """Count one method's devices at one SNR; where there are none, the reason.

        A block is what one packet takes at γ̄; ``load_per_block`` is devices ÷ blocks of a slot.
        """
        row: Row = {
            "snr_db": snr_db,
            "method": need.method,
            "devices": None,
            "devices_ci95": None,
            "at_least": need.at_least,
            "load_per_block": None,
            "bits_per_s": None,
            "ratio_to_limit": None,
            "bits_per_transmission": need.payload_bits,
            "tolerance": need.tolerance,
            "tolerance_ci95": None if need.interval is None else sorted(need.interval),
            "delay_steps": need.delay_steps,
            "reason": None,
        }
        if need.tolerance is None or need.payload_bits is None:
            return row | {"reason": "sees every state, whatever the link does"}
        if need.payload_bits == 0:
            return row | {"reason": "sends nothing: as many as there are, without this cell"}
        ends = need.interval or (need.tolerance, need.tolerance)
        row["devices"] = self._devices(need, need.tolerance, snr_db)
        row["devices_ci95"] = [self._devices(need, end, snr_db) for end in ends]
        link = (need.payload_bits, self.bandwidth_hz, self.slot_s, snr_db)
        row["load_per_block"] = row["devices"] / float(slot_capacity(*link))
        if row["devices"] == 0:
            return row | {"reason": self._why_nobody(need, snr_db)}
        packets_per_slot = self._packets_per_slot(need, snr_db)
        row["bits_per_s"] = need.payload_bits * packets_per_slot / self.slot_s
        if self.limit_bits_per_s > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / self.limit_bits_per_s
        return row

    def _devices(self, need: Need, tolerance: float, snr_db: float) -> int:
        assert need.payload_bits is not None
        link = (need.payload_bits, self.bandwidth_hz, self.slot_s, snr_db)
        if self.law == "equal":
            return int(equal_devices(tolerance, *link, noise=self.noise))
        c = slot_capacity(*link)
        return int(duty_devices(self._period_slots(need, tolerance, float(c)), c))

    def _period_slots(self, need: Need, tolerance: float, c: float) -> float:
        """Mean slots between the packets of a loop that tolerates gaps that long (``duty``)."""
        if not need.delay_steps:  # else the tolerance was measured with packets that late
            # A packet that is late on arrival has used up that much of the gap it could bridge.
            tolerance = max(tolerance - float(late_slots(c)), 0.0)
        return need.period_as_sent(tolerance)

    def _packets_per_slot(self, need: Need, snr_db: float) -> float:
        """Count the packets that reach the controller of a loop at its tolerance, per slot."""
        assert need.tolerance is not None and need.payload_bits is not None
        if self.law == "equal":
            return need.tolerance
        c = slot_capacity(need.payload_bits, self.bandwidth_hz, self.slot_s, snr_db)
        return 1 / self._period_slots(need, need.tolerance, float(c))

    def _why_nobody(self, need: Need, snr_db: float) -> str:
        assert need.tolerance is not None and need.payload_bits is not None
        tolerance = need.tolerance
        # p* = 1 is also where the measured range of a method ends that was measured nowhere else.
        if tolerance == (0.0 if self.law == "duty" else 1.0) and not need.at_least:
            return "below the acceptable score even with a packet in every slot"
        link = (need.payload_bits, self.bandwidth_hz, self.slot_s, snr_db)
        if self.law == "duty":
            slots = 1 / float(slot_capacity(*link))
            return f"a packet takes {slots:.3g} slots and serves for {tolerance:.3g}"
        p = float(equal_delivery_probability(1, *link, noise=self.noise))
        if need.at_least:
            return (
                f"one device alone delivers with p = {p:.3g}; measured down to {tolerance:.3g} only"
            )
        return f"one device alone delivers with p = {p:.3g}, but needs {tolerance:.3g}"


def gain(rows: Sequence[Row], method: str, over: str, snr_db: float) -> Row | None:
    """Return the ratio of two methods' devices at one SNR; ``None`` where one has none.

    Returns:
        ``snr_db``, ``method``, ``over``, ``ratio``, ``ratio_ci95`` (``None``: unbounded above).
    """
    at = {row["method"]: row for row in rows if row["snr_db"] == snr_db and row["devices"]}
    if method not in at or over not in at:
        return None
    return {"snr_db": snr_db, "method": method, "over": over, **ratio_of(at[method], at[over])}


def ratio_of(above: Row, below: Row) -> Row:
    """Return ``ratio`` and ``ratio_ci95`` of the devices of two rows that have some.

    Rows counted on the same seeds, two or more (``devices_by_seed``), are compared seed by seed.
    """
    ratio = above["devices"] / below["devices"]
    pairs = list(zip(*(row.get("devices_by_seed", ()) for row in (above, below)), strict=False))
    if len(pairs) > 1 and all(min(pair) > 0 for pair in pairs):
        return {"ratio": ratio, "ratio_ci95": paired_interval(pairs)}
    ends = [(row["devices"], *row["devices_ci95"]) for row in (above, below)]
    return {"ratio": ratio, "ratio_ci95": ratio_interval(ends[0], ends[1])}


def best_flat(rows: Sequence[Row], snr_db: float) -> Row | None:
    """Return the row of the flat predictor (``ts-jepa-…``) with the most devices at one SNR."""
    return _best((row for row in rows if row["method"].startswith("ts-jepa-")), snr_db)


def best_reflex(rows: Sequence[Row], snr_db: float) -> Row | None:
    """Return the row of the reflex with the most devices at one SNR."""
    return _best((row for row in rows if row["method"] in REFLEXES), snr_db)


def _best(rows: Iterable[Row], snr_db: float) -> Row | None:
    """The row with the most devices at one SNR; ``None`` where there is none."""
    at = (row for row in rows if row["snr_db"] == snr_db)
    return max(at, key=lambda row: row["devices"] or 0, default=None)


def paired_interval(pairs: Sequence[tuple[float, float]]) -> list[float]:
    """Return Student's 95 % interval of the ratio of pairs, taken on the logarithm."""
    logs = np.log([above / below for above, below in pairs])
    return [math.exp(end) for end in student_interval(logs)]


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
