"""``hjepa survive`` measures how long loops go on without expected packets, and what links need.

A trained model → loops through single silences → survival times, the loss of a link that keeps
control for a given time, and how many devices a cell has at that transfer interval: one table in
the form of TS 22.104's.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.config.checks import check_cell, check_methods, split_late
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control import link
from hjepa_cli.core.control.loop import check_memory
from hjepa_cli.core.evaluation import survival
from hjepa_cli.core.evaluation.survival import LossCurve, LossyLink, Trial
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.duty import duty_devices
from hjepa_cli.errors import MissingInputError, UsageError
from hjepa_cli.output.looks import Looks
from hjepa_cli.output.screen import Screen, can_draw, span, ticking
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import results
from hjepa_cli.stages.inputs import refuse_recorded
from hjepa_cli.stages.kept import Kept
from hjepa_cli.stages.measuring import cached, seconds_of_loops
from hjepa_cli.stages.model_set import ModelSet, open_model_set
from hjepa_cli.stages.plan import Plan, run_directory
from hjepa_cli.stages.survived_gaps import Row, Survivals, gaps_at_first, longest_gap
from hjepa_cli.storage.runs import Run

FILE = "survival.json"
CELL_SNR_DB = 20.0  # where devices are counted, if the settings have it
HOUR_S = 3600.0
ROUNDS_AS_A_RULE = 14  # gaps of all rounds together, and splitting as gaps


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
    further: Sequence[Path] | None = None,
) -> dict[str, Any]:
    """Measure the settings' methods; return the document of ``--json``.

    Args:
        settings: methods, protocol, the cell and what ``survival`` says.
        screen: shows the result.
        checkpoint: zoo name, run directory or file; default: the newest run that fits, else the
            zoo.
        out: run directory; of an interrupted one what is measured is not measured again.
        further: models of methods that the first one does not hold; ``None`` looks for them.

    Raises:
        UsageError: no method with a link, an interval as long as the watched time, or a cell that
            there is not.
        MissingInputError: no such checkpoint, or none with any of the methods.
        DataError: a damaged checkpoint or file of the run, or a checkpoint of another plant.
    """
    models, methods = opened(settings, screen, checkpoint, further)
    with Run.create("survive", out, settings.as_dict(), models.inputs()) as record:
        result = recorded = record.result
        if result is None:
            result = measured(models, methods, screen, record)
            result["figures"] = draw(result, record.directory, screen)
            result = record.finish(result)
        else:
            screen.say(f"{record.directory} is finished; this is its result")
        with results.showing("survive", recorded, record.directory):
            show(result, screen)
            if result["figures"]:
                screen.say(f"written: {', '.join(map(str, result['figures']))}")
        return result


def plan(
    settings: Settings,
    *,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
    further: Sequence[Path] | None = None,
) -> Plan:
    """Plan the silences; arguments as of :func:`run`."""
    models, methods = opened(settings, Screen(quiet=True), checkpoint, further)
    options, intervals = settings.survival, settings.survival.intervals_steps
    first = gaps_at_first(settings, intervals[0])
    steps = Trial.of(settings.protocol, intervals[0]).steps(first[-1])
    count = len(intervals) * (len(first) + ROUNDS_AS_A_RULE)
    work = [
        f"drive {options.loops} loops through gaps of up to {first[-1]} steps at intervals of "
        f"{', '.join(map(str, intervals))} steps, finer around each level, with "
        f"{', '.join(methods)}"
    ]
    if options.splitting_paths:
        work.append(f"split {options.splitting_paths} paths for losses of 1 in 10,000")
    return Plan(
        command="survive",
        reads=[f"model {models.name}"],
        work=work,
        writes=[f"run {run_directory('survive', out)}"],
        writes_bytes=100_000,
        seconds=5 + seconds_of_loops(methods, count * options.loops * steps),
    )


def opened(
    settings: Settings,
    screen: Screen,
    checkpoint: str | Path | None,
    further: Sequence[Path] | None,
) -> tuple[ModelSet, list[str]]:
    """Open the models; return them and the methods that are measured. Raises as :func:`run`."""
    refuse_recorded(settings, "survival is measured in closed loops")
    check_methods(settings.methods)
    parse_snr(settings.radio.snr_db)
    check_cell(settings.radio, nr=settings.nr, command="survive")
    if not settings.survival.intervals_steps:
        raise UsageError("no interval given; --intervals takes steps, as 10,40")
    protocol = settings.protocol
    for interval in settings.survival.intervals_steps:
        if interval > (watched := Trial.of(protocol, 1).watch_steps):
            raise UsageError(
                f"--intervals {interval}: loops are watched for protocol.warmup_steps = {watched} "
                "steps after a silence; expected no more",
                hint=f"--intervals {min(watched, 10)}",
            )
    trial = Trial.of(protocol, max(settings.survival.intervals_steps))
    longest = trial.steps(longest_gap(settings))
    lived = dataclasses.replace(protocol, warmup_steps=0, steps=longest)
    check_memory(lived, max(settings.survival.loops, settings.survival.splitting_paths))
    linked = [name for name in settings.methods if METHODS[split_late(name)[0]].needs_link]
    models = open_model_set(settings, screen, checkpoint, None, further)
    methods = models.measurable(linked)
    skipped = models.skipped(settings.methods)
    if not methods:
        hint = next(iter(skipped.values()), "choose a method that has a link")
        raise MissingInputError(f"nothing to silence for {', '.join(settings.methods)}", hint=hint)
    models.say_skipped(settings.methods, screen)
    return models, methods


def measured(
    models: ModelSet, methods: Sequence[str], screen: Screen, record: Run
) -> dict[str, Any]:
    """Measure all methods at all intervals, keep each; return the document of ``--json``.

    Curves that an interrupted run has measured are taken from its file.
    """
    settings, options = models.settings, models.settings.survival
    plant = actual_plant(settings.plant, settings.conditions)
    curves = cached(models, methods)
    grid_db = parse_snr(settings.radio.snr_db)
    snr_db = CELL_SNR_DB if CELL_SNR_DB in grid_db else max(grid_db)
    jobs = [(name, interval) for name in methods for interval in options.intervals_steps]
    steps = Trial.of(settings.protocol, 1).steps(settings.protocol.gaps[-1])
    kept = Kept(record.path(FILE))
    missing = [job for job in jobs if _key(*job) not in kept]
    total = len(missing) * options.loops * steps * (len(settings.protocol.gaps) + ROUNDS_AS_A_RULE)
    with (
        open_workers(options.loops * steps) as workers,
        ticking(screen, f"{len(missing)} survival curves", total) as tick,
    ):
        silences = Survivals(models, workers, tick)
        with closing(workers.each(lambda job: silences.measure(*job), missing)) as ready:
            for job, curve in ready:
                kept.add(_key(*job), curve)
                record.event("measured", method=job[0], interval_steps=job[1])
    rows = []
    for name, interval in jobs:
        known = curves[name][0]["tolerance_gap_steps"] if name in curves else None
        rows += rows_of(kept[_key(name, interval)], settings, plant, snr_db, known)
    return {
        "checkpoint": models.path,
        "plant": settings.plant,
        "seed": settings.seed,
        "step_s": plant.step_s,
        "n_loops": options.loops,
        "settle_steps": Trial.of(settings.protocol, 1).settle_steps,
        "watch_steps": Trial.of(settings.protocol, 1).watch_steps,
        "link": link.facts(settings.protocol, len(plant.force_signs)),
        "phy": settings.radio.phy,
        "bandwidth_hz": settings.radio.bandwidth_hz,
        "loss": options.loss,
        "burst_transfers": options.burst_transfers,
        "mean_time_h": options.mean_time_h,
        "skipped": models.skipped(settings.methods),
        "rows": rows,
        "curves": [kept[_key(*job)] for job in jobs],
    }


def rows_of(
    curve: Row, settings: Settings, plant: System, snr_db: float, tolerance_gap_steps: float | None
) -> list[Row]:
    """Return a curve's rows of the table: one for each probability to lose control."""
    interval, bits = curve["interval_steps"], curve["bits_per_transmission"]
    packets_per_slot = Cell.of(settings, plant).link(bits, snr_db).carried.packets_per_slot
    shared = {
        "method": curve["method"],
        "interval_steps": interval,
        "transfer_interval_s": interval * plant.step_s,
        "tolerance_gap_steps": tolerance_gap_steps,
        "devices": int(duty_devices(interval, packets_per_slot)) if packets_per_slot else 0,
        "snr_db": snr_db,
        "bits_per_transmission": bits,
    }
    links, rows = needed_links(curve, settings, plant.step_s), []
    for level in curve["levels"]:
        steps = level["survival_steps"]
        availability = {
            f"availability{kind}": survival.availability(link, interval, steps) if link else None
            for kind, link in links["links"].items()
        }
        time = {"survival_time_s": steps * plant.step_s}
        rows.append(shared | level | time | links["values"] | availability)
    return rows


