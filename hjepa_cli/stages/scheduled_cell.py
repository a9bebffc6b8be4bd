"""Blocks of loops on a scheduled uplink: simulated for every method, scheduler and SNR once."""

import itertools
import math
from collections.abc import Generator, Sequence
from concurrent.futures import Future
from typing import Any

from hjepa_cli.core.evaluation.cell import Row
from hjepa_cli.core.evaluation.load_search import (
    BLOCK_DEVICES,
    MAX_BISECTIONS,
    LoadPoint,
    SupportedLoad,
    combine,
    pooled_score,
)
from hjepa_cli.core.evaluation.load_simulator import LoadSimulator, OneLoad, PacketBits, Search
from hjepa_cli.core.evaluation.simulator import Tick, silent
from hjepa_cli.core.evaluation.workers import Workers
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.radio.coding import packet_uses
from hjepa_cli.core.radio.uplink import report_bits
from hjepa_cli.output.screen import Screen, ticking
from hjepa_cli.stages.model_set import Subject

VERIFY_AT = (0.9, 1.1)  # times the load
Key = tuple[str, str, float]  # method, scheduler, SNR in dB


class ScheduledCell:
    """Has loads simulated, and counts the devices that they make.

    Args:
        subject: the model, the settings.
        screen: for progress.
        workers: simulate.
    """

    def __init__(self, subject: Subject, screen: Screen, workers: Workers) -> None:
        self._subject, self._screen, self._workers = subject, screen, workers
        self._settings = subject.settings
        self._plant = actual_plant(subject.settings)
        self._bits: dict[str, int] = {}
        self._loads: dict[Key, SupportedLoad] = {}

    def find(
        self, methods: Sequence[str], grid_db: Sequence[float]
    ) -> Generator[tuple[str, str], None, None]:
        """Search the loads of all methods under all schedulers, as many at a time as there are
        workers; yields method and scheduler of each that is found.
        """
        submitted = [self._submit(PacketBits(name)) for name in methods]
        self._bits = dict(zip(methods, self._workers.results(submitted), strict=True))
        schedulers = self._settings.radio.schedulers
        keys = dict.fromkeys(
            self._key(*link)
            for link in itertools.product(methods, schedulers, grid_db)
            if self._uses(link[0], link[2]) <= self._slot_uses
        )
        # The longest first: devices that report look at what they see in every slot.
        jobs = sorted(keys, key=lambda key: key[1] != "innovation")
        total = len(jobs) * len(self._seeds) * MAX_BISECTIONS * self._load_steps
        with ticking(self._screen, f"{len(jobs)} loads", total) as tick:
            for key, found in self._workers.each(lambda key: self._search(key, tick), jobs):
                self._loads[key] = found
                yield key[:2]

    def row(self, name: str, scheduler: str, snr_db: float) -> Row:
        """Count one method's devices under one scheduler at one SNR."""
        settings, radio = self._settings, self._settings.radio
        bits = self._bits[name]
        sent_bits = bits + radio.overhead_bits
        uses, slot_uses = self._uses(name, snr_db), self._slot_uses
        row: Row = {
            "snr_db": snr_db,
            "method": name,
            "scheduler": scheduler,
            "devices": 0,
            "devices_ci95": [0, 0],
            "at_least": False,
            "bits_per_s": None,
            "ratio_to_limit": None,
            "bits_per_transmission": bits,
            "reason": None,
        }
        if uses > slot_uses:
            return row | {"reason": f"a packet takes {uses / slot_uses:.3g} slots"}
        found = self._loads[self._key(name, scheduler, snr_db)]
        row |= {
            "load_per_block": found.load,
            "load_ci95": list(found.interval),
            "at_least": found.at_least,
            "packets_per_block_slot": found.packets_per_slot,
            "reports_per_block_slot": found.reports_per_slot,
            "curve": [{"load": load, "score": score} for load, score in found.points],
        }
        row["devices_by_seed"] = [
            self._devices(one.load, one, uses, snr_db) for one in found.parts or (found,)
        ]
        ends = (found.load, *found.interval)
        counts = [self._devices(load, found, uses, snr_db) for load in ends]
        row["devices"], row["devices_ci95"] = counts[0], counts[1:]
        if found.load == 0:
            level = settings.protocol.acceptable_score
            return row | {"reason": f"below {level:g} even with one device per block"}
        reported = found.reports_per_slot * (report_bits(counts[0]) + radio.overhead_bits)
        per_slot = (found.packets_per_slot * sent_bits + reported) / found.load
        row["bits_per_s"] = per_slot / self._plant.step_s
        if (limit := self._plant.data_rate_limit_bits_per_s) > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / limit
        if row["devices"] == 0:
            row["reason"] = "fewer than one device"
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
            return [
                self._check(link, share, self._workers.results(points, tick))
                for link, share, points in submitted
            ]

    def _check(self, link: Key, share: float, points: Sequence[LoadPoint]) -> Row:
        protocol = self._settings.protocol
        score, interval = pooled_score(points, protocol.bootstrap, self._settings.seed)
        level, inside = protocol.acceptable_score, share < 1
        return {
            "method": f"{link[0]}, {link[1]}",
            "share_of_tolerance": share,
            "load": points[0].load,
            "score": score,
            "ci95": list(interval),
            "expected": "above" if inside else "below",
            "passed": interval[0] > level if inside else interval[1] < level,
        }

    def _search(self, key: Key, tick: Tick) -> SupportedLoad:
        """The load of all seeds: the first seed's is where the search of the others begins."""
        first, *others = self._seeds
        [found] = self._workers.results([self._submit(Search(*key, first), tick)], tick)
        units = [Search(*key, seed, found.load) for seed in others]
        submitted = [self._submit(unit, tick) for unit in units]
        return combine([found, *self._workers.results(submitted, tick)])

    def _submit(self, unit: Search | OneLoad | PacketBits, tick: Tick = silent) -> "Future[Any]":
        model = self._subject.of(unit.method).file
        return self._workers.submit(LoadSimulator, self._settings, model, unit, tick)

    def _key(self, name: str, scheduler: str, snr_db: float) -> Key:
        """What a load is kept under: it is often the same at every SNR."""
        return name, scheduler, snr_db if self._settings.radio.load_depends_on_snr else 0.0

    def _uses(self, name: str, snr_db: float) -> float:
        """Channel uses of a packet."""
        radio = self._settings.radio
        return packet_uses(self._bits[name] + radio.overhead_bits, snr_db, radio.block_error)

    @property
    def _slot_uses(self) -> float:
        """Channel uses of a slot."""
        return self._settings.radio.bandwidth_hz * self._plant.step_s

    @property
    def _load_steps(self) -> int:
        """Device-steps of one load, about."""
        return BLOCK_DEVICES * self._settings.protocol.total_steps

    @property
    def _seeds(self) -> Sequence[int]:
        return range(self._settings.seed, self._settings.seed + self._settings.radio.seeds)

    def _devices(self, load: float, found: SupportedLoad, uses: float, snr_db: float) -> int:
        """N = ⌊load · slot ÷ (packet + reports)⌋; a report's size depends on N, hence the loop."""
        radio, devices = self._settings.radio, 0
        slot_uses = self._slot_uses
        guess = math.floor(load * slot_uses / uses * (1 + 1e-12))
        for _ in range(5):
            if guess == devices:
                break
            devices = guess
            report_sent = report_bits(devices) + radio.overhead_bits
            report = packet_uses(report_sent, snr_db, radio.block_error)
            block = uses + found.reports_per_slot * report
            guess = math.floor(load * slot_uses / block * (1 + 1e-12))
        return guess
