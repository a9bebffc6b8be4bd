"""``eval`` and ``scale`` take curves of closed loops from a cache, or measure them now."""

import os
from collections.abc import Generator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import needs_model, split_late
from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control import link
from hjepa_cli.core.control.loop import LOOP_VERSION, Outcome, check_memory
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.evaluation.curves import Entry
from hjepa_cli.core.evaluation.entries import MethodEntries
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.workers import open_workers
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, UsageError, choices
from hjepa_cli.output.screen import Screen, ticking
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.model_set import ModelSet, how_to_train
from hjepa_cli.stages.plan import seconds_of
from hjepa_cli.storage import runs
from hjepa_cli.storage.runs import Run
from hjepa_cli.storage.zoo import CURVES_FILE

MIN_TEACHER_SCORE = 0.85  # below, a protocol judges the plant more than the methods
USUAL_ROUNDS = 2  # of the search for tolerances, for the progress bar


def plan_curves(
    models: ModelSet, methods: Sequence[str], *, remeasure: bool
) -> tuple[list[str], float]:
    """Return what :func:`curves_for` would do, by lines, and about how many seconds it takes."""
    protocol = models.settings.protocol
    check_memory(protocol, max(protocol.curve_devices, protocol.bracket_devices))
    found = {} if remeasure else cached(models, methods)
    known, missing = ([name for name in methods if (name in found) is had] for had in (True, False))
    work = [f"take the cached curves of {', '.join(known)}"] if known else []
    if missing:
        work.append(
            f"drive {protocol.curve_devices} devices for {protocol.total_steps} steps at each of "
            f"{len(protocol.gaps)} gaps and as many delivery probabilities, "
            f"{protocol.bracket_devices} near the limit, with {', '.join(missing)}"
        )
    return work, seconds_of_curves(missing, protocol)


def seconds_of_curves(methods: Sequence[str], protocol: ProtocolSettings) -> float:
    """Return about how long it takes to measure the curves of some methods."""
    rate = 0.5 + 2 * sum(1 / d for d in protocol.gaps[1:])  # two methods share the first point
    packets = rate * protocol.curve_devices * protocol.total_steps
    frames = {"closed-loop frames": sum(map(needs_model, methods)) * packets}
    return seconds_of_loops(methods, _usual_device_steps(protocol)) + seconds_of(frames)


def seconds_of_loops(methods: Sequence[str], device_steps: float) -> float:
    """Return about how long ``device_steps`` take, under each of the methods."""
    embedded = sum(map(needs_model, methods))
    on_states = (len(methods) - embedded) * device_steps
    return seconds_of(
        {
            "device-steps on embeddings": embedded * device_steps,
            "device-steps on states": on_states,
        }
    )