def _key(method: str, interval: int) -> str:
    return f"{method} at intervals of {interval} steps"


def needed_links(curve: Row, settings: Settings, step_s: float) -> dict[str, Any]:
    """Return what links go with a curve of losses, independent and in bursts, for how long."""
    options, interval = settings.survival, curve["interval_steps"]
    points = curve["points"]
    counts = LossCurve(
        *(np.array([point[key] for point in points]) for key in ("gap_steps", "lost", "loops"))
    )
    rare = [(one["gap_steps"], one["p"]) for one in curve["splitting"]]
    lost = survival.loss_of_gap(counts, rare)
    transfer_s = interval * step_s
    allowed = transfer_s / (options.mean_time_h * HOUR_S)
    values: Row = {}
    links: dict[str, LossyLink | None] = {}
    for kind, burst in (("", None), ("_bursts", options.burst_transfers)):
        of = LossyLink.independent if burst is None else lambda loss, b=burst: LossyLink(loss, b)
        often = survival.losses_per_transfer(of(options.loss), interval, lost)
        values[f"mean_time_between_losses{kind}_s"] = transfer_s / often if often else None
        tolerated = survival.tolerated_loss(interval, lost, allowed, burst)
        values[f"tolerated_loss{kind}"] = tolerated
        links[kind] = of(tolerated) if tolerated else None
    return {"values": values, "links": links}


