"""``hjepa survive`` measures how long loops go on without expected packets, and what links need.

A trained model → loops through single silences → survival times, the loss of a link that keeps
control for a given time, and how many devices a cell has at that transfer interval: one table in
the form of TS 22.104's.
"""

import dataclasses
import itertools
import math
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
from hjepa_cli.core.evaluation.load_simulator import PacketBits
from hjepa_cli.core.evaluation.simulator import BLOCK_LOOPS, Simulator, Tick
from hjepa_cli.core.evaluation.survival import Gaps, LossCurve, LossyLink, Rare, Silences, Trial
from hjepa_cli.core.evaluation.workers import Workers, open_workers
from hjepa_cli.core.plants.conditions import actual_plant
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
from hjepa_cli.storage.runs import Run

Row = dict[str, Any]

FILE = "survival.json"
CELL_SNR_DB = 20.0  # where devices are counted, if the settings have it
LONGER = 1.5  # a gap than the one before, beyond the protocol's
MOST_LONGER = 3
ROUNDS = 5  # of finer gaps
WIDTH = 1.06  # of a bracket that is fine enough
RARE_TRIALS = 3  # gaps that splitting looks at
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
    cell = Cell.of(settings, plant)
    for name, interval in jobs:
        curve = kept[_key(name, interval)]
        bits = curve["bits_per_transmission"]
        carried = cell.link(bits, snr_db).carried
        shared = {
            "method": name,
            "interval_steps": interval,
            "transfer_interval_s": interval * plant.step_s,
            "tolerance_gap_steps": curves[name][0]["tolerance_gap_steps"]
            if name in curves
            else None,
            "devices": int(duty_devices(interval, carried.packets_per_slot))
            if carried.packets_per_slot
            else 0,
            "snr_db": snr_db,
            "bits_per_transmission": bits,
        }
        links = needed_links(curve, settings, plant.step_s)
        for level in curve["levels"]:
            steps_left = level["survival_steps"]
            more = {
                f"availability{kind}": survival.availability(link, interval, steps_left)
                if link
                else None
                for kind, link in links["links"].items()
            }
            time_s = steps_left * plant.step_s
            rows.append(shared | level | {"survival_time_s": time_s} | links["values"] | more)
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


def _key(method: str, interval: int) -> str:
    return f"{method} at intervals of {interval} steps"


