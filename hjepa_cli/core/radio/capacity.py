"""A slot of a band has a capacity; SNRs are read as users give them.

A cell of W hertz has slots of one control step τ_o; a packet has b bits, the SNR is γ̄.
"""

from decimal import Decimal, InvalidOperation

import numpy as np
import numpy.typing as npt

from hjepa_cli.core.arrays import Floats, Integers
from hjepa_cli.core.radio.channel import ROUNDING, SNR_DB, achievable_rate_bps, positive
from hjepa_cli.errors import UsageError

DEFAULT_STEP_DB = 5
MAX_SNR_POINTS = 500


def slot_capacity(
    payload_bits: npt.ArrayLike,
    bandwidth_hz: npt.ArrayLike,
    slot_s: npt.ArrayLike,
    snr_db: npt.ArrayLike,
) -> Floats:
    """Return c = (W τ_o / b) log2(1 + γ̄): the packets that one slot of the whole band carries."""
    bits, slot = positive("payload", payload_bits), positive("slot", slot_s)
    return np.asarray(achievable_rate_bps(bandwidth_hz, snr_db) * slot / bits)[()]


def late_slots(packets_per_slot: npt.ArrayLike) -> Floats:
    """Return how many slots late a packet arrives: 1/c where a slot carries c < 1 of it, else 0.

    A packet that fits into its slot, up to rounding, counts as delivered in it; a raw camera frame
    may need several slots of the whole band, and by then it is that old.
    """
    c = positive("packets per slot", packets_per_slot)
    return np.asarray(np.where(c < 1.0 - ROUNDING, 1.0 / c, 0.0))[()]


def whole_devices(count: npt.ArrayLike) -> Integers:
    """Return ⌊count⌋, except that rounding errors of the arithmetic never cost a device."""
    return np.asarray(np.floor(np.multiply(count, 1.0 + ROUNDING)), np.int64)[()]


def parse_snr(text: str) -> list[float]:
    """Read ``--snr``: ``START:STOP[:STEP]`` in dB, both ends included, or a comma list.

    The step defaults to 5; ``20:20`` and ``20`` are one point. Points are counted in decimal, so
    ``0:1:0.1`` has eleven.

    Raises:
        UsageError: not numbers, a range that runs backwards, a step that is not positive, a value
            outside ±100 dB, the same value twice, more than 500 points.
    """
    if ":" not in text:
        values = [_decibels(part, text) for part in text.split(",")]
    else:
        parts = [_decibels(part, text) for part in text.split(":")]
        if len(parts) == 2:
            parts.append(Decimal(DEFAULT_STEP_DB))
        if len(parts) != 3:
            raise _bad_snr(text, "has too many colons")
        start, stop, step = parts
        if stop < start:
            raise _bad_snr(text, "runs backwards")
        if step <= 0:
            raise _bad_snr(text, "has a step that is not positive")
        if stop - start > step * MAX_SNR_POINTS:
            raise _bad_snr(text, f"has more than {MAX_SNR_POINTS} points")
        values = [start + index * step for index in range(int((stop - start) / step) + 1)]
    if len(values) > MAX_SNR_POINTS:
        raise _bad_snr(text, f"has more than {MAX_SNR_POINTS} points")
    if len(set(values)) < len(values):
        raise _bad_snr(text, "names a value twice")
    return [float(value) for value in values]


def _decibels(part: str, text: str) -> Decimal:
    try:
        value = Decimal(part.strip())
    except InvalidOperation:
        value = Decimal("nan")
    if not value.is_finite() or not SNR_DB[0] <= value <= SNR_DB[1]:
        problem = f"has {part.strip()[:20]!r} where a number of dB within ±{SNR_DB[1]:g} should be"
        raise _bad_snr(text, problem)
    return value


def _bad_snr(text: str, problem: str) -> UsageError:
    shown = text if len(text) <= 40 else f"{text[:40]}…"
    return UsageError(
        f"--snr {shown!r} {problem}; use START:STOP[:STEP] like 10:30 or 10:30:5, or a list like "
        "10,20,30",
        key="radio.snr_db",
    )
