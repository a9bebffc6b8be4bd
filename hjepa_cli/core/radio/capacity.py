"""How many control loops one radio cell supports: the laws ``duty`` and ``equal``.

Both turn one property of a closed loop into a number of devices that share W hertz, in slots of one
control step τ_o, when a packet has b bits and the SNR is γ̄:

- ``duty``: power control holds every link at γ̄, a slot carries c packets one after the other, and
  a loop that needs one packet every D* slots uses 1/c of a slot each time: N = ⌊D* c⌋.
- ``equal``: all N devices send in every slot on W/N hertz over Rayleigh fading of mean SNR γ̄ and
  get through with probability p; N is the largest number with p ≥ p*, the least the loop survives.

Everything broadcasts over numpy arrays; counts are int64.
"""

import math
from decimal import Decimal, InvalidOperation
from typing import Literal

import numpy as np
import numpy.typing as npt

from hjepa_cli.core.radio.channel import SNR_DB, achievable_rate_bps, snr_ratio
from hjepa_cli.errors import UsageError

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Noise = Literal["fixed", "scaled"]

ROUNDING = 1e-12  # a count this close (relatively) below an integer is that integer
DEFAULT_STEP_DB = 5
MAX_SNR_POINTS = 500


def slot_capacity(
    payload_bits: npt.ArrayLike,
    bandwidth_hz: npt.ArrayLike,
    slot_s: npt.ArrayLike,
    snr_db: npt.ArrayLike,
) -> FloatArray:
    """Return c = (W τ_o / b) log2(1 + γ̄): the packets that one slot of the whole band carries."""
    bits = _positive("payload", payload_bits, "bits")
    slot = _positive("slot", slot_s, "s")
    return np.asarray(achievable_rate_bps(bandwidth_hz, snr_db) * slot / bits)[()]


def late_slots(packets_per_slot: npt.ArrayLike) -> FloatArray:
    """Return how many slots late a packet arrives: 1/c where a slot carries c < 1 of it, else 0.

    A packet that fits into its slot counts as delivered in it; a raw camera frame may need several
    slots of the whole band, and by then it is that old.
    """
    c = _positive("packets per slot", packets_per_slot, "")
    return np.asarray(np.where(c < 1.0, 1.0 / c, 0.0))[()]


def duty_devices(tolerance_gap_steps: npt.ArrayLike, packets_per_slot: npt.ArrayLike) -> IntArray:
    """Return N = ⌊D* c⌋.

    Args:
        tolerance_gap_steps: D* ≥ 0 (real), the longest gap between packets that the loop survives.
        packets_per_slot: c, from :func:`slot_capacity`.
    """
    gap = np.asarray(tolerance_gap_steps, np.float64)
    if not np.all((gap >= 0) & np.isfinite(gap)):
        raise UsageError(f"gap tolerance {tolerance_gap_steps!r} must be finite and not negative")
    return _floor(gap * _positive("packets per slot", packets_per_slot, ""))


def equal_devices(
    tolerance_p: npt.ArrayLike,
    payload_bits: npt.ArrayLike,
    bandwidth_hz: npt.ArrayLike,
    slot_s: npt.ArrayLike,
    snr_db: npt.ArrayLike,
    *,
    noise: Noise = "fixed",
) -> IntArray:
    """Return the largest N whose delivery probability is still at least p*.

    With fixed noise (the paper's N_c, whatever W_i) N = ⌊(W τ_o / b) log2(1 − γ̄ ln p*)⌋. With noise
    scaled to W_i = W/N every device enjoys the SNR N γ̄, and N = (W τ_o / b) log2(1 − N γ̄ ln p*)
    has no closed form: see :func:`_scaled_noise_devices`.

    Args:
        tolerance_p: p* in (0, 1], the least delivery probability per slot that the loop survives.
        payload_bits: b. bandwidth_hz: W, the whole band. slot_s: τ_o.
        snr_db: γ̄, mean SNR over the fading; for scaled noise that of one device on the whole band.
        noise: ``"fixed"`` or ``"scaled"``.
    """
    p = np.asarray(tolerance_p, np.float64)
    if not np.all((p > 0) & (p <= 1)):
        raise UsageError(f"delivery tolerance {tolerance_p!r} must lie in (0, 1]")
    bits = _positive("payload", payload_bits, "bits")
    time_bandwidth = _positive("bandwidth", bandwidth_hz, "Hz") * _positive("slot", slot_s, "s")
    weakest = -np.log(p) * snr_ratio(snr_db)  # the SNR that is exceeded with probability p*
    packets_per_bit = time_bandwidth / bits  # packets per slot at 1 bit/s/Hz
    if noise == "fixed":
        return _floor(packets_per_bit * np.log1p(weakest) / math.log(2.0))
    if noise == "scaled":
        return _floor(_scaled_noise_devices(packets_per_bit, weakest))
    raise UsageError(f"unknown noise {noise!r}; choose fixed or scaled")


def equal_delivery_probability(
    devices: npt.ArrayLike,
    payload_bits: npt.ArrayLike,
    bandwidth_hz: npt.ArrayLike,
    slot_s: npt.ArrayLike,
    snr_db: npt.ArrayLike,
    *,
    noise: Noise = "fixed",
) -> FloatArray:
    """Return p = exp(−(2^(b N / (W τ_o)) − 1) / γ̄), with N γ̄ in place of γ̄ for scaled noise.

    This is 1 − :func:`~hjepa_cli.core.radio.channel.outage_probability` at R̄ = b/τ_o, W_i = W/N.
    """
    n = _positive("devices", devices, "")
    time_bandwidth = _positive("bandwidth", bandwidth_hz, "Hz") * _positive("slot", slot_s, "s")
    spectral_efficiency = _positive("payload", payload_bits, "bits") * n / time_bandwidth
    with np.errstate(over="ignore"):  # a hopeless rate overflows to ∞: never delivered
        needed_snr = np.expm1(spectral_efficiency * math.log(2.0))
    mean_snr = snr_ratio(snr_db) * (n if noise == "scaled" else 1.0)
    return np.asarray(np.exp(-needed_snr / mean_snr))[()]


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


def _scaled_noise_devices(packets_per_bit: FloatArray, weakest: FloatArray) -> FloatArray:
    """Solve n = k log2(1 + n a) for its positive root (0 where there is none).

    The excess k log2(1 + n a) − n is concave and 0 at n = 0, so it has a positive root exactly if
    it rises there (k a > ln 2), and Newton's method started above the root comes down to it without
    ever passing it. ln(1 + x) ≤ √x gives the start.
    """
    k, a = np.broadcast_arrays(packets_per_bit / math.log(2.0), weakest)
    solvable = k * a > 1.0
    k, a = np.where(solvable, k, 2.0), np.where(solvable, a, 1.0)
    n = k**2 * a
    for _ in range(100):
        step = (k * np.log1p(n * a) - n) / (1.0 - k * a / (1.0 + n * a))
        n = n + step
        if np.all(np.abs(step) <= 1e-14 * n):
            break
    return np.asarray(np.where(solvable, n, 0.0))


def _floor(count: FloatArray) -> IntArray:
    """Round down, except that rounding errors of the arithmetic never cost a device."""
    return np.asarray(np.floor(count * (1.0 + ROUNDING)), np.int64)[()]


def _positive(name: str, value: npt.ArrayLike, unit: str) -> FloatArray:
    values = np.asarray(value, np.float64)
    if not np.all((values > 0) & np.isfinite(values)):
        raise UsageError(f"{name} {value!r} {unit} must be finite and above 0".replace("  ", " "))
    return values


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
        "10,20,30"
    )
