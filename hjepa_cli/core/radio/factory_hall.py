"""An indoor factory hall: where devices are, who is in sight, and how much power each needs.

Halls are those of TR 38.901's calibration (Table 7.8-7), with one base station at the centre
instead of its 18, because the paper has one. Devices are dropped uniformly; each draws its
line-of-sight state, its shadow fading (correlated over 10 m) and its Rician K once.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.radio.channel import (
    SCENARIOS,
    line_of_sight_probability,
    path_loss_db,
    snr_ratio,
)
from hjepa_cli.errors import UsageError

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

SHADOWING_CORRELATION_M = 10.0  # TR 38.901 Table 7.5-6, InF, in sight and not
K_FACTOR_DB = (7.0, 8.0)  # mean and standard deviation; TR 38.901 Table 7.5-6, InF in sight
CLOSEST_M = 1.0  # the path-loss model starts here; nearer devices are pushed out to it
_HALL_KEY = 0x4A11


@dataclass(frozen=True)
class Hall:
    """A hall with one base station at its centre; lengths in metres."""

    length_m: float
    width_m: float
    clutter_density: float
    clutter_size_m: float
    clutter_height_m: float
    bs_height_m: float
    ue_height_m: float = 1.5


# TR 38.901 Table 7.8-7. In InF-LOS (the standard's InF-HH) both ends are above the clutter.
HALLS = {
    "InF-LOS": Hall(300.0, 150.0, 0.2, 10.0, 1.0, 8.0),
    "InF-SL": Hall(120.0, 60.0, 0.2, 10.0, 2.0, 1.5),
    "InF-DL": Hall(300.0, 150.0, 0.6, 2.0, 6.0, 1.5),
    "InF-SH": Hall(300.0, 150.0, 0.2, 10.0, 2.0, 8.0),
    "InF-DH": Hall(120.0, 60.0, 0.6, 2.0, 6.0, 8.0),
}


@dataclass(frozen=True)
class Drop:
    """Devices dropped into a hall; arrays over devices [N].

    Attributes:
        position_m: [N, 2] from the base station.
        distance_2d_m, distance_3d_m: from the base station's antenna.
        in_sight: line of sight.
        loss_db: path loss with shadow fading.
        k_factor_db: Rician K; −∞ (Rayleigh) out of sight.
    """

    position_m: FloatArray
    distance_2d_m: FloatArray
    distance_3d_m: FloatArray
    in_sight: BoolArray
    loss_db: FloatArray
    k_factor_db: FloatArray


def drop_devices(
    scenario: str, carrier_ghz: float, devices: int, seed: int, *, hall: Hall | None = None
) -> Drop:
    """Drop devices into a hall (TR 38.901, clauses 7.4.1 to 7.4.4 and 7.5).

    Args:
        scenario: a key of :data:`~hjepa_cli.core.radio.channel.SCENARIOS`.
        carrier_ghz: carrier frequency.
        devices: how many; the first ones do not depend on it.
        seed: of positions, sight, shadowing and K.
        hall: default: the scenario's own of :data:`HALLS`.

    Raises:
        UsageError: unknown scenario, or values outside the standard's range.
    """
    if scenario not in HALLS:
        raise UsageError(f"unknown scenario {scenario!r}; choose one of {', '.join(HALLS)}")
    hall = hall or HALLS[scenario]
    draws = np.stack([generator(seed, _HALL_KEY, i).random(2) for i in range(devices)])
    normal = np.stack([generator(seed, _HALL_KEY, i, 1).standard_normal(3) for i in range(devices)])
    seen = np.stack([generator(seed, _HALL_KEY, i, 2).random() for i in range(devices)])
    position = _places(hall, draws)
    distance_2d = np.hypot(position[:, 0], position[:, 1])
    distance_3d = np.hypot(distance_2d, hall.bs_height_m - hall.ue_height_m)
    in_sight = seen < line_of_sight_probability(
        scenario,
        distance_2d,
        clutter_density=hall.clutter_density,
        clutter_size_m=hall.clutter_size_m,
        clutter_height_m=hall.clutter_height_m,
        bs_height_m=hall.bs_height_m,
        ue_height_m=hall.ue_height_m,
    )
    correlation = _correlation_root(position)
    losses = {}
    for column, kind in enumerate(("InF-LOS", scenario)):
        shadowing = SCENARIOS[kind].shadowing_db * (correlation @ normal[:, column])
        losses[column] = path_loss_db(kind, carrier_ghz, distance_3d) + shadowing
    k_factor = K_FACTOR_DB[0] + K_FACTOR_DB[1] * normal[:, 2]
    return Drop(
        position_m=position,
        distance_2d_m=distance_2d,
        distance_3d_m=distance_3d,
        in_sight=in_sight,
        loss_db=np.where(in_sight, losses[0], losses[1]),
        k_factor_db=np.where(in_sight, k_factor, -np.inf),
    )


def required_power_dbm(
    target_snr_db: npt.ArrayLike,
    loss_db: npt.ArrayLike,
    noise_dbm: npt.ArrayLike,
    power_gain: npt.ArrayLike = 1.0,
) -> FloatArray:
    """Return the transmit power that holds a link at the target SNR: γ̄ N_c 10^(PL/10) / |H|².

    A device transmits only where this is at most its limit (TS-JEPA, eq. 23).
    """
    snr_ratio(target_snr_db)  # refuses what is no SNR
    gain = np.asarray(power_gain, np.float64)
    with np.errstate(divide="ignore"):  # no gain: infinite power
        link = np.asarray(target_snr_db, np.float64) + np.asarray(loss_db) + np.asarray(noise_dbm)
        return np.asarray(link - 10.0 * np.log10(gain))[()]


def power_margin_db(
    power_limit_dbm: npt.ArrayLike,
    target_snr_db: npt.ArrayLike,
    loss_db: npt.ArrayLike,
    noise_dbm: npt.ArrayLike,
) -> FloatArray:
    """Return G = P_max − P_required at mean fading; a fade deeper than G dB blocks the device."""
    required = required_power_dbm(target_snr_db, loss_db, noise_dbm)
    return np.asarray(np.asarray(power_limit_dbm, np.float64) - required)[()]


def _places(hall: Hall, draws: FloatArray) -> FloatArray:
    """Uniform positions [N, 2] in the hall, seen from its centre, outside ``CLOSEST_M``."""
    place = (draws - 0.5) * np.array([hall.length_m, hall.width_m])
    far = np.hypot(place[:, 0], place[:, 1])
    # One in 10⁴ lands on the base station's mast: pushed out to where the model starts.
    scale = np.maximum(CLOSEST_M / np.maximum(far, 1e-9), 1.0)
    return np.asarray(place * scale[:, None])


def _correlation_root(position_m: FloatArray) -> FloatArray:
    """Cholesky factor [N, N] of the shadowing correlation e^(−Δ/10 m) (clause 7.4.4, eq. 7.4-5)."""
    apart = np.linalg.norm(position_m[:, None] - position_m[None], axis=-1)
    correlation = np.exp(-apart / SHADOWING_CORRELATION_M) + 1e-9 * np.eye(len(position_m))
    return np.asarray(np.linalg.cholesky(correlation))
