"""The uplink channel has indoor-factory path loss, Rayleigh block fading, rate and outage.

Large scale: 3GPP TR 38.901, indoor factory (InF), clauses 7.4.1 and 7.4.2. Small scale, rate and
outage: the paper's system model, eqs. 2 to 4. Distances in metres, carrier in GHz, powers in dBm,
ratios in dB; every function broadcasts over numpy arrays and returns a float64 scalar for scalar
input. ``docs/reference/radio.md`` lists the assumptions.
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec

import numpy as np
import numpy.typing as npt

from hjepa_cli.config.schema import CARRIER_GHZ
from hjepa_cli.core.arrays import Bools, Floats, finite
from hjepa_cli.errors import ArrayError, HjepaError, UsageError

P = ParamSpec("P")

DISTANCE_3D_M = (1.0, 600.0)  # validity of Table 7.4.1-1 for InF
SNR_DB = (-100.0, 100.0)  # ours: wider than any link, narrow enough that nothing overflows
ROUNDING = 1e-12  # what lies (relatively) this close to a bound or a whole number is that number
THERMAL_NOISE_DBM_PER_HZ = -174.0  # kT at 290 K, rounded as in every link budget


@dataclass(frozen=True)
class PathLoss:
    """Holds a row of Table 7.4.1-1: intercept + distance·log10(d/m) + frequency·log10(f/GHz) in dB.

    ``never_below`` names the rows whose loss is a lower bound of this one: clutter can only add.
    """

    intercept_db: float
    distance_db: float
    frequency_db: float
    shadowing_db: float  # standard deviation of the log-normal shadow fading
    never_below: tuple[str, ...] = ()

    def mean_db(self, carrier_ghz: Floats, distance_3d_m: Floats) -> Floats:
        """Return the row's own loss, before its lower bounds."""
        slope = self.distance_db * np.log10(distance_3d_m)
        return np.asarray(
            self.intercept_db + slope + self.frequency_db * np.log10(carrier_ghz), np.float64
        )


def of_arrays(function: Callable[P, Floats]) -> Callable[P, Floats]:
    """Let a function of arrays raise ArrayError for shapes that do not go together."""

    @functools.wraps(function)
    def checked(*arguments: P.args, **named: P.kwargs) -> Floats:
        try:
            return function(*arguments, **named)
        except HjepaError:
            raise
        except (TypeError, ValueError) as error:
            raise ArrayError(f"{function.__name__}: {error}") from None

    return checked


# S/D: sparse or dense clutter; L/H: base station inside the clutter or above it.
SCENARIOS = {
    "InF-LOS": PathLoss(31.84, 21.5, 19.0, 4.3),
    "InF-SL": PathLoss(33.0, 25.5, 20.0, 5.7, ("InF-LOS",)),
    "InF-DL": PathLoss(18.6, 35.7, 20.0, 7.2, ("InF-LOS", "InF-SL")),
    "InF-SH": PathLoss(32.4, 23.0, 20.0, 5.9, ("InF-LOS",)),
    "InF-DH": PathLoss(33.63, 21.9, 20.0, 4.0, ("InF-LOS",)),
}


@of_arrays
def path_loss_db(scenario: str, carrier_ghz: npt.ArrayLike, distance_3d_m: npt.ArrayLike) -> Floats:
    """Return the median path loss in dB (TR 38.901 Table 7.4.1-1), without shadow fading.

    Args:
        scenario: a key of :data:`SCENARIOS`; all but ``"InF-LOS"`` are the non-line-of-sight loss.
        carrier_ghz: carrier frequency, 0.5 … 100 GHz.
        distance_3d_m: antenna-to-antenna distance, 1 … 600 m.

    Raises:
        UsageError: unknown scenario, or a frequency or distance outside the standard's range.
    """
    row = path_loss_row(scenario)
    carrier = _within("carrier frequency", carrier_ghz, CARRIER_GHZ, "GHz")
    distance = _within("3D distance", distance_3d_m, DISTANCE_3D_M, "m")
    loss = row.mean_db(carrier, distance)
    for bound in row.never_below:
        loss = np.maximum(loss, SCENARIOS[bound].mean_db(carrier, distance))
    return loss[()]


