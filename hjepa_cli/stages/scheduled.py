"""``hjepa scale --law scheduled``: devices of a cell whose scheduler knows what each loop needs.

One resource block is simulated with its devices, radio and scheduler in one loop; the largest load
that keeps the score acceptable, times the transmissions that fit into a slot, are the devices.
"""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import LINKLESS, check_schedulable, check_warmup
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.evaluation.cell import Row, best_flat, ratio_of
from hjepa_cli.core.evaluation.load_search import BLOCK_DEVICES
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.errors import MissingInputError
from hjepa_cli.output.screen import Screen, span
from hjepa_cli.stages.model_set import Subject, open_subject
from hjepa_cli.stages.scale import PAPER_GAIN_PERCENT, PAPER_SNR_DB, draw, enforce, write_csv
from hjepa_cli.stages.scheduled_cell import ScheduledCell
from hjepa_cli.storage.runs import Run

COLUMNS = (
    *("snr_db", "method", "scheduler", "devices", "devices_ci95_low", "devices_ci95_high"),
    *("at_least", "load_per_block", "bits_per_s", "ratio_to_limit", "bits_per_transmission"),
    *("packets_per_block_slot", "reports_per_block_slot", "reason"),
)


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    out: Path | None = None,
    verify: bool = False,
    further: Sequence[Path] | None = None,
) -> dict[str, Any]:
    """Count devices under each scheduler; returns the document of ``--json``.

    Args:
        settings, screen, checkpoint, out, further: as for :func:`hjepa_cli.stages.scale.run`.
        verify: simulate each load again, a little lighter and a little heavier.

    Raises:
        UsageError: bad SNR grid, radio values out of range.
        MissingInputError: no such checkpoint, or none with any of the methods.
        NumericalError: ``verify`` does not confirm a load.
    """
    grid_db = parse_snr(settings.radio.snr_db)
    subject, methods = open_schedulable(settings, screen, checkpoint, further)
    subject.say_skipped(settings.methods, screen)
    level = settings.protocol.acceptable_score
    inputs = subject.inputs(verify=verify)
    with Run.create("scale", out, settings.as_dict(), inputs) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            show(record.result, screen)
            enforce(record.result.get("verify", []), level)
            return record.result
        radio = settings.radio
        with open_workers(BLOCK_DEVICES * settings.protocol.total_steps) as workers:
            cell = ScheduledCell(subject, screen, workers)
            with closing(cell.find(methods, grid_db)) as found:
                for name, scheduler in found:
                    record.event("measured", method=name, scheduler=scheduler)
            checked_db = grid_db if radio.load_depends_on_snr else grid_db[:1]
            checks = cell.verify(methods, checked_db) if verify else []
        rows: list[Row] = [
            cell.row(name, scheduler, snr_db)
            for name in methods
            for scheduler in radio.schedulers
            for snr_db in grid_db
        ]
        result: dict[str, Any] = {
            "checkpoint": subject.path,
            "plant": settings.plant,
            "seed": settings.seed,
            "seeds": radio.seeds,
            "n_devices": BLOCK_DEVICES,
            "acceptable_score": level,
            "law": radio.law,
            "uncertainty": radio.uncertainty,
            "topology": radio.topology,
            "power_margin_db": radio.power_margin_db if radio.topology == "target" else None,
            "coherence_slots": radio.coherence_slots,
            "overhead_bits": radio.overhead_bits,
            "block_error": radio.block_error,
            "harq_rounds": radio.harq_rounds,
            "payload": settings.protocol.payload,
            "bandwidth_hz": radio.bandwidth_hz,
            "slot_s": plant(settings.plant).step_s,
            "limit_bits_per_s": plant(settings.plant).data_rate_limit_bits_per_s,
            "rows": sorted(rows, key=lambda row: row["snr_db"]),
            "gains": gains(rows, PAPER_SNR_DB if PAPER_SNR_DB in grid_db else max(grid_db)),
            "paper_gain_percent": PAPER_GAIN_PERCENT,
            "skipped": subject.skipped(settings.methods),
        }
        result["csv"] = write_csv(record.path("devices.csv"), result["rows"], COLUMNS)
        result["figures"] = draw(result, record.directory, screen)
        if verify:
            result["verify"] = checks
        result = record.finish(result)
        show(result, screen)
        enforce(result.get("verify", []), level)
        return result


