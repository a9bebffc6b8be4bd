"""Blocks of loops on a scheduled uplink: simulated for every method, scheduler and SNR once."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from hjepa_cli.core.cell import Row
from hjepa_cli.core.cell_loop import measure_growth, measure_levels, simulate_cell
from hjepa_cli.core.channel import thermal_noise_dbm
from hjepa_cli.core.coding import packet_uses, round_errors
from hjepa_cli.core.conditions import actual_plant
from hjepa_cli.core.disagreement import Levels
from hjepa_cli.core.growth import Growth
from hjepa_cli.core.hall import drop_devices, power_margin_db
from hjepa_cli.core.loop import Draws, Floats, every_step, simulate
from hjepa_cli.core.methods import Method, build_method
from hjepa_cli.core.scheduled import (
    BLOCK_DEVICES,
    MAX_BISECTIONS,
    MAX_LOAD,
    LoadPoint,
    SupportedLoad,
    blocks_for,
    combine,
    find_load,
    pooled_score,
)
from hjepa_cli.core.uplink import Access, report_bits
from hjepa_cli.screen import Screen
from hjepa_cli.stages.subject import Subject

CALIBRATION_SEED = 1_000_003  # added to the seed: growth is measured on other devices
VERIFY_AT = (0.9, 1.1)  # times the load
# Loops whose force has gone wrong by this share of its range, and not at once, are near their load.
TELLING_ERROR, ERROR_AT_ONCE = 0.2, 0.05


class ScheduledCell:
    """Simulates loads, and keeps what several rows share.

    Args:
        subject: the model, the settings.
        screen: for progress.
    """

    def __init__(self, subject: Subject, screen: Screen) -> None:
        self._subject, self._screen = subject, screen
        self._settings = subject.settings
        self._plant = actual_plant(subject.settings)
        self._methods: dict[str, Method] = {}
        self._growth: dict[tuple[str, int], Growth] = {}
        self._levels: dict[tuple[str, int], Levels] = {}
        self._teacher: dict[int, Floats] = {}
        self._loads: dict[tuple[str, str, float], SupportedLoad] = {}

    def row(self, name: str, scheduler: str, snr_db: float) -> Row:
        """Count one method's devices under one scheduler at one SNR."""
        settings, radio = self._settings, self._settings.radio
        bits = self._method(name).bits_per_transmission
        sent_bits = bits + radio.overhead_bits
        slot_uses = radio.bandwidth_hz * self._plant.step_s
        uses = packet_uses(sent_bits, snr_db, radio.block_error)
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
        found = self._load(name, scheduler, snr_db)
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

    def verify(self, name: str, scheduler: str, snr_db: float) -> list[Row]:
        """Simulate a little less and a little more than the load that was found, on its draws.

        The score's interval must lie above the acceptable score inside and below it outside. A side
        is left out where it would be less than a device per block, and the outside where the load
        is only known as a bound.
        """
        found, protocol = self._load(name, scheduler, snr_db), self._settings.protocol
        checks = []
        shares = [share for share in VERIFY_AT if share * found.load >= 1]
        shares = [share for share in shares if share < 1 or not found.at_least]
        label = f"{name}, {scheduler}, verified"
        with self._screen.progress(label, len(shares) * len(self._seeds), "loads") as bar:
            for share in shares:
                points = []
                for seed in self._seeds:
                    load = share * found.load
                    points.append(self._simulate(name, scheduler, snr_db, seed, load))
                    bar.advance()
                score, interval = pooled_score(points, protocol.bootstrap, self._settings.seed)
                level, inside = protocol.acceptable_score, share < 1
                checks.append(
                    {
                        "method": f"{name}, {scheduler}",
                        "share_of_tolerance": share,
                        "load": points[0].load,
                        "score": score,
                        "ci95": list(interval),
                        "expected": "above" if inside else "below",
                        "passed": interval[0] > level if inside else interval[1] < level,
                    }
                )
        return checks

    @property
    def _seeds(self) -> Sequence[int]:
        return range(self._settings.seed, self._settings.seed + self._settings.radio.seeds)

    def _devices(self, load: float, found: SupportedLoad, uses: float, snr_db: float) -> int:
        """N = ⌊load · slot ÷ (packet + reports)⌋; a report's size depends on N, hence the loop."""
        radio, devices = self._settings.radio, 0
        slot_uses = radio.bandwidth_hz * self._plant.step_s
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

    def _load(self, name: str, scheduler: str, snr_db: float) -> SupportedLoad:
        """The load a block carries; often the same at every SNR."""
        varies = self._settings.radio.load_depends_on_snr
        key = (name, scheduler, snr_db if varies else 0.0)
        if key not in self._loads:
            found: list[SupportedLoad] = []
            for seed in self._seeds:
                near = found[-1].load if found else self._first_guess(name, seed)
                found.append(self._search(name, scheduler, snr_db, seed, near))
            self._loads[key] = combine(found)
        return self._loads[key]

    def _first_guess(self, name: str, seed: int) -> float | None:
        """Where to begin to look for a load; ``None`` in the middle of all loads."""
        errors = np.sqrt(self._growth_of(name, seed).table)
        if errors[0] > ERROR_AT_ONCE:
            return None
        return float(min(np.searchsorted(errors, TELLING_ERROR) + 1, MAX_LOAD))

    def _search(
        self, name: str, scheduler: str, snr_db: float, seed: int, near: float | None
    ) -> SupportedLoad:
        protocol = self._settings.protocol
        label = f"{name}, {scheduler}, seed {seed}"
        with self._screen.progress(label, MAX_BISECTIONS, "loads") as bar:

            def simulate_load(load: int) -> LoadPoint:
                point = self._simulate(name, scheduler, snr_db, seed, load)
                bar.advance()
                return point

            return find_load(
                simulate_load,
                protocol.acceptable_score,
                protocol.bracket,
                replicates=protocol.bootstrap,
                seed=seed,
                start=near,
            )

    def _simulate(
        self, name: str, scheduler: str, snr_db: float, seed: int, load: float
    ) -> LoadPoint:
        radio, blocks = self._settings.radio, blocks_for(load)
        devices = round(load * blocks)
        margin_db, k_factor_db = self._links(snr_db, seed, devices)
        method, levels = self._method(name), None
        if radio.uncertainty == "levels" and method.two_levels:
            method = dataclasses.replace(method, controller=method.two_levels)
            levels = self._levels_of(name, method, seed)
        access = Access(
            scheduler=scheduler,
            blocks=blocks,
            margin_db=margin_db,
            k_factor_db=k_factor_db,
            coherence_slots=radio.coherence_slots,
            round_errors=round_errors(
                method.bits_per_transmission + radio.overhead_bits,
                snr_db,
                radio.block_error,
                radio.harq_rounds,
            ),
            growth=levels.growth if levels else self._growth_of(name, seed),
            seed=seed,
            levels=levels,
        )
        protocol = self._settings.protocol
        outcome = simulate_cell(self._plant, protocol, seed, devices, access, method)
        return LoadPoint(devices / blocks, blocks, outcome, self._reference(seed, devices))

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

    def _method(self, name: str) -> Method:
        if name not in self._methods:
            self._methods[name] = build_method(name, self._settings, self._subject.of(name).model)
        return self._methods[name]

    def _growth_of(self, name: str, seed: int) -> Growth:
        if (name, seed) not in self._growth:
            self._growth[name, seed] = measure_growth(
                self._plant, self._settings.protocol, seed + CALIBRATION_SEED, self._method(name)
            )
        return self._growth[name, seed]

    def _levels_of(self, name: str, method: Method, seed: int) -> Levels:
        if (name, seed) not in self._levels:
            self._levels[name, seed] = measure_levels(
                self._plant, self._settings.protocol, seed + CALIBRATION_SEED, method
            )
        return self._levels[name, seed]

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
