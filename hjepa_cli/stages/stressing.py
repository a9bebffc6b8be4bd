"""``eval --stress`` measures how scores hold under conditions that no model was trained for.

Models and settings → for every row (a condition with its severity) and method the score at a few
gaps between packets, by itself and ÷ the nominal one.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

from hjepa_cli.config.checks import split_late
from hjepa_cli.config.schema import RECORDED, ConditionSettings, Settings
from hjepa_cli.core.control.loop import Outcome, check_memory
from hjepa_cli.core.evaluation import robustness
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Pending, start_points
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.plants import stress
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.plants.stress import Condition
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen, ticking
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.kept import Kept
from hjepa_cli.stages.measuring import seconds_of_loops
from hjepa_cli.stages.model_set import ModelSet
from hjepa_cli.storage.runs import Run

NOMINAL = ""
FILE = "stress.json"


def plan_stress(models: ModelSet) -> tuple[list[str], float]:
    """Return what :func:`measure_stress` would do, by lines, and about how long it takes."""
    settings, rows = models.settings, rows_of(models.settings)
    gaps, methods = robustness.gaps_of(plant_of(settings)), models.measurable(settings.methods)
    protocol = settings.protocol
    check_memory(protocol, max(protocol.curve_devices, protocol.bracket_devices))
    steps = (len(rows) + 1) * len(gaps) * protocol.curve_devices * protocol.total_steps
    line = (
        f"drive {protocol.curve_devices} devices for {protocol.total_steps} steps at gaps of "
        f"{', '.join(map(str, gaps))} steps under {len(rows)} conditions and none, with "
        f"{', '.join(methods)}"
    )
    return [line], seconds_of_loops(methods, steps)


def rows_of(settings: Settings) -> dict[str, Settings]:
    """Return the settings of every row of the settings' ``stress``; for recordings, of pictures.

    Raises:
        UsageError: a condition that there is not, that the plant has not, or out of its bounds.
    """
    recorded, grey = settings.plant == RECORDED, settings.camera.grey
    nominal = dataclasses.replace(settings, conditions=ConditionSettings())

    def fits(one: Condition) -> bool:
        if (recorded and one.apply is None) or (grey and one.of_colours):
            return False
        worse = stress.under(nominal, stress.written({one: one.ladder[0]}))
        try:
            actual_plant(worse.plant, worse.conditions)
        except UsageError:  # it has no such part
            return False
        return True

    rows = {text: stress.under(settings, text) for text in stress.rows(settings.stress, fits)}
    for text, row in rows.items():
        moving = [one.name for one in stress.parse(text) if one.apply is None]
        if recorded and moving:
            raise UsageError(f"condition {moving[0]} is of plants or links; recordings have none")
        try:
            actual_camera(row)
        except UsageError as error:  # which may name a setting that nobody has set
            raise UsageError(f"--stress {text}: {error.message}", hint=error.hint) from None
    return rows


def measure_stress(models: ModelSet, screen: Screen, record: Run) -> dict[str, Any]:
    """Measure all rows with all methods, keep each as it is done; return the result's ``stress``.

    Rows that an interrupted run has measured are taken from its file.
    """
    settings, protocol = models.settings, models.settings.protocol
    check_memory(protocol, max(protocol.curve_devices, protocol.bracket_devices))
    models.say_skipped(settings.methods, screen)
    methods, rows = models.measurable(settings.methods), rows_of(settings)
    gaps = robustness.gaps_of(plant_of(settings))
    kept = Kept(record.path(FILE))
    jobs = [(method, text) for text in (NOMINAL, *rows) for method in methods]
    missing = [job for job in jobs if _key(*job) not in kept]
    device_steps = protocol.curve_devices * protocol.total_steps
    teacher_steps = max(protocol.curve_devices, protocol.bracket_devices) * protocol.total_steps
    total = teacher_steps + len(missing) * len(gaps) * device_steps
    with (
        open_workers(len(gaps) * device_steps) as workers,
        ticking(screen, f"eval {len(rows)} conditions", total) as tick,
    ):
        bench = Bench(protocol, settings.seed, workers.runner(settings, models.file), tick)
        started: dict[tuple[str, str], Pending] = {}
        # A few rows ahead of the one that is waited for: all workers have something to do.
        ahead = iter(missing)
        for job in missing:
            while len(started) < 1 + 2 * workers.count and (next_one := next(ahead, None)):
                method, text = next_one
                runner = workers.runner(rows.get(text, settings), models.of(method).file)
                points, devices = points_of(method, gaps), protocol.curve_devices
                started[next_one] = start_points(runner, method, points, devices, tick)
            kept.add(_key(*job), robustness.kept(started.pop(job)()))
    outcomes = {job: robustness.taken(kept[_key(*job)]) for job in jobs}
    return {
        "gaps": list(gaps),
        "gaps_ms": [1e3 * gap * plant_of(settings).step_s for gap in gaps],
        "conditions": list(rows),
        "teacher_score": bench.teacher_score,
        "n_devices": protocol.curve_devices,
        "warmup_steps": protocol.warmup_steps,
        "scored_steps": protocol.steps,
        "methods": {
            method: _entry(method, list(rows), outcomes, gaps, bench) for method in methods
        },
    }


def points_of(method: str, gaps: Sequence[int]) -> list[Point]:
    """Return the links that a method is measured over: one that needs none has every packet."""
    needed = METHODS[split_late(method)[0]].needs_link
    return [Point("gap", float(gap) if needed else 1.0) for gap in gaps]


def _entry(
    method: str,
    rows: Sequence[str],
    outcomes: dict[tuple[str, str], Outcome],
    gaps: Sequence[int],
    bench: Bench,
) -> dict[str, Any]:
    points, nominal = points_of(method, gaps), outcomes[method, NOMINAL]
    reference = bench.reference
    of_rows = [outcomes[method, text] for text in rows]
    means = robustness.mean_of(of_rows, nominal, reference) if rows else []
    return {
        "nominal": robustness.describe(points, nominal, nominal, reference),
        "rows": [
            {"condition": text, "points": robustness.describe(points, one, nominal, reference)}
            for text, one in zip(rows, of_rows, strict=True)
        ],
        "means": [{"d": gap, **mean} for gap, mean in zip(gaps, means, strict=True)],
    }


def _key(method: str, text: str) -> str:
    return f"{method} under {text or 'nominal conditions'}"
