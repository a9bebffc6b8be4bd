"""Blocks of loops on a scheduled uplink by description, as :mod:`hjepa_cli.core.evaluation.simulator`.

Searches of one method, scheduler and seed need nothing of each other but a first guess, so each is
a unit of work of its own.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.disagreement import Levels
from hjepa_cli.core.control.error_growth import Growth
from hjepa_cli.core.control.loop import Draws, every_step, simulate
from hjepa_cli.core.control.methods import Method, build_method
from hjepa_cli.core.evaluation.cell_simulation import measure_growth, measure_levels, simulate_cell
from hjepa_cli.core.evaluation.load_search import (
    BLOCK_DEVICES,
    MAX_LOAD,
    LoadPoint,
    SupportedLoad,
    blocks_for,
    find_load,
)
from hjepa_cli.core.evaluation.simulator import Tick
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.radio.channel import thermal_noise_dbm
from hjepa_cli.core.radio.coding import round_errors
from hjepa_cli.core.radio.factory_hall import drop_devices, power_margin_db
from hjepa_cli.core.radio.uplink import Access

CALIBRATION_SEED = 1_000_003  # added to the seed: growth is measured on other devices
# Loops whose force has gone wrong by this share of its range, and not at once, are near their load.
TELLING_ERROR, ERROR_AT_ONCE = 0.2, 0.05


@dataclasses.dataclass(frozen=True)
class Search:
    """A unit: the load that a block carries with a method under a scheduler on a seed's draws.

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
        """Simulate loads until it is found."""
        return simulator.search(self, tick)


@dataclasses.dataclass(frozen=True)
class OneLoad:
    """A unit: one load, in devices per block, whole or not; the rest as of :class:`Search`."""

    method: str
    scheduler: str
    snr_db: float
    seed: int
    load: float

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> LoadPoint:
        """Simulate it."""
        return simulator.simulate(self, tick)


@dataclasses.dataclass(frozen=True)
class PacketBits:
    """A unit: what a method's transmission costs."""

    method: str

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> int:
        """Build the method to know."""
        return simulator.method(self.method).bits_per_transmission


class LoadUnit(Protocol):
    """One of the three."""

    def compute(self, simulator: "LoadSimulator", tick: Tick) -> Any: ...


class LoadSimulator:
    """Simulates loads, and keeps what several units share.

    Args:
        settings: the plant, the protocol, the radio.
        model: for the methods on embeddings.
    """

    def __init__(self, settings: Settings, model: Model | None) -> None:
        self._settings, self._model = settings, model
        self._plant = actual_plant(settings)
        self._methods: dict[str, Method] = {}
        self._growth: dict[tuple[str, int], Growth] = {}
        self._levels: dict[tuple[str, int], Levels] = {}
        self._teacher: dict[int, Floats] = {}

    def run(self, unit: LoadUnit, tick: Tick) -> Any:
        """Compute a unit."""
        return unit.compute(self, tick)

    def search(self, wanted: Search, tick: Tick) -> SupportedLoad:
        """Find a load."""
        protocol = self._settings.protocol
        near = wanted.near
        if near is None:
            near = self._first_guess(wanted.method, wanted.seed)

        def simulate_load(load: int) -> LoadPoint:
            link = wanted.method, wanted.scheduler, wanted.snr_db, wanted.seed
            return self.simulate(OneLoad(*link, load), tick)

        return find_load(
            simulate_load,
            protocol.acceptable_score,
            protocol.bracket,
            replicates=protocol.bootstrap,
            seed=wanted.seed,
            start=near,
        )

    def simulate(self, one: OneLoad, tick: Tick) -> LoadPoint:
        """Simulate a load."""
        radio, blocks, seed = self._settings.radio, blocks_for(one.load), one.seed
        devices = round(one.load * blocks)
        margin_db, k_factor_db = self._links(one.snr_db, seed, devices)
        method, levels = self.method(one.method), None
        if radio.uncertainty == "levels" and method.two_levels:
            method = dataclasses.replace(method, controller=method.two_levels)
            levels = self._levels_of(method, seed)
        access = Access(
            scheduler=one.scheduler,
            blocks=blocks,
            margin_db=margin_db,
            k_factor_db=k_factor_db,
            coherence_slots=radio.coherence_slots,
            round_errors=round_errors(
                method.bits_per_transmission + radio.overhead_bits,
                one.snr_db,
                radio.block_error,
                radio.harq_rounds,
            ),
            growth=levels.growth if levels else self._growth_of(one.method, seed),
            seed=seed,
            levels=levels,
        )
        protocol = self._settings.protocol
        outcome = simulate_cell(self._plant, protocol, seed, devices, access, method, tick=tick)
        return LoadPoint(devices / blocks, blocks, outcome, self._reference(seed, devices))

    def method(self, name: str) -> Method:
        """A method, built and fitted when it is asked for first."""
        if name not in self._methods:
            self._methods[name] = build_method(name, self._settings, self._model)
        return self._methods[name]

    def _first_guess(self, name: str, seed: int) -> float | None:
        """Where to begin to look for a load; ``None`` in the middle of all loads."""
        errors = np.sqrt(self._growth_of(name, seed).table)
        if errors[0] > ERROR_AT_ONCE:
            return None
        return float(min(int(np.searchsorted(errors, TELLING_ERROR)) + 1, MAX_LOAD))

    def _links(self, snr_db: float, seed: int, devices: int) -> tuple[float | Floats, Any]:
        """Power margin and Rician K of the devices."""
        radio = self._settings.radio
        if radio.topology == "target":
            return radio.power_margin_db, -math.inf
        drop = drop_devices(radio.scenario, radio.carrier_ghz, devices, seed)
        noise_dbm = thermal_noise_dbm(radio.bandwidth_hz, radio.noise_figure_db)
        return (
            power_margin_db(radio.power_dbm, snr_db, drop.loss_db, noise_dbm),
            drop.k_factor_db,
        )

    def _growth_of(self, name: str, seed: int) -> Growth:
        if (name, seed) not in self._growth:
            self._growth[name, seed] = self._calibrate(measure_growth, self.method(name), seed)
        return self._growth[name, seed]

    def _levels_of(self, method: Method, seed: int) -> Levels:
        if (method.name, seed) not in self._levels:
            self._levels[method.name, seed] = self._calibrate(measure_levels, method, seed)
        return self._levels[method.name, seed]

    def _calibrate(self, measure: Callable[..., Any], method: Method, seed: int) -> Any:
        return measure(self._plant, self._settings.protocol, seed + CALIBRATION_SEED, method)

    def _reference(self, seed: int, devices: int) -> Floats:
        """The teacher's score of the first devices, on the true state at every step."""
        known = self._teacher.get(seed, np.zeros(0))
        if len(known) < devices:  # the first of many devices are the few
            count = BLOCK_DEVICES if devices <= BLOCK_DEVICES else max(devices, MAX_LOAD)
            protocol = self._settings.protocol
            teacher = build_method("optimal", self._settings, None)
            outcome = simulate(
                self._plant,
                Draws.make(protocol, count, seed),
                every_step(protocol.total_steps, count)[None],
                teacher.controller(count),
                teacher.sensor,
            )
            known = self._teacher[seed] = outcome.score[0]
        return known[:devices]