def open_schedulable(
    settings: Settings,
    screen: Screen,
    checkpoint: str | None,
    further: Sequence[Path] | None = None,
) -> tuple[Subject, list[str]]:
    """Open what is to be simulated; returns it and its methods that share a band.

    Raises:
        UsageError: a method whose packets do not fit into slots, or too few slots.
        MissingInputError: no such checkpoint, or none with any of the methods.
    """
    linked = [name for name in settings.methods if name not in LINKLESS]
    check_schedulable(linked, settings.protocol.total_steps)
    check_warmup(settings.protocol)
    subject = open_subject(settings, screen, checkpoint, None, further)
    methods = subject.measurable(linked)
    if not methods:
        skipped = subject.skipped(settings.methods)
        hint = next(iter(skipped.values()), "choose a method that has a link")
        raise MissingInputError(f"nothing to schedule for {', '.join(settings.methods)}", hint=hint)
    return subject, methods


def gains(rows: list[Row], snr_db: float) -> list[Row]:
    """Each scheduler over round robin with the same predictor, and ``hjepa`` over its rivals.

    The rivals are the best flat predictor and the oracle; all three with their best scheduler.
    """
    at = [row for row in rows if row["snr_db"] == snr_db and row["devices"]]
    pairs = [
        (row, turns)
        for turns in at
        for row in at
        if turns["scheduler"] == "round-robin" != row["scheduler"]
        and turns["method"] == row["method"]
    ]
    ours, oracle = (
        max((row for row in at if row["method"] == name), key=_devices, default=None)
        for name in ("hjepa", "oracle")
    )
    if ours:
        pairs += [(ours, rival) for rival in (best_flat(at, snr_db), oracle) if rival]
    return [
        {
            "snr_db": snr_db,
            "method": _label(row),
            "over": _label(rival),
            **ratio_of(row, rival),
        }
        for row, rival in pairs
    ]


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
                _label(row),
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
                _label(row),
                *(count[row["method"], row["scheduler"], snr_db] for snr_db in grid_db),
            ]
            for row in lines
        ],
    )
    if "verify" in result:
        screen.table(
            "simulated again, inside and outside each load",
            ["method, scheduler", "devices/block", "score (95 % CI)", "expected", "verdict"],
            [
                [
                    check["method"],
                    f"{check['load']:.1f}",
                    span(check["score"], check["ci95"], 3),
                    f"{check['expected']} {result['acceptable_score']:g}",
                    "verified" if check["passed"] else "NOT VERIFIED",
                ]
                for check in result["verify"]
            ],
        )
    for found in result["gains"]:
        low, high = found["ratio_ci95"]
        bound = "unbounded" if high is None else f"{high:.2f}"
        screen.result(
            f"{found['method']} over {found['over']} at {found['snr_db']:g} dB: "
            f"{found['ratio']:.2f} x devices (95 % CI {low:.2f} to {bound})"
        )
    for row in lines:
        if row["reason"]:
            screen.say(f"{_label(row)} at {first:g} dB: {row['reason']}")
    screen.say(f"written: {', '.join(str(path) for path in (result['csv'], *result['figures']))}")


def _label(row: Row) -> str:
    return f"{row['method']}, {row['scheduler']}"


def _span(row: Row, value: str, interval: str, digits: int) -> str | None:
    if row.get(value) is None:
        return None
    return span(row[value], row[interval], digits, "≥" if row["at_least"] else "")


def _devices(row: Row) -> int:
    return int(row["devices"])


def _number(value: float | None, digits: int) -> str | None:
    return None if value is None else f"{value:,.{digits}f}"