def path_loss_row(scenario: str) -> PathLoss:
    """Return the row of a scenario. Raises UsageError for one that there is not."""
    if scenario not in SCENARIOS:
        raise UsageError(f"unknown scenario {scenario!r}; choose one of {', '.join(SCENARIOS)}")
    return SCENARIOS[scenario]


@of_arrays
def line_of_sight_probability(
    scenario: str,
    distance_2d_m: npt.ArrayLike,
    *,
    clutter_density: npt.ArrayLike,
    clutter_size_m: npt.ArrayLike,
    clutter_height_m: npt.ArrayLike,
    bs_height_m: npt.ArrayLike,
    ue_height_m: npt.ArrayLike,
) -> Floats:
    """Return the probability that a link is in line of sight (TR 38.901 Table 7.4.2-1).

    P = exp(−d_2D / k) with k = −d_clutter / ln(1 − r), times (h_BS − h_UT) / (h_c − h_UT) for a
    base station above the clutter (SH, DH). SL and DL ignore the heights; ``"InF-LOS"`` is 1 (the
    standard's InF-HH: both ends above the clutter).

    Args:
        scenario: a key of :data:`SCENARIOS`.
        distance_2d_m: horizontal distance, ≥ 0.
        clutter_density: r, the fraction of the floor covered, 0 ≤ r < 1.
        clutter_size_m, clutter_height_m: d_clutter and h_c, typical of a clutter object.
        bs_height_m, ue_height_m: h_BS and h_UT, of the antennas of base station and device.

    Raises:
        UsageError: a value out of range; for SH and DH also clutter that is not above the device
            (there the formula has no meaning) or a base station below the clutter (that is SL, DL).
    """
    path_loss_row(scenario)  # refuses what is no scenario
    distance = _at_least_0("2D distance", distance_2d_m)
    allowed = "0 … 1 (r < 1)"
    density = _checked("clutter density", clutter_density, allowed, lambda r: (r >= 0) & (r < 1))
    size = positive("clutter size", clutter_size_m)
    if scenario == "InF-LOS":
        return np.ones(np.broadcast(distance, density, size).shape)[()]
    decay_per_m = -np.log1p(-density) / size  # 1/k, so that an empty hall (r = 0) gives P = 1
    if scenario in ("InF-SH", "InF-DH"):
        clutter = _at_least_0("clutter height", clutter_height_m)
        bs = _at_least_0("base-station height", bs_height_m)
        ue = _at_least_0("device height", ue_height_m)
        if np.any(clutter <= ue):
            raise UsageError(
                f"clutter height {np.min(clutter):g} m is not above the device at "
                f"{np.max(ue):g} m; {scenario} needs clutter higher than the device"
            )
        if np.any(bs < clutter):
            raise UsageError(
                f"base station at {np.min(bs):g} m is below the clutter at {np.max(clutter):g} m; "
                f"{scenario} has it above (inside the clutter: InF-SL, InF-DL)"
            )
        decay_per_m = decay_per_m * (clutter - ue) / (bs - ue)
    return np.asarray(np.exp(-distance * decay_per_m))[()]


@of_arrays
def thermal_noise_dbm(bandwidth_hz: npt.ArrayLike, noise_figure_db: npt.ArrayLike) -> Floats:
    """Return the noise power −174 dBm/Hz + 10 log10 W + F in dBm."""
    bandwidth = positive("bandwidth", bandwidth_hz)
    figure = finite(noise_figure_db, "noise figure")
    return np.asarray(THERMAL_NOISE_DBM_PER_HZ + 10.0 * np.log10(bandwidth) + figure)[()]


