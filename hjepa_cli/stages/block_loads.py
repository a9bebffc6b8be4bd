"""Simulation finds the loads that one block of a scheduled uplink carries."""

import itertools
from collections.abc import Generator, Sequence
from concurrent.futures import Future
from typing import Any

from hjepa_cli.core.evaluation.load_search import (
    BLOCK_DEVICES,
    MAX_BISECTIONS,
    combine,
    pooled_score,
)
from hjepa_cli.core.evaluation.load_simulator import (
    LoadSimulator,
    OneLoad,
    PacketBits,
    Search,
    hall_coverage,
)
from hjepa_cli.core.evaluation.simulator import Tick, silent
from hjepa_cli.core.evaluation.workers import Workers
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.law import Row
from hjepa_cli.core.radio.laws.scheduled import ScheduledBand, SupportedLoad
from hjepa_cli.output.screen import Screen, ticking
from hjepa_cli.plugins import SCHEDULERS
from hjepa_cli.stages.model_set import ModelSet
from hjepa_cli.stages.verification import VERIFY_AT, verdict

Key = tuple[str, str, float]  # method, scheduler, SNR in dB


class BlockLoads:
    """Has loads of the models simulated by workers, and counts the devices that they make."""

    def __init__(self, models: ModelSet, screen: Screen, workers: Workers) -> None:
        self._models, self._screen, self._workers = models, screen, workers
        self._settings = models.settings
        radio, protocol = self._settings.radio, self._settings.protocol
        kind = actual_plant(self._settings.plant, self._settings.conditions)
        cell = Cell.of(self._settings, kind)
        self._band = ScheduledBand(cell, protocol.acceptable_score)
        self._seeds = range(self._settings.seed, self._settings.seed + radio.seeds)
        self._load_steps = BLOCK_DEVICES * protocol.total_steps  # device-steps of a load, about
        self._bits: dict[str, int] = {}
        self._loads: dict[Key, SupportedLoad] = {}

    def find(
        self, methods: Sequence[str], grid_db: Sequence[float]
    ) -> Generator[tuple[str, str], None, None]:
        """Search all loads, as many at a time as there are workers; yield method and scheduler."""
        submitted = [self._submit(PacketBits(name)) for name in methods]
        self._bits = dict(zip(methods, self._workers.results(submitted), strict=True))
        schedulers = self._settings.radio.schedulers
        keys = dict.fromkeys(
            self._key(*link)
            for link in itertools.product(methods, schedulers, grid_db)
            if self._fits(*link)
        )
        # The longest first: devices that report look at what they see in every slot.
        jobs = sorted(keys, key=lambda key: not SCHEDULERS[key[1]].wants_reports)
        total = len(jobs) * len(self._seeds) * MAX_BISECTIONS * self._load_steps
        with ticking(self._screen, f"{len(jobs)} loads", total) as tick:
            for key, found in self._workers.each(lambda key: self._search(key, tick), jobs):
                self._loads[key] = found
                yield key[:2]

    def row(self, name: str, scheduler: str, snr_db: float) -> Row:
        """Count one method's devices under one scheduler at one SNR."""
        key = self._key(name, scheduler, snr_db)
        found = self._loads[key] if self._fits(name, scheduler, snr_db) else None
        row = self._band.row(found, name, scheduler, self._bits[name], snr_db)
        if self._settings.radio.topology != "hall":
            return row
        row["coverage"] = share = self._coverage(name, snr_db)
        if row["devices"] == 0:
            covered = f"{share:.0%} of the hall's devices reach {snr_db:g} dB"
            row["reason"] = f"{row['reason']}; {covered}"
        return row

    def verify(self, methods: Sequence[str], grid_db: Sequence[float]) -> list[Row]:
        """Simulate a little less and a little more than each load that was found, on its draws.

        The score's interval must lie above the acceptable score inside and below it outside. A side
        is left out where it would be less than a device per block, and the outside where the load
        is only known as a bound.
        """
        submitted = list[tuple[Key, float, list[Any]]]()
        links = itertools.product(methods, self._settings.radio.schedulers, grid_db)
        sides = [
            (link, share)
            for link in links
            if (found := self._loads.get(self._key(*link)))
            for share in VERIFY_AT
            if share * found.load >= 1 and (share < 1 or not found.at_least)
        ]
        total = len(sides) * len(self._seeds) * self._load_steps
        with ticking(self._screen, f"{len(sides)} loads verified", total) as tick:
            for link, share in sides:
                load = share * self._loads[self._key(*link)].load
                units = [OneLoad(*link, seed, load) for seed in self._seeds]
                submitted.append((link, share, [self._submit(unit, tick) for unit in units]))
            protocol, seed, verdicts = self._settings.protocol, self._settings.seed, []
            for (name, scheduler, _), share, futures in submitted:
                points = self._workers.results(futures, tick)
                score, interval = pooled_score(points, protocol.bootstrap, seed)
                point = {"load": points[0].load, "score": score, "ci95": list(interval)}
                what, acceptable = f"{name}, {scheduler}", protocol.acceptable_score
                verdicts.append(verdict(what, share, point, acceptable, inside=share < 1))
            return verdicts

    def _coverage(self, name: str, snr_db: float) -> float:
        """Return the share of a hall's devices, over all seeds, whose power suffices for an SNR."""
        width_hz = self._band.cell.phy.carries(self._bits[name], snr_db).allocation_hz
        link = self._settings.radio, snr_db
        shares = [hall_coverage(*link, seed, BLOCK_DEVICES, width_hz) for seed in self._seeds]
        return sum(shares) / len(shares)

    def _search(self, key: Key, tick: Tick) -> SupportedLoad:
        """Find the load of all seeds: the first seed's is where the search of the others begins."""
        first, *others = self._seeds
        [found] = self._workers.results([self._submit(Search(*key, first), tick)], tick)
        units = [Search(*key, seed, found.load) for seed in others]
        submitted = [self._submit(unit, tick) for unit in units]
        return combine([found, *self._workers.results(submitted, tick)])

    def _submit(self, unit: Search | OneLoad | PacketBits, tick: Tick = silent) -> "Future[Any]":
        model = self._models.of(unit.method).file
        return self._workers.submit(LoadSimulator, self._settings, model, unit, tick)

    def _key(self, name: str, scheduler: str, snr_db: float) -> Key:
        """Return the key that a load is kept under: it is often the same at every SNR."""
        return name, scheduler, snr_db if self._settings.radio.load_depends_on_snr else 0.0

    def _fits(self, name: str, scheduler: str, snr_db: float) -> bool:
        return self._band.fits(scheduler, self._bits[name], snr_db)
