"""``hjepa scale --law scheduled``: devices of a cell whose scheduler knows what each loop needs.

One resource block is simulated with its devices, radio and scheduler in one loop; the largest load
that keeps the score acceptable, times the transmissions that fit into a slot, are the devices.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.capacity import parse_snr
from hjepa_cli.core.cell import Row, gain
from hjepa_cli.core.cell_loop import measure_growth, simulate_cell
from hjepa_cli.core.channel import thermal_noise_dbm
from hjepa_cli.core.coding import packet_uses
from hjepa_cli.core.growth import Growth
from hjepa_cli.core.hall import drop_devices, power_margin_db
from hjepa_cli.core.loop import Draws, Floats, every_step, simulate
from hjepa_cli.core.methods import Method, build_method
from hjepa_cli.core.plant import plant
from hjepa_cli.core.scheduled import (
    BLOCK_DEVICES,
    MAX_BISECTIONS,
    MAX_LOAD,
    LoadPoint,
    SupportedLoad,
    blocks_for,
    combine,
    find_load,
)
from hjepa_cli.core.uplink import Access, report_bits
from hjepa_cli.errors import MissingInputError
from hjepa_cli.screen import Screen, span
from hjepa_cli.settings import Settings
from hjepa_cli.stages.evaluate import Subject, open_subject
from hjepa_cli.stages.scale import write_csv
from hjepa_cli.storage.runs import Run

COLUMNS = (
    *("snr_db", "method", "scheduler", "devices", "devices_ci95_low", "devices_ci95_high"),
    *("at_least", "load_per_block", "bits_per_s", "ratio_to_limit", "bits_per_transmission"),
    *("packets_per_block_slot", "reports_per_block_slot", "reason"),
)
CALIBRATION_SEED = 1_000_003  # added to the seed: growth is measured on other devices


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Count devices under each scheduler; returns the document of ``--json``.

    Raises:
        UsageError: bad SNR grid, radio values out of range.
        MissingInputError: no such checkpoint, or none with any of the methods.
    """
    grid_db = parse_snr(settings.radio.snr_db)
    subject = open_subject(settings, screen, checkpoint, None)
    skipped = subject.skipped(settings.methods)
    subject.say_skipped(settings.methods, screen)
    methods = [name for name in subject.measurable(settings.methods) if name != "optimal"]
    if not methods:
        hint = next(iter(skipped.values()), "choose another method than optimal, which has no link")
        raise MissingInputError(f"nothing to schedule for {', '.join(settings.methods)}", hint=hint)
    with Run.create("scale", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            show(record.result, screen)
            return record.result
        cell = ScheduledCell(subject, screen)
        rows: list[Row] = []
        for name in methods:
            for scheduler in settings.radio.schedulers:
                rows += [cell.row(name, scheduler, snr_db) for snr_db in grid_db]
                record.event("measured", method=name, scheduler=scheduler)
        radio = settings.radio
        result: dict[str, Any] = {
            "checkpoint": subject.path,
            "plant": settings.plant,
            "seed": settings.seed,
            "seeds": radio.seeds,
            "acceptable_score": settings.protocol.acceptable_score,
            "law": radio.law,
            "topology": radio.topology,
            "power_margin_db": radio.power_margin_db if radio.topology == "target" else None,
            "coherence_slots": radio.coherence_slots,
            "payload": settings.protocol.payload,
            "bandwidth_hz": radio.bandwidth_hz,
            "slot_s": plant(settings.plant).step_s,
            "limit_bits_per_s": plant(settings.plant).data_rate_limit_bits_per_s,
            "rows": sorted(rows, key=lambda row: row["snr_db"]),
            "gains": gains(rows, methods, radio.schedulers, max(grid_db)),
            "skipped": skipped,
        }
        result["csv"] = write_csv(record.path("devices.csv"), result["rows"], COLUMNS)
        result = record.finish(result)
        show(result, screen)
        return result


class ScheduledCell:
    """Simulates loads, and keeps what several rows share.

    Args:
        subject: the model, the settings.
        screen: for progress.
    """

    def __init__(self, subject: Subject, screen: Screen) -> None:
        self._subject, self._screen = subject, screen
        self._settings = subject.settings
        self._plant = plant(subject.settings.plant)
        self._methods: dict[str, Method] = {}
        self._growth: dict[tuple[str, int], Growth] = {}
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
        ends = (found.load, *found.interval)
        counts = [self._devices(load, found, uses, snr_db) for load in ends]
        row["devices"], row["devices_ci95"] = counts[0], counts[1:]
        if found.load == 0:
            level = settings.protocol.acceptable_score
            return row | {"reason": f"below {level:g} even with one device per block"}
        reported = found.reports_per_slot * report_bits(counts[0])
        per_slot = (found.packets_per_slot * sent_bits + reported) / found.load
        row["bits_per_s"] = per_slot / self._plant.step_s
        if (limit := self._plant.data_rate_limit_bits_per_s) > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / limit
        if row["devices"] == 0:
            row["reason"] = "fewer than one device"
        return row

    def _devices(self, load: float, found: SupportedLoad, uses: float, snr_db: float) -> int:
        """N = ⌊load · slot ÷ (packet + reports)⌋; a report's size depends on N, hence the loop."""
        slot_uses, devices = self._settings.radio.bandwidth_hz * self._plant.step_s, 0
        guess = math.floor(load * slot_uses / uses * (1 + 1e-12))
        for _ in range(5):
            if guess == devices:
                break
            devices = guess
            report = packet_uses(report_bits(devices), snr_db, self._settings.radio.block_error)
            block = uses + found.reports_per_slot * report
            guess = math.floor(load * slot_uses / block * (1 + 1e-12))
        return guess

    def _load(self, name: str, scheduler: str, snr_db: float) -> SupportedLoad:
        """The load a block carries; without a topology it is the same at every SNR."""
        key = (name, scheduler, snr_db if self._settings.radio.topology == "hall" else 0.0)
        if key not in self._loads:
            first = self._settings.seed
            seeds = range(first, first + self._settings.radio.seeds)
            self._loads[key] = combine([self._search(*key[:2], snr_db, seed) for seed in seeds])
        return self._loads[key]

    def _search(self, name: str, scheduler: str, snr_db: float, seed: int) -> SupportedLoad:
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
            )

    def _simulate(
        self, name: str, scheduler: str, snr_db: float, seed: int, load: int
    ) -> LoadPoint:
        radio, blocks = self._settings.radio, blocks_for(load)
        devices = load * blocks
        margin_db, k_factor_db = self._links(snr_db, seed, devices)
        access = Access(
            scheduler=scheduler,
            blocks=blocks,
            margin_db=margin_db,
            k_factor_db=k_factor_db,
            coherence_slots=radio.coherence_slots,
            block_error=radio.block_error,
            growth=self._growth_of(name, seed),
            seed=seed,
        )
        outcome = simulate_cell(
            self._plant, self._settings.protocol, seed, devices, access, self._method(name)
        )
        return LoadPoint(load, blocks, outcome, self._reference(seed, devices))

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
            self._methods[name] = build_method(name, self._settings, self._subject.model)
        return self._methods[name]

    def _growth_of(self, name: str, seed: int) -> Growth:
        if (name, seed) not in self._growth:
            self._growth[name, seed] = measure_growth(
                self._plant, self._settings.protocol, seed + CALIBRATION_SEED, self._method(name)
            )
        return self._growth[name, seed]

    def _reference(self, seed: int, devices: int) -> Floats:
        """The teacher's score of the first devices, on the true state at every step."""
        known = self._teacher.get(seed, np.zeros(0))
        if len(known) < devices:  # the first of many devices are the few
            count = BLOCK_DEVICES if devices <= BLOCK_DEVICES else MAX_LOAD
            protocol = self._settings.protocol
            teacher = build_method("optimal", self._settings, None)
            outcome = simulate(
                self._plant,
                Draws.make(protocol, count, seed),
                every_step(protocol.steps, count)[None],
                teacher.controller(count),
                teacher.sensor,
            )
            known = self._teacher[seed] = outcome.score[0]
        return known[:devices]