@of_arrays
def received_snr_db(
    power_dbm: npt.ArrayLike,
    loss_db: npt.ArrayLike,
    noise_dbm: npt.ArrayLike,
    power_gain: npt.ArrayLike = 1.0,
) -> Floats:
    """Return γ = 10^(−PL/10) P |H|² / N_c in dB (paper, eq. 2).

    The arguments are P, PL as from :func:`path_loss_db`, N_c as from :func:`thermal_noise_dbm`, and
    |H|², linear; 1 gives the mean SNR.
    """
    link = finite(power_dbm, "power") - finite(loss_db, "loss") - finite(noise_dbm, "noise")
    with np.errstate(divide="ignore"):  # a gain of 0 is −∞ dB
        return np.asarray(link + 10.0 * np.log10(_at_least_0("power gain", power_gain)))[()]


def rayleigh_power_gains(rng: np.random.Generator, shape: int | tuple[int, ...]) -> Floats:
    """Draw |H|² ~ Exp(1): the power gain of unit-mean Rayleigh fading.

    Block fading (paper, section II-B): one value per device and control step τ_o, independent
    across both.
    """
    return rng.standard_exponential(shape)


@of_arrays
def achievable_rate_bps(bandwidth_hz: npt.ArrayLike, snr_db: npt.ArrayLike) -> Floats:
    """Return the capacity W log2(1 + γ) in bit/s (paper, eq. 3)."""
    bandwidth = positive("bandwidth", bandwidth_hz)
    return np.asarray(bandwidth * np.log1p(snr_ratio(snr_db)) / math.log(2.0))[()]


@of_arrays
def outage_probability(
    rate_bps: npt.ArrayLike, bandwidth_hz: npt.ArrayLike, mean_snr_db: npt.ArrayLike
) -> Floats:
    """Return ε = P[W log2(1 + γ̄ |H|²) < R̄] = 1 − exp(−(2^(R̄/W) − 1) / γ̄) (paper, eq. 4).

    Args:
        rate_bps: R̄, the rate that must be carried: payload bits per slot duration.
        bandwidth_hz: W_i, the device's own share of the band.
        mean_snr_db: γ̄ = 10^(−PL/10) P / N_c, the SNR averaged over the fading.
    """
    rate = _at_least_0("rate", rate_bps)
    bandwidth = positive("bandwidth", bandwidth_hz)
    with np.errstate(over="ignore"):  # a hopeless rate overflows to ∞: outage 1
        needed_snr = np.expm1(rate / bandwidth * math.log(2.0))
        return np.asarray(-np.expm1(-needed_snr / snr_ratio(mean_snr_db)))[()]


def snr_ratio(snr_db: npt.ArrayLike) -> Floats:
    """Return the SNR as a power ratio, refusing what is not a number of dB within ±100."""
    return np.asarray(10.0 ** (_within("SNR", snr_db, SNR_DB, "dB") / 10.0))


def positive(name: str, value: npt.ArrayLike) -> Floats:
    """Return finite values above 0 as an array; raise UsageError for any other."""
    return _checked(name, value, "a finite value above 0", lambda v: (v > 0) & np.isfinite(v))


def _at_least_0(name: str, value: npt.ArrayLike) -> Floats:
    allowed = "a finite value of 0 or more"
    return _checked(name, value, allowed, lambda v: (v >= 0) & np.isfinite(v))


def _within(name: str, value: npt.ArrayLike, bounds: tuple[float, float], unit: str) -> Floats:
    """Return values within bounds; those that only rounding put outside are put on the bound."""
    low, high = bounds[0] - ROUNDING * abs(bounds[0]), bounds[1] + ROUNDING * abs(bounds[1])
    allowed = f"{bounds[0]:g} … {bounds[1]:g} {unit}"
    values = _checked(name, value, allowed, lambda v: (v >= low) & (v <= high))
    return np.asarray(np.clip(values, *bounds))


def _checked(
    name: str, value: npt.ArrayLike, allowed: str, right: Callable[[Floats], Bools]
) -> Floats:
    """Return values as an array; raise UsageError for the first that is not right, like NaN."""
    try:
        values = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{name} {value!r} is not a number") from None
    wrong = ~right(values)
    if np.any(wrong):
        raise UsageError(f"{name} {values[wrong].flat[0]:g} is out of range; use {allowed}")
    return values