def curves_for(
    models: ModelSet,
    screen: Screen,
    record: Run,
    *,
    remeasure: bool = False,
    methods: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Take the curves of the settings' methods that are cached, measure the rest, keep each.

    Every curve is kept under the digest of the model that it was measured with, in a file of that
    model beside the checkpoint and in the run.

    Args:
        record: the run, of ``eval`` or ``scale``, that keeps them.
        remeasure: do not use cached curves; those of this very run, interrupted, are kept.
        methods: others than the settings', some perhaps late.

    Returns:
        The document of ``eval --json``. Methods without a model are left out, and said.
    """
    settings, protocol = models.settings, models.settings.protocol
    check_memory(protocol, max(protocol.curve_devices, protocol.bracket_devices))
    models.say_skipped(settings.methods, screen)
    methods = models.measurable(settings.methods) if methods is None else methods
    shares = [
        _Share(one, names, record, remeasure=remeasure, first=one is models)
        for one, names in models.shared_out(methods)
    ]
    jobs = [(name, share) for share in shares for name in share.missing]
    jobs.sort(key=lambda job: (_work(job[0]), methods.index(job[0])))
    # Closed at once where an interruption comes in here: others are being measured meanwhile.
    with closing(_measure(models, screen, jobs)) as measured:
        for (name, share), entry in measured:
            share.keep(name, entry)
            record.event("measured", method=name)
            screen.say(f"{name} measured")
    found: dict[str, tuple[Entry, Path]] = {}
    for share in shares:
        share.finish()
        found |= share.found
    files = ", ".join(dict.fromkeys(str(found[name][1]) for name in methods))
    return {
        **models.described(methods),
        "loop_version": LOOP_VERSION,
        "link": link.facts(protocol, len(plant(settings.plant).force_signs)),
        "acceptable_score": protocol.acceptable_score,
        "acceptable_lq_ratio": protocol.acceptable_lq_ratio,
        "horizon": list(range(protocol.horizon + 1)),
        "methods": {name: found[name][0] for name in methods},
        "skipped": models.skipped(settings.methods),
        "curves": record.path(CURVES_FILE),
        "source": f"curves of {files or 'nothing'}; --remeasure measures them again",
    }


class _Share:
    """It has the methods that one set's own model holds, and knows where their curves are kept.

    Attributes:
        found: curves and the file that has them, so far.
        missing: the methods that were not measured before.
    """

    def __init__(
        self, models: ModelSet, methods: Sequence[str], record: Run, *, remeasure: bool, first: bool
    ) -> None:
        self.models, self._digest = models, models.digest
        own = record.path(CURVES_FILE if first else curves.further_file(self._digest))
        self.found = {} if remeasure else curves.find(self._digest, methods, models.beside)
        kept: dict[str, Entry] = {}
        try:
            kept = curves.read(own, self._digest)
        except DataError:
            if not remeasure:  # which is what its hint says
                raise
        self.found |= {name: (kept[name], own) for name in methods if name in kept}
        self.missing = [name for name in methods if name not in self.found]
        # Beside the model too where that is a run of ours; the zoo is none.
        ours = [
            path
            for path in models.beside
            if (path.parent / runs.CONFIG).is_file() and os.access(path.parent, os.W_OK)
        ]
        self._own, self._files = own, [own, *ours]

    def keep(self, method: str, entry: Entry) -> None:
        """Write what was measured, at once."""
        for path in self._files:
            curves.write(path, self._digest, {method: entry})
        self.found[method] = (entry, self._own)

    def finish(self) -> None:
        """Let the run have the cached curves too."""
        entries = {name: entry for name, (entry, _) in self.found.items()}
        curves.write(self._own, self._digest, entries)


def cached(models: ModelSet, methods: Sequence[str]) -> dict[str, tuple[Entry, Path]]:
    """Return the curves of measurable methods that were measured before, and where they are."""
    found: dict[str, tuple[Entry, Path]] = {}
    for one, names in models.shared_out(methods):
        found |= curves.find(one.digest, names, one.beside)
    return found


def measure_points(
    models: ModelSet, screen: Screen, asked: Mapping[str, Sequence[Point]]
) -> dict[str, list[dict[str, Any]]]:
    """Drive all bracket devices at the points that are asked for of each method, now.

    Returns an entry per point, as in the curves of ``eval --json``, by method. Raises UsageError if
    one cannot be measured.
    """
    settings, protocol = models.settings, models.settings.protocol
    for method in asked:
        if split_late(method)[0] not in models.methods:
            raise UsageError(
                f"no model for method '{method}'; {choices(method, models.methods)}",
                hint=how_to_train(method, settings),
            )
    device_steps = _device_steps(protocol)
    total = (sum(map(len, asked.values())) + 1) * device_steps
    label = f"verify {next(iter(asked), '')}" if len(asked) < 2 else f"verify {len(asked)} methods"
    with open_workers(device_steps) as workers, ticking(screen, label, total) as tick:
        bench = Bench(protocol, settings.seed, workers.runner(settings, models.file), tick)

        def driven(method: str) -> Outcome:
            runner = workers.runner(settings, models.of(method).file)
            return bench.sharing(runner).measure(method, asked[method], protocol.bracket_devices)

        with closing(workers.each(driven, asked)) as ready:
            outcomes = dict(ready)
    return {name: bench.reference.describe(asked[name], outcomes[name]) for name in asked}


_Job = tuple[str, _Share]
"""A method to measure, and who has its model and keeps its entry."""


def _work(name: str) -> int:
    """Return the place of a method among those to measure: the longest first, or all wait for it.

    What predicts nothing needs the most packets, and each takes as long as many steps without one.
    Reflexes come next: what they play at every packet they do not share. True states take no time.
    """
    if not needs_model(name):
        return 3
    method = METHODS[split_late(name)[0]]
    if method.planner or method.fitted:
        return 2
    return 1 if method.reflex else 0


def _measure(
    models: ModelSet, screen: Screen, jobs: Sequence[_Job]
) -> Generator[tuple[_Job, Entry], None, None]:
    """Yield the entries of ``eval --json`` in the order in which they are ready."""
    if not jobs:
        return
    settings, protocol = models.settings, models.settings.protocol
    rollouts = _clean_rollouts(models)
    with open_workers(_device_steps(protocol)) as workers:
        with ticking(screen, "eval teacher", _device_steps(protocol)) as tick:
            runner = workers.runner(settings, models.file)
            bench = Bench(protocol, settings.seed, runner, tick)
        if bench.teacher_score < MIN_TEACHER_SCORE:
            screen.say(
                f"the teacher itself scores only {bench.teacher_score:.2f} here (a sound protocol "
                f"gives it {MIN_TEACHER_SCORE}): normalised scores say little"
            )
        label = f"eval {jobs[0][0]}" if len(jobs) == 1 else f"eval {len(jobs)} methods"
        with ticking(screen, label, len(jobs) * _usual_device_steps(protocol)) as tick:
            bench.tick = tick
            measured = {
                share: MethodEntries(
                    bench, workers, share.models.settings, share.models.file, rollouts
                )
                for share in {share for _, share in jobs}
            }
            yield from workers.each(lambda job: measured[job[1]].entry(job[0]), jobs)


def _clean_rollouts(models: ModelSet) -> tuple[Floats, Floats]:
    """Return states [R, steps + 1, S] and teacher's forces [R, steps, *A] without exploration."""
    clean = models.dataset.split("clean") if models.dataset else generate(models.settings, "clean")
    return clean.states.astype("float64"), clean.teacher_n.astype("float64")


def _device_steps(protocol: ProtocolSettings) -> int:
    """Return the device-steps of one curve point with all devices."""
    return protocol.total_steps * protocol.bracket_devices


def _usual_device_steps(protocol: ProtocolSettings) -> int:
    """Return the device-steps of one method: two grids, then rounds of two points."""
    grids = 2 * len(protocol.gaps) * protocol.curve_devices * protocol.total_steps
    return grids + 2 * USUAL_ROUNDS * _device_steps(protocol)