class Survivals:
    """Searches the gaps that methods survive; several threads may ask for some."""

    def __init__(self, models: ModelSet, workers: Workers, tick: Tick) -> None:
        self._models, self._workers, self._tick = models, workers, tick
        self._settings = models.settings

    def measure(self, method: str, interval: int) -> Row:
        """Return a method's curve of losses over the gap, and the gap at each level."""
        options, trial = self._settings.survival, Trial.of(self._settings.protocol, interval)
        outcomes: dict[int, Silences] = {}
        wanted: Sequence[int] = gaps_at_first(self._settings, interval)
        for _ in range(ROUNDS + MOST_LONGER):
            outcomes |= self._silences(method, trial, wanted)
            curve = counted(outcomes)
            if curve.probability[-1] <= survival.LEVELS[0]:
                wanted = longer_gap(self._settings, int(curve.gaps[-1]))
            else:
                wanted = [
                    gap for gap in curve.wanted(survival.LEVELS, WIDTH) if gap not in outcomes
                ]
            if not wanted:
                break
        rare = self._rare(method, trial, curve) if options.splitting_paths else []
        # What a packet has in bits is the driver's to say, where the models are.
        [bits] = self._workers.results([self._submit(method, PacketBits(method))], self._tick)
        return {
            "method": method,
            "interval_steps": interval,
            "bits_per_transmission": bits,
            "points": [described(gap, outcomes[gap]) for gap in curve.gaps.tolist()],
            "splitting": [{"gap_steps": gap, "p": p, "sd_ln_p": sd} for gap, p, sd in rare],
            "levels": levels_of(curve, rare, interval),
        }

    def _silences(self, method: str, trial: Trial, gaps: Sequence[int]) -> dict[int, Silences]:
        loops = self._settings.survival.loops
        count = min(max(loops * len(gaps) // BLOCK_LOOPS, 1), loops)
        cuts = [loops * number // count for number in range(count + 1)]
        units = [
            Gaps(method, trial, tuple(gaps), start, stop)
            for start, stop in itertools.pairwise(cuts)
        ]
        futures = [self._submit(method, unit) for unit in units]
        joined = Silences.joined(self._workers.results(futures, self._tick))
        return {
            gap: Silences(joined.lost[i], joined.left_band[i], joined.back_steps[i])
            for i, gap in enumerate(gaps)
        }

    def _rare(self, method: str, trial: Trial, curve: LossCurve) -> list[tuple[int, float, float]]:
        """Return gaps, ascending, with the probability by splitting and its error in logarithms.

        The first is the longest at which not even one loop in a hundred is lost; from there along
        the line through what is known.
        """
        found: dict[int, tuple[float, float]] = {}
        gap = max(curve.tolerated(survival.LEVELS[1])[0], trial.interval_steps + 1)
        paths = self._settings.survival.splitting_paths
        for _ in range(RARE_TRIALS):
            future = self._submit(method, Rare(method, trial, gap, paths))
            [found[gap]] = self._workers.results([future], self._tick)
            gap = next_rare_gap(curve, found, trial.interval_steps)
            if gap in found:
                break
        return [(gap, *found[gap]) for gap in sorted(found)]

    def _submit(self, method: str, unit: Any) -> Any:
        model = self._models.of(method).file
        return self._workers.submit(Simulator, self._settings, model, unit, self._tick)


def gaps_at_first(settings: Settings, interval: int) -> list[int]:
    """Return the gaps to begin with: none at all, and the protocol's that are longer."""
    return [interval, *(gap for gap in settings.protocol.gaps if gap > interval)]


def longer_gap(settings: Settings, gap: int) -> list[int]:
    """Return the gap to go on with where none so far loses enough loops; none if long enough."""
    limit = settings.protocol.gaps[-1] * LONGER**MOST_LONGER
    return [round(gap * LONGER)] if gap < limit else []


def longest_gap(settings: Settings) -> int:
    """Return the longest gap of loops that are never lost, which memory must hold."""
    found = []
    for interval in settings.survival.intervals_steps:
        wanted = gaps_at_first(settings, interval)
        while wanted:
            found.append(wanted[-1])
            wanted = longer_gap(settings, wanted[-1])
    return max(found)


def counted(outcomes: Mapping[int, Silences]) -> LossCurve:
    """Return the curve of what was counted."""
    gaps = sorted(outcomes)
    lost = [int(outcomes[gap].lost.sum()) for gap in gaps]
    loops = [outcomes[gap].lost.size for gap in gaps]
    return LossCurve(np.array(gaps), np.array(lost), np.array(loops))


def next_rare_gap(curve: LossCurve, found: Mapping[int, tuple[float, float]], interval: int) -> int:
    """Return where the logarithm of the probability should be that of one in 10,000."""
    known = {
        gap: p for gap, p in zip(curve.gaps.tolist(), curve.probability.tolist(), strict=True) if p
    }
    known |= {gap: p for gap, (p, _) in found.items() if p > 0}
    places = sorted(known)
    if not places:  # nothing is lost anywhere: further out
        return round(max(found) * LONGER)
    if len(places) == 1:
        return max(interval + 1, round(places[0] * 0.9))
    logs = [math.log(known[gap]) for gap in places]
    wanted = math.log(survival.RARE)
    at = next((i for i, value in enumerate(logs) if value >= wanted), len(logs) - 1)
    left, right = (at - 1, at) if at else (0, 1)
    slope = (logs[right] - logs[left]) / (places[right] - places[left])
    if slope <= 0:
        return max(interval + 1, round(places[left] * 0.9))
    guess = places[left] + (wanted - logs[left]) / slope
    return max(interval + 1, round(max(guess, places[0] * 0.7)))


def levels_of(
    curve: LossCurve, rare: Sequence[tuple[int, float, float]], interval: int
) -> list[Row]:
    """Return the survival times at each level, counted, by splitting or as a bound."""
    levels = []
    for level in survival.LEVELS:
        gap, (low, high), at_least = curve.tolerated(level)
        levels.append(_level(level, "counted", gap, (low, high), interval, at_least))
    if not rare:  # what no upper bound of the counts contradicts
        _, (low, _), at_least = curve.tolerated(survival.RARE)
        levels.append(_level(survival.RARE, "bound", low, (low, None), interval, at_least))
        return levels
    gaps = np.array([gap for gap, _, _ in rare], np.float64)
    logs, errors = (
        np.array(values)
        for values in zip(
            *((math.log(p) if p > 0 else -50.0, sd if p > 0 else 0.0) for _, p, sd in rare),
            strict=True,
        )
    )
    wanted = math.log(survival.RARE)
    ends = [_where(gaps, logs + 1.96 * side * errors, wanted) for side in (0, 1, -1)]
    gap, low, high = (max(interval, math.floor(end)) for end in ends)
    how = "splitting" if logs.min() <= wanted <= logs.max() else "splitting, extrapolated"
    levels.append(_level(survival.RARE, how, gap, (low, high), interval, False))
    return levels


def _level(
    level: float,
    how: str,
    gap: int,
    ends: tuple[int, int | None],
    interval: int,
    at_least: bool,
) -> Row:
    """Return a level of a row; a gap of one interval is no silence, and less is none either."""
    low, high = ends
    return {
        "loss_probability": level,
        "how": how,
        "gap_steps": gap,
        "survival_steps": max(gap - interval, 0),
        "survival_ci95": [
            max(low - interval, 0),
            None if high is None else max(high - interval, 0),
        ],
        "at_least": at_least,
    }


def _where(gaps: np.ndarray[Any, Any], logs: np.ndarray[Any, Any], wanted: float) -> float:
    """Return where logarithms reach a value, on the lines between them and beyond the ends."""
    logs = np.maximum.accumulate(logs)
    if len(gaps) == 1 or logs[0] == logs[-1]:
        return float(gaps[0] if logs[0] <= wanted else 0.0)
    at = int(np.clip(np.searchsorted(logs, wanted), 1, len(gaps) - 1))
    rise = logs[at] - logs[at - 1]
    if rise <= 0:
        return float(gaps[at - 1])
    return float(gaps[at - 1] + (wanted - logs[at - 1]) / rise * (gaps[at] - gaps[at - 1]))


def described(gap: int, outcome: Silences) -> Row:
    """Return a point of a curve as printed."""
    lost, loops = int(outcome.lost.sum()), outcome.lost.size
    low, high = survival.clopper_pearson(lost, loops)
    back = np.sort(outcome.back_steps)
    places = [back[min(math.ceil(share * loops) - 1, loops - 1)] for share in (0.5, 0.95)]
    return {
        "gap_steps": gap,
        "lost": lost,
        "loops": loops,
        "p_lost": lost / loops,
        "p_lost_ci95": [float(low), float(high)],
        "p_left_band": float(outcome.left_band.mean()),
        "back_steps_median": float(places[0]) if np.isfinite(places[0]) else None,
        "back_steps_p95": float(places[1]) if np.isfinite(places[1]) else None,
    }


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
        f"devices in {result['bandwidth_hz'] / 1e6:g} MHz, {result['phy']}",
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
