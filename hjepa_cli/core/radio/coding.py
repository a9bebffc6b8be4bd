"""A packet takes more on the air by short-packet coding and retransmissions.

Capacity is the default everywhere. Under power control the SNR is known and a code of finite
length needs a few per cent more; under fading the outage already says it all
(docs/reference/radio.md).
"""

import math

import numpy as np
import numpy.typing as npt
from scipy import special

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.radio.channel import snr_ratio
from hjepa_cli.errors import UsageError

LONGEST_USES = 1e12


def normal_approximation_error(
    payload_bits: npt.ArrayLike, channel_uses: npt.ArrayLike, snr_db: npt.ArrayLike
) -> Floats:
    """Return the block error rate of the best code of n complex uses of an AWGN channel.

    ε = Q((n C − b + ½ log2 n) / √(n V)), C = log2(1 + γ), V = (1 − (1 + γ)⁻²) (log2 e)²: the normal
    approximation of Polyanskiy, Poor and Verdú (IEEE Trans. Inf. Theory 56(5), 2010) for a complex
    channel. A whole slot has n = W τ_o.
    """
    bits, n = np.asarray(payload_bits, np.float64), np.asarray(channel_uses, np.float64)
    if not (np.all(bits > 0) and np.all(n > 0)):
        raise UsageError("payload and channel uses of a packet must be above 0")
    return np.asarray(_block_error(bits, n, snr_ratio(snr_db)))[()]


def packet_uses(payload_bits: float, snr_db: float, block_error: float = 0.0) -> float:
    """Return how many complex channel uses a packet of b bits, everything included, takes.

    A block error of 0 counts at capacity, b / C; above 0 it is the fewest uses whose
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
    combining): after m copies the block error rate is that of a packet at m γ. That of the first
    fixes the length of all, see :func:`packet_uses`; after ``rounds`` copies a new sample is sent.
    """
    if rounds == 1 or block_error == 0.0:
        return (block_error,)
    uses = packet_uses(payload_bits, snr_db, block_error)
    combined = snr_ratio(snr_db) * np.arange(1.0, rounds + 1)
    left = _block_error(np.asarray(payload_bits), np.asarray(uses), combined)
    conditional = left[1:] / np.maximum(left[:-1], np.finfo(float).tiny)
    return (block_error, *np.minimum(conditional, 1.0).tolist())


def _block_error(bits: Floats, uses: Floats, snr: Floats) -> Floats:
    """Return the normal approximation at an SNR as a power ratio."""
    capacity = np.log2(1.0 + snr)
    dispersion = (1.0 - (1.0 + snr) ** -2) / math.log(2.0) ** 2
    margin = (uses * capacity - bits + 0.5 * np.log2(uses)) / np.sqrt(uses * dispersion)
    return np.asarray(special.ndtr(-margin))
