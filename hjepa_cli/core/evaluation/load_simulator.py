"""Loops on a scheduled uplink are simulated by description, as :mod:`~.simulator` does others.

Searches of one method, scheduler and seed need nothing of each other but a first guess, so each is
a unit of work of its own.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from hjepa_cli.config.schema import RadioSettings, Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.drivers import Driver
from hjepa_cli.core.control.loop import Draws, every_step, simulate
from hjepa_cli.core.evaluation.cell_simulation import measure_growth, measure_levels, simulate_cell
from hjepa_cli.core.evaluation.load_search import (
    BLOCK_DEVICES,
    MAX_LOAD,
    LoadPoint,
    blocks_for,
    find_load,
)
from hjepa_cli.core.evaluation.simulator import Simulator, Tick
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.radio.cell import physical_layer
from hjepa_cli.core.radio.channel import thermal_noise_dbm
from hjepa_cli.core.radio.doppler import FLAT, Motion, doppler_hz, tapped_delay_line
from hjepa_cli.core.radio.factory_hall import drop_devices, power_margin_db
from hjepa_cli.core.radio.laws.scheduled import SupportedLoad
from hjepa_cli.core.radio.uplink import Access
from hjepa_cli.plugins import SCHEDULERS

T = TypeVar("T")

CALIBRATION_SEED = 1_000_003  # added to the seed: growth is measured on other devices
# Loops whose force has gone wrong by this share of its range, and not at once, are near their load.
TELLING_ERROR, ERROR_AT_ONCE = 0.2, 0.05


@dataclasses.dataclass(frozen=True)
class OneLoad:
    """Is a unit: a block that carries one load, in devices, whole or not.

    Attributes:
        method, scheduler: their names.
    """

    method: str
    scheduler: str
    snr_db: float
    seed: int
    load: float

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> LoadPoint:
        """Simulate the load, on the draws of the seed."""
        settings, seed, blocks = simulator.settings, self.seed, blocks_for(self.load)
        radio, devices = settings.radio, round(self.load * blocks)
        method, levels = simulator.driver(self.method), None
        granted = None if SCHEDULERS[self.scheduler].in_turn else True
        carried = simulator.phy.carries(method.bits_per_transmission, self.snr_db, dynamic=granted)
        width_hz = carried.allocation_hz
        margin_db, k_factor_db = _links(radio, self.snr_db, seed, devices, width_hz)
        if radio.uncertainty == "levels" and method.two_levels:
            method = dataclasses.replace(method, controller=method.two_levels)
            levels = simulator.measured(measure_levels, method, seed)
        access = Access(
            scheduler=self.scheduler,
            blocks=blocks,
            margin_db=margin_db,
            k_factor_db=k_factor_db,
            coherence_slots=radio.coherence_slots,
            round_errors=carried.round_errors,
            growth=levels.growth if levels else simulator.measured(measure_growth, method, seed),
            seed=seed,
            levels=levels,
            round_trip_slots=carried.round_trip_slots,
            reports=simulator.phy.reports(devices, self.snr_db),
            motion=simulator.motion(width_hz),
        )
        outcome = simulate_cell(
            simulator.plant, settings.protocol, seed, devices, access, method, tick=tick
        )
        reference = simulator.teacher_score(seed, devices)
        return LoadPoint(devices / blocks, blocks, outcome, reference)


@dataclasses.dataclass(frozen=True)
class Search:
    """Is a unit: the load that a block carries with a method and a scheduler on a seed's draws.

    Attributes:
        method, scheduler: their names.
        near: a load near the one to find; ``None`` guesses it from the method's growth table.
    """

    method: str
    scheduler: str
    snr_db: float
    seed: int
    near: float | None = None

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> SupportedLoad:
        """Find the load."""
        protocol, near = simulator.settings.protocol, self.near
        if near is None:
            method = simulator.driver(self.method)
            errors = np.sqrt(simulator.measured(measure_growth, method, self.seed).table)
            if errors[0] <= ERROR_AT_ONCE:
                near = min(int(np.searchsorted(errors, TELLING_ERROR)) + 1, MAX_LOAD)
        link = self.method, self.scheduler, self.snr_db, self.seed
        return find_load(
            lambda load: OneLoad(*link, load).compute(simulator, tick),
            protocol.acceptable_score,
            protocol.bracket,
            replicates=protocol.bootstrap,
            seed=self.seed,
            start=near,
        )


@dataclasses.dataclass(frozen=True)
class PacketBits:
    """Is a unit: the bits of a method's transmission."""

    method: str

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> int:
        """Count the bits."""
        return simulator.driver(self.method).bits_per_transmission