def draw(result: Mapping[str, Any], directory: Path, screen: Screen) -> list[Path]:
    """Write ``survival.png`` and ``survival.svg``; without matplotlib say how to get them."""
    if not can_draw(screen):
        return []
    from hjepa_cli.output import figures

    title = f"{result['plant']}, {result['n_loops']} loops, 95 % CI"
    figure = figures.survival_figure(result, Looks(title=title))
    return [figures.save(figure, directory / f"survival.{kind}") for kind in ("png", "svg")]


def show(result: Mapping[str, Any], screen: Screen) -> None:
    """Print the table of TS 22.104's form, and what a silence does."""
    step_ms = result["step_s"] * 1e3
    gaps = [
        [
            curve["method"],
            f"{curve['interval_steps'] * step_ms:g}",
            f"{point['gap_steps'] * step_ms:g}",
            span(point["p_lost"], point["p_lost_ci95"], 4),
            f"{point['p_left_band']:.2f}",
            *(
                "never" if point[key] is None else f"{point[key] * step_ms:g}"
                for key in ("back_steps_median", "back_steps_p95")
            ),
        ]
        for curve in result["curves"]
        for point in curve["points"]
    ]
    screen.table(
        f"one gap between packets, {result['plant']}, seed {result['seed']}, {result['n_loops']} "
        f"loops{link.described(result.get('link', {}))}, 95 % CI (Clopper-Pearson)",
        ["method", "interval [ms]", "gap [ms]", "lost", "left the band", "back after [ms]", "95 %"],
        gaps,
    )
    hours = result["mean_time_h"]
    screen.table(
        f"survival times; availability and loss of a link that loses control once in {hours:g} h; "
        f"devices at {result['rows'][0]['snr_db']:g} dB in {result['bandwidth_hz'] / 1e6:g} MHz, "
        f"{result['phy']}",
        [
            *("method", "transfer interval [ms]", "survival time [ms]", "of", "D* [ms]"),
            *("availability", "loss", "in bursts", "devices"),
        ],
        [
            [
                row["method"],
                f"{row['transfer_interval_s'] * 1e3:g}",
                _survival(row, step_ms),
                f"1 − {row['loss_probability']:g}, {row['how']}",
                None
                if row["tolerance_gap_steps"] is None
                else f"{row['tolerance_gap_steps'] * step_ms:.0f}",
                None if row["availability"] is None else f"1 − {1 - row['availability']:.1e}",
                f"{row['tolerated_loss']:.1e}",
                f"{row['tolerated_loss_bursts']:.1e}",
                row["devices"],
            ]
            for row in result["rows"]
        ],
    )


def _survival(row: Row, step_ms: float) -> str:
    low, high = row["survival_ci95"]
    end = "…" if high is None else f"{high * step_ms:g}"
    bound = "≥ " if row["at_least"] else ""
    return f"{bound}{row['survival_steps'] * step_ms:g} ({low * step_ms:g} – {end})"
