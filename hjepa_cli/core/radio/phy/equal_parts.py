"""Devices that send in every slot on equal parts of the band are counted in closed form.

All N send on W/N hertz over Rayleigh fading. At a mean SNR of γ̄ they get through with probability
p; N is the largest number with p ≥ p*.
"""

import math

import numpy as np
import numpy.typing as npt
from scipy.special import lambertw

from hjepa_cli.core.arrays import Floats, Integers
from hjepa_cli.core.radio.capacity import whole_devices
from hjepa_cli.core.radio.channel import positive, snr_ratio
from hjepa_cli.core.radio.phy.phy import Noise
from hjepa_cli.errors import UsageError

BRANCH_POINT = 0.999  # s above which Lambert's W₋₁ has lost too many digits


def equal_devices(
    tolerance_p: npt.ArrayLike,
    payload_bits: npt.ArrayLike,
    bandwidth_hz: npt.ArrayLike,
    slot_s: npt.ArrayLike,
    snr_db: npt.ArrayLike,
    *,
    noise: Noise = "fixed",
) -> Integers:
    """Return the largest N whose delivery probability is still at least p*.

    With fixed noise (the paper's N_c, whatever W_i) N = ⌊(W τ_o / b) log2(1 − γ̄ ln p*)⌋. With noise
    scaled to W_i = W/N every device enjoys the SNR N γ̄: N = ⌊(W τ_o / b) log2(1 − N γ̄ ln p*)⌋.

    Args:
        tolerance_p: p* in (0, 1], the least delivery probability per slot that the loop survives.
        payload_bits, bandwidth_hz, slot_s: b, W of the whole band, τ_o.
        snr_db: γ̄, mean SNR over the fading; for scaled noise that of one device on the whole band.
        noise: ``"fixed"`` or ``"scaled"``.

    Raises:
        UsageError: a value that is impossible.
    """
    p = np.asarray(tolerance_p, np.float64)
    if not np.all((p > 0) & (p <= 1)):
        raise UsageError(f"delivery tolerance {tolerance_p!r} must lie in (0, 1]")
    bits = positive("payload", payload_bits)
    time_bandwidth = positive("bandwidth", bandwidth_hz) * positive("slot", slot_s)
    weakest = -np.log(p) * snr_ratio(snr_db)  # the SNR that is exceeded with probability p*
    packets_per_bit = time_bandwidth / bits  # packets per slot at 1 bit/s/Hz
    if noise == "fixed":
        return whole_devices(packets_per_bit * np.log1p(weakest) / math.log(2.0))
    if noise == "scaled":
        return whole_devices(scaled_noise_devices(packets_per_bit, weakest))
    raise UsageError(f"unknown noise {noise!r}; choose fixed or scaled")


def scaled_noise_devices(packets_per_bit: npt.ArrayLike, weakest: npt.ArrayLike) -> Floats:
    """Return the positive root n of n = k log2(1 + n a), 0 where there is none.

    With κ = k/ln 2 and s = 1/(κ a) it is n = κ (−w − s), where w = W₋₁(−s e^(−s)) is the lower
    branch of Lambert's function; a root exists for s < 1. Towards s = 1 the argument nears the
    branch point −1/e and its digits run out: there n starts at the bound κ (1/s − s), which follows
    from ln(1 + x) ≤ x/√(1 + x). Two of Newton's steps make both as exact as a double can be.

    Args:
        packets_per_bit: k > 0.
        weakest: a ≥ 0, as a power ratio.
    """
    k, a = np.broadcast_arrays(np.divide(packets_per_bit, math.log(2.0)), weakest)
    solvable = k * a > 1.0
    k, a = np.where(solvable, k, 2.0), np.where(solvable, a, 1.0)
    s = 1.0 / (k * a)
    lower = lambertw(-s * np.exp(-s), -1).real
    n = k * np.where(s < BRANCH_POINT, -lower - s, 1.0 / s - s)
    for _ in range(2):
        n = n + (k * np.log1p(n * a) - n) / (1.0 - k * a / (1.0 + n * a))
    return np.asarray(np.where(solvable, n, 0.0))