class LoadSimulator(Simulator):
    """Holds what the units of one model share, calibrations and the teacher's scores, too."""

    def __init__(self, settings: Settings, model: Model | None) -> None:
        super().__init__(settings, model)
        self.phy = physical_layer(settings.radio, settings.nr, self.plant.step_s)
        self._calibrated: dict[tuple[Any, ...], Any] = {}
        self._teacher: dict[int, Floats] = {}

    def motion(self, allocation_hz: float) -> Motion | None:
        """Return how links move that send on a part of the band; ``None``: fades are blocks."""
        radio = self.settings.radio
        if radio.fading == "block":
            return None
        taps = FLAT
        if radio.fading != "jakes":
            profile = radio.fading.removeprefix("tdl-")
            taps = tapped_delay_line(profile, radio.delay_spread_s, radio.carrier_ghz)
        shift_hz = doppler_hz(radio.speed_m_s, radio.carrier_ghz)
        return Motion(shift_hz, self.plant.step_s, taps, radio.bandwidth_hz, allocation_hz)

    def measured(self, measure: Callable[..., T], method: Driver, seed: int) -> T:
        """Return what is calibrated of a method once per seed."""
        key, protocol = (measure, method.name, seed), self.settings.protocol
        if key not in self._calibrated:
            self._calibrated[key] = measure(self.plant, protocol, seed + CALIBRATION_SEED, method)
        found: T = self._calibrated[key]
        return found

    def teacher_score(self, seed: int, devices: int) -> Floats:
        """Return the teacher's score of the first devices, on the true state at every step."""
        known = self._teacher.get(seed, np.zeros(0))
        if len(known) < devices:  # the first of many devices are the few
            count = BLOCK_DEVICES if devices <= BLOCK_DEVICES else max(devices, MAX_LOAD)
            protocol = self.settings.protocol
            teacher = self.driver("optimal")
            outcome = simulate(
                self.plant,
                teacher.draws(Draws.make(protocol, count, seed)),
                every_step(protocol.total_steps, count)[None],
                teacher.controller(count),
                teacher.sensor,
            )
            known = self._teacher[seed] = outcome.score[0]
        return known[:devices]


def hall_coverage(
    radio: RadioSettings, snr_db: float, seed: int, devices: int, allocation_hz: float
) -> float:
    """Return the share of devices in a hall whose power suffices for an SNR at mean fading.

    Their power and the noise they have to exceed are on ``allocation_hz`` of the band.
    """
    margin_db, _ = _links(radio, snr_db, seed, devices, allocation_hz)
    return float(np.mean(np.asarray(margin_db) >= 0))


def _links(
    radio: RadioSettings, snr_db: float, seed: int, devices: int, allocation_hz: float
) -> tuple[float | Floats, float | Floats]:
    """Return the power margin and the Rician K of the devices, both in dB."""
    if radio.topology == "target":
        return radio.power_margin_db, -math.inf
    drop = drop_devices(radio.scenario, radio.carrier_ghz, devices, seed)
    noise_dbm = thermal_noise_dbm(allocation_hz, radio.noise_figure_db)
    margin_db = power_margin_db(radio.power_dbm, snr_db, drop.loss_db, noise_dbm)
    return margin_db, drop.k_factor_db