def gains(
    rows: list[Row], methods: list[str], schedulers: tuple[str, ...], snr_db: float
) -> list[Row]:
    """Each scheduler over round robin with the same predictor, where both were simulated."""
    found = []
    for name in methods:
        mine = [
            {**row, "method": row["scheduler"]}
            for row in rows
            if row["method"] == name and row["snr_db"] == snr_db
        ]
        for scheduler in schedulers:
            ratio = gain(mine, scheduler, "round-robin", snr_db)
            if ratio and scheduler != "round-robin":
                found.append({**ratio, "method": name, "scheduler": scheduler})
    return found


def show(result: dict[str, Any], screen: Screen) -> None:
    """Print what a block carries and how many devices the cell has."""
    first = result["rows"][0]["snr_db"]
    lines = [row for row in result["rows"] if row["snr_db"] == first]
    sample = f"{result['seeds']} seeds" if result["seeds"] > 1 else f"seed {result['seed']}"
    screen.table(
        f"one resource block of {result['plant']} loops at score {result['acceptable_score']:g}, "
        f"{first:g} dB: {sample}, 95 % CI; limit λ/ln 2 = {result['limit_bits_per_s']:.1f} bit/s",
        ["method, scheduler", "devices/block", "reports/slot", "bits", "bit/s", "÷limit"],
        [
            [
                f"{row['method']}, {row['scheduler']}",
                _span(row, "load_per_block", "load_ci95", 1),
                _number(row.get("reports_per_block_slot"), 2),
                row["bits_per_transmission"],
                _number(row["bits_per_s"], 0),
                _number(row["ratio_to_limit"], 0),
            ]
            for row in lines
        ],
    )
    grid_db = list(dict.fromkeys(row["snr_db"] for row in result["rows"]))
    count = {
        (row["method"], row["scheduler"], row["snr_db"]): _span(row, "devices", "devices_ci95", 0)
        for row in result["rows"]
    }
    links = (
        f"power margin {result['power_margin_db']:g} dB"
        if result["topology"] == "target"
        else "devices in a hall"
    )
    screen.table(
        f"devices: scheduled law, payload {result['payload']}, "
        f"{result['bandwidth_hz'] / 1e6:g} MHz, {result['slot_s'] * 1e3:g} ms slots, {links}, "
        f"coherence {result['coherence_slots']:g} slots",
        ["method, scheduler", *(f"{snr_db:g} dB" for snr_db in grid_db)],
        [
            [
                f"{row['method']}, {row['scheduler']}",
                *(count[row["method"], row["scheduler"], snr_db] for snr_db in grid_db),
            ]
            for row in lines
        ],
    )
    for found in result["gains"]:
        low, high = found["ratio_ci95"]
        bound = "unbounded" if high is None else f"{high:.2f}"
        screen.result(
            f"{found['method']}: {found['scheduler']} over round-robin at {found['snr_db']:g} dB: "
            f"{found['ratio']:.2f} x devices (95 % CI {low:.2f} to {bound})"
        )
    for row in lines:
        if row["reason"]:
            screen.say(f"{row['method']}, {row['scheduler']} at {first:g} dB: {row['reason']}")
    screen.say(f"written: {result['csv']}")


def _span(row: Row, value: str, interval: str, digits: int) -> str | None:
    if row.get(value) is None:
        return None
    return span(row[value], row[interval], digits, "≥" if row["at_least"] else "")


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:,.{digits}f}"
