"""An indoor factory hall says where devices are, who is in sight, and what power each needs.

Halls are those of TR 38.901's calibration (Table 7.8-7), with one base station at the centre
instead of its 18, because the paper has one. Devices are dropped uniformly; each draws its
line-of-sight state, its shadow fading (correlated over 10 m) and its Rician K once.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.radio.channel import (
    DISTANCE_3D_M,
    line_of_sight_probability,
    path_loss_db,
    path_loss_row,
    snr_ratio,
)

SHADOWING_CORRELATION_M = 10.0  # TR 38.901 Table 7.5-6, InF, in sight and not
K_FACTOR_DB = (7.0, 8.0)  # mean and standard deviation; TR 38.901 Table 7.5-6, InF in sight
CLOSEST_M = DISTANCE_3D_M[0]  # nearer devices are pushed out to where the path-loss model starts
_HALL_KEY = 0x4A11


@dataclass(frozen=True)
class FactoryHall:
    """Is a hall with one base station at its centre; lengths are in metres."""

    length_m: float
    width_m: float
    clutter_density: float
    clutter_size_m: float
    clutter_height_m: float
    bs_height_m: float
    ue_height_m: float = 1.5


# TR 38.901 Table 7.8-7. In InF-LOS (the standard's InF-HH) both ends are above the clutter.
FACTORY_HALLS = {
    "InF-LOS": FactoryHall(300.0, 150.0, 0.2, 10.0, 1.0, 8.0),
    "InF-SL": FactoryHall(120.0, 60.0, 0.2, 10.0, 2.0, 1.5),
    "InF-DL": FactoryHall(300.0, 150.0, 0.6, 2.0, 6.0, 1.5),
    "InF-SH": FactoryHall(300.0, 150.0, 0.2, 10.0, 2.0, 8.0),
    "InF-DH": FactoryHall(120.0, 60.0, 0.6, 2.0, 6.0, 8.0),
}


@dataclass(frozen=True)
class Drop:
    """Holds devices dropped into a hall, as arrays [N]; positions are [N, 2].

    Positions and distances are from the base station's antenna. The loss includes shadow fading;
    the Rician K of devices out of sight is −∞ (Rayleigh).
    """

    position_m: Floats
    distance_2d_m: Floats
    distance_3d_m: Floats
    in_sight: Bools
    loss_db: Floats
    k_factor_db: Floats


def drop_devices(
    scenario: str,
    carrier_ghz: float,
    devices: int,
    seed: int,
    *,
    factory_hall: FactoryHall | None = None,
) -> Drop:
    """Drop devices into a hall (TR 38.901, clauses 7.4.1 to 7.4.4 and 7.5).

    Args:
        scenario: a key of :data:`~hjepa_cli.core.radio.channel.SCENARIOS`.
        carrier_ghz: carrier frequency.
        devices: how many; the first ones do not depend on it.
        seed: of positions, sight, shadowing and K.
        factory_hall: where; by default the scenario's own of :data:`FACTORY_HALLS`.

    Raises:
        UsageError: unknown scenario, or values outside the standard's range.
    """
    path_loss_row(scenario)  # refuses what is no scenario
    factory_hall = factory_hall or FACTORY_HALLS[scenario]
    draws = np.stack([generator(seed, _HALL_KEY, i).random(2) for i in range(devices)])
    normal = np.stack([generator(seed, _HALL_KEY, i, 1).standard_normal(3) for i in range(devices)])
    seen = np.stack([generator(seed, _HALL_KEY, i, 2).random() for i in range(devices)])
    position, distance_2d = _places(factory_hall, draws)
    distance_3d = np.hypot(distance_2d, factory_hall.bs_height_m - factory_hall.ue_height_m)
    in_sight = seen < line_of_sight_probability(
        scenario,
        distance_2d,
        clutter_density=factory_hall.clutter_density,
        clutter_size_m=factory_hall.clutter_size_m,
        clutter_height_m=factory_hall.clutter_height_m,
        bs_height_m=factory_hall.bs_height_m,
        ue_height_m=factory_hall.ue_height_m,
    )
    # Shadowing is correlated by e^(−Δ/10 m) over distances Δ (clause 7.4.4, eq. 7.4-5).
    apart = np.linalg.norm(position[:, None] - position[None], axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / SHADOWING_CORRELATION_M) + 1e-9 * np.eye(devices))
    in_sight_db, hidden_db = (
        path_loss_db(kind, carrier_ghz, distance_3d)
        + path_loss_row(kind).shadowing_db * (root @ normal[:, column])
        for column, kind in enumerate(("InF-LOS", scenario))
    )
    k_factor = K_FACTOR_DB[0] + K_FACTOR_DB[1] * normal[:, 2]
    return Drop(
        position_m=position,
        distance_2d_m=distance_2d,
        distance_3d_m=distance_3d,
        in_sight=in_sight,
        loss_db=np.where(in_sight, in_sight_db, hidden_db),
        k_factor_db=np.where(in_sight, k_factor, -np.inf),
    )


def required_power_dbm(
    target_snr_db: npt.ArrayLike,
    loss_db: npt.ArrayLike,
    noise_dbm: npt.ArrayLike,
    power_gain: npt.ArrayLike = 1.0,
) -> Floats:
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
) -> Floats:
    """Return G = P_max − P_required at mean fading; a fade deeper than G dB blocks the device."""
    required = required_power_dbm(target_snr_db, loss_db, noise_dbm)
    return np.asarray(np.asarray(power_limit_dbm, np.float64) - required)[()]


def _places(factory_hall: FactoryHall, draws: Floats) -> tuple[Floats, Floats]:
    """Return uniform positions [N, 2], seen from the centre, and their distances to it [N]."""
    place = (draws - 0.5) * np.array([factory_hall.length_m, factory_hall.width_m])
    far = np.hypot(place[:, 0], place[:, 1])
    # One in 10⁴ lands on the base station's mast: pushed out to where the model starts.
    place = place * np.maximum(CLOSEST_M / np.maximum(far, 1e-9), 1.0)[:, None]
    # Which rounding must not put a little nearer again.
    return place, np.asarray(np.maximum(np.hypot(place[:, 0], place[:, 1]), CLOSEST_M))
