"""What a packet takes on the air: short-packet coding, retransmissions.

Capacity is the default everywhere. Under power control the SNR is known and a code of finite
length needs a few per cent more; under fading the outage already says it all (docs/radio.md).
"""

import math

import numpy as np
import numpy.typing as npt
from scipy import special, stats

from hjepa_cli.core.radio.channel import snr_ratio
from hjepa_cli.errors import UsageError

FloatArray = npt.NDArray[np.float64]

LONGEST_USES = 1e12


def normal_approximation_error(
    payload_bits: npt.ArrayLike, channel_uses: npt.ArrayLike, snr_db: npt.ArrayLike
) -> FloatArray:
    """Return the block error rate of the best code of n complex uses of an AWGN channel.

    ε = Q((n C − b + ½ log2 n) / √(n V)), C = log2(1 + γ), V = (1 − (1 + γ)⁻²) (log2 e)²: the normal
    approximation of Polyanskiy, Poor and Verdú (IEEE Trans. Inf. Theory 56(5), 2010) for a complex
    channel.

    Args:
        payload_bits: b.
        channel_uses: n = W τ_o for a whole slot.
        snr_db: γ.
    """
    bits, n = np.asarray(payload_bits, np.float64), np.asarray(channel_uses, np.float64)
    if not (np.all(bits > 0) and np.all(n > 0)):
        raise UsageError("payload and channel uses of a packet must be above 0")
    return np.asarray(_block_error(bits, n, snr_ratio(snr_db)))[()]


def packet_uses(payload_bits: float, snr_db: float, block_error: float = 0.0) -> float:
    """Return how many complex channel uses a packet takes.

    Args:
        payload_bits: b, everything included.
        snr_db: γ.
        block_error: 0 counts at capacity, b / C; above 0 the fewest uses whose
            :func:`normal_approximation_error` is no more.

    Raises:
        UsageError: a block error rate outside 0 … 0.5.
    """
    at_capacity = payload_bits / math.log2(1.0 + float(snr_ratio(snr_db)))
    if block_error == 0.0:
        return at_capacity
    if not 0.0 < block_error <= 0.5:
        raise UsageError(f"block error rate {block_error:g}; expected 0 to 0.5")
    # The error rate falls with n from just below capacity on; the ½ log2 n can save a few uses.
    low, high = 0.5 * at_capacity, 2.0 * at_capacity + 1.0
    while normal_approximation_error(payload_bits, high, snr_db) > block_error:
        low, high = high, 2.0 * high
        if high > LONGEST_USES:
            raise UsageError(f"no packet of {payload_bits:g} bits at {snr_db:g} dB")
    for _ in range(100):
        middle = 0.5 * (low + high)
        if normal_approximation_error(payload_bits, middle, snr_db) > block_error:
            low = middle
        else:
            high = middle
    return high


def round_errors(
    payload_bits: float, snr_db: float, block_error: float, rounds: int
) -> tuple[float, ...]:
    """Return the error rate of each copy of a packet, given that all before it failed.

    Every copy arrives at the same SNR γ (power control) and the receiver adds their SNRs (chase
    combining): after m copies the block error rate is that of a packet at m γ.

    Args:
        payload_bits: b, everything included.
        snr_db: γ of each copy.
        block_error: of the first copy, which fixes its length; see :func:`packet_uses`.
        rounds: M ≥ 1 copies at most; 1 sends a new sample instead.
    """
    if rounds == 1 or block_error == 0.0:
        return (block_error,)
    uses = packet_uses(payload_bits, snr_db, block_error)
    combined = snr_ratio(snr_db) * np.arange(1.0, rounds + 1)
    left = _block_error(np.asarray(payload_bits), np.asarray(uses), combined)
    conditional = left[1:] / np.maximum(left[:-1], np.finfo(float).tiny)
    return (block_error, *np.minimum(conditional, 1.0).tolist())


def chase_outage_probability(
    spectral_efficiency: npt.ArrayLike, mean_snr_db: npt.ArrayLike, rounds: npt.ArrayLike
) -> FloatArray:
    """Return the outage after M rounds of chase combining over independent Rayleigh fading.

    The receiver adds the SNRs of M copies; Σ|H|² ~ Gamma(M, 1), so ε = P(M, (2^r − 1)/γ̄), the
    regularised lower incomplete gamma function. M = 1 is the paper's outage.

    Args:
        spectral_efficiency: r = R̄/W in bit/s/Hz of each round.
        mean_snr_db: γ̄.
        rounds: M ≥ 1.
    """
    needed = np.expm1(np.asarray(spectral_efficiency, np.float64) * math.log(2.0))
    return np.asarray(special.gammainc(rounds, needed / snr_ratio(mean_snr_db)))[()]


def mean_age_slots(
    spectral_efficiency: float, mean_snr_db: float, *, rounds: int, chase: bool
) -> float:
    """Return the mean age of the newest sample at the controller, one attempt in every slot.

    ``chase`` keeps sending the same sample for up to M rounds and then drops it; otherwise every
    attempt carries the newest sample and nothing is combined. The age is 0 in the slot in which the
    sample was taken. Renewal argument: E[age] = E[a] + (E[Y²]/E[Y] − 1)/2 for deliveries Y slots
    apart whose samples are a slots old.

    Args:
        spectral_efficiency: r = R̄/W in bit/s/Hz.
        mean_snr_db: γ̄.
        rounds: M.
        chase: combine copies of one sample, or send fresh ones.
    """
    if not chase:
        p = 1.0 - float(chase_outage_probability(spectral_efficiency, mean_snr_db, 1))
        return (1.0 - p) / p  # geometric intervals
    m = np.arange(1, rounds + 1)
    failed = np.asarray(chase_outage_probability(spectral_efficiency, mean_snr_db, m))
    ends = np.concatenate([[1.0], failed[:-1]]) - failed  # delivered in round m
    delivered = 1.0 - float(failed[-1])
    # A cycle is a geometric number of dropped samples of M rounds, then one delivered in round m.
    drop = float(failed[-1])
    mean_drops, square_drops = drop / delivered, drop * (1.0 + drop) / delivered**2
    mean_m, square_m = (float((ends * m**power).sum()) / delivered for power in (1, 2))
    mean = rounds * mean_drops + mean_m
    square = rounds**2 * square_drops + 2.0 * rounds * mean_drops * mean_m + square_m
    return (mean_m - 1.0) + (square / mean - 1.0) / 2.0


def _block_error(bits: FloatArray, uses: FloatArray, snr: FloatArray) -> FloatArray:
    """The normal approximation at an SNR as a power ratio."""
    capacity = np.log2(1.0 + snr)
    dispersion = (1.0 - (1.0 + snr) ** -2) / math.log(2.0) ** 2
    margin = (uses * capacity - bits + 0.5 * np.log2(uses)) / np.sqrt(uses * dispersion)
    return np.asarray(stats.norm.sf(margin))
