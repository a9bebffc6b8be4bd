"""``hjepa eval``: prediction error, control score and tolerated losses of each method.

A trained model (a run's or the zoo's) → closed-loop curves of every method, kept under a digest of
all they depend on, and tables. ``scale`` takes the same curves through :func:`curves_for`.
"""

import dataclasses
import os
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import Future
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import TRUE_STATE, check_gaps, check_methods, split_late
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.force_error import WINDOWS
from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.bench import Bench, control_entry
from hjepa_cli.core.evaluation.control_errors import Alone, LeftAlone, WithEveryPacket
from hjepa_cli.core.evaluation.curves import Entry
from hjepa_cli.core.evaluation.protocol import BESIDE, Point
from hjepa_cli.core.evaluation.simulator import Simulator
from hjepa_cli.core.evaluation.workers import Workers, open_workers
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.output.screen import Screen, described_steps, in_order, ticking, tolerance
from hjepa_cli.stages.model_set import Subject, how_to_train, open_subject
from hjepa_cli.storage import runs
from hjepa_cli.storage.runs import Run
from hjepa_cli.storage.zoo import CURVES_FILE

MIN_TEACHER_SCORE = 0.85  # below, a protocol judges the plant more than the methods
USUAL_ROUNDS = 5  # of the search for tolerances, for the progress bar


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    further: Sequence[Path] | None = None,
    figure: bool = False,
) -> dict[str, Any]:
    """Evaluate ``settings.methods``; returns the document of ``--json``.

    Args:
        settings: what to measure.
        screen: where to say so.
        checkpoint: zoo name, run directory or file; default: the newest run of the plant, else
            the zoo.
        dataset: take the clean rollouts for the NMAE from here instead of making them again.
        out: run directory; an interrupted one is continued after the last finished method.
        remeasure: do not use cached curves.
        further: models of methods that the first one does not hold; ``None`` looks for them.
        figure: draw the paper's Fig. 3 into the run's directory.

    Raises:
        UsageError: unknown method.
        MissingInputError: no such checkpoint or dataset, no model of any of the methods, or no
            matplotlib for ``figure``.
        DataError: a damaged file, one of another plant, or a figure of models of different seeds.
    """
    subject = open_measurable(settings, screen, checkpoint, dataset, further, figure=figure)
    inputs = subject.inputs(remeasure=remeasure, figure=figure)
    with Run.create("eval", out, settings.as_dict(), inputs) as record:
        result = record.result
        if result is None:
            result = record.finish(curves_for(subject, screen, record, remeasure=remeasure))
        else:
            screen.say(f"{record.directory} is finished; this is its result")
            for key in ("methods", "checkpoints"):  # stored in the order of the alphabet
                result[key] = in_order(result.get(key, {}), settings.methods)
        show(result, screen)
        if figure:
            result["figures"] = draw(result, settings, record.directory, screen)
        return result


def open_measurable(
    settings: Settings,
    screen: Screen,
    checkpoint: str | None,
    dataset: Path | None,
    further: Sequence[Path] | None = None,
    *,
    figure: bool = False,
) -> Subject:
    """Open what is to be evaluated, and refuse what cannot be before anything is written.

    Args and errors are those of :func:`run`.
    """
    check_methods(settings.methods)
    check_gaps(settings.protocol)
    if figure and find_spec("matplotlib") is None:
        raise MissingInputError(
            "a figure needs matplotlib, which is not installed", hint='pip install "hjepa[plot]"'
        )
    subject = open_subject(settings, screen, checkpoint, dataset, further, one_seed=figure)
    subject.check_any(settings.methods)
    check_rollouts(subject)
    if figure:
        subject.check_one_training_seed()
    return subject


def draw(result: dict[str, Any], settings: Settings, directory: Path, screen: Screen) -> list[Path]:
    """Write the paper's Fig. 3 as ``comparison.png``, ``.svg`` and ``.pdf``."""
    from hjepa_cli.output.comparison import comparison_figure
    from hjepa_cli.output.figures import save

    drawn = comparison_figure(
        result["methods"],
        acceptable_score=result["acceptable_score"],
        step_s=plant(settings.plant).step_s,
        title=f"{result['plant']}, seed {result['seed']}, 95 % CI",
    )
    paths = [save(drawn, directory / f"comparison.{kind}") for kind in ("png", "svg", "pdf")]
    screen.say(f"written: {', '.join(map(str, paths))}")
    return paths


def curves_for(
    subject: Subject,
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
        subject: what is evaluated.
        record: the run, of ``eval`` or ``scale``, that keeps them.
        remeasure: do not use cached curves; those of this very run, interrupted, are kept.
        methods: others than the settings', some perhaps late.

    Returns:
        The document of ``eval --json``. Methods without a model are left out, and said.
    """
    settings = subject.settings
    subject.say_skipped(settings.methods, screen)
    methods = subject.measurable(settings.methods) if methods is None else methods
    shares = [
        _Share(one, names, record, remeasure=remeasure, first=one is subject)
        for one, names in subject.shared_out(methods)
    ]
    jobs = [_Job(name, share) for share in shares for name in share.missing]
    jobs.sort(key=lambda job: methods.index(job.method))
    # Closed at once where an interruption comes in here: others are being measured meanwhile.
    with closing(_measure(subject, screen, jobs)) as measured:
        for job, entry in measured:
            job.share.keep(job.method, entry)
            record.event("measured", method=job.method)
            screen.say(f"{job.method} measured")
    for share in shares:
        share.finish()
    found = {name: entry for share in shares for name, entry in share.found.items()}
    found = {name: found[name] for name in methods}  # whichever was ready first
    paths = {name: subject.of(name).path for name in methods if name not in TRUE_STATE}
    return {
        "checkpoint": subject.path,
        "checkpoints": {name: path for name, path in paths.items() if path},
        "training_seeds": subject.training_seeds(methods),
        "plant": settings.plant,
        "seed": settings.seed,
        "loop_version": LOOP_VERSION,
        "acceptable_score": settings.protocol.acceptable_score,
        "acceptable_lq_ratio": settings.protocol.acceptable_lq_ratio,
        "horizon": list(range(settings.protocol.horizon + 1)),
        "methods": {name: found[name][0] for name in methods},
        "skipped": subject.skipped(settings.methods),
        "curves": record.path(CURVES_FILE),
        "source": _source(found),
    }


class _Share:
    """The methods that one subject's own model holds, and where their curves are kept.

    Args:
        subject, methods: whose, and which.
        record: the run that keeps them too.
        remeasure: do not use cached curves.
        first: is this the model that the user named?

    Attributes:
        found: curves and the file that has them, so far.
        missing: the methods that were not measured before.
    """

    def __init__(
        self, subject: Subject, methods: Sequence[str], record: Run, *, remeasure: bool, first: bool
    ) -> None:
        self.subject, digest = subject, subject.digest
        self._own = record.path(CURVES_FILE if first else curves.further_file(digest))
        self.found = {} if remeasure else curves.find(digest, methods, subject.beside)
        kept: dict[str, Entry] = {}
        try:
            kept = curves.read(self._own, digest)
        except DataError:
            if not remeasure:  # which is what its hint says
                raise
        self.found |= {name: (kept[name], self._own) for name in methods if name in kept}
        self.missing = [name for name in methods if name not in self.found]
        beside = [path for path in subject.beside if _is_run(path.parent)]
        self._files = [self._own, *beside]

    def keep(self, method: str, entry: Entry) -> None:
        """Write what was measured, at once."""
        for path in self._files:
            curves.write(path, self.subject.digest, {method: entry})
        self.found[method] = (entry, self._own)

    def finish(self) -> None:
        """Let the run have the cached curves too."""
        entries = {name: entry for name, (entry, _) in self.found.items()}
        curves.write(self._own, self.subject.digest, entries)


def cached(subject: Subject, methods: Sequence[str]) -> dict[str, tuple[Entry, Path]]:
    """The curves of measurable methods that were measured before, and where they are."""
    found: dict[str, tuple[Entry, Path]] = {}
    for one, names in subject.shared_out(methods):
        found |= curves.find(one.digest, names, one.beside)
    return found


def measure_points(
    subject: Subject,
    screen: Screen,
    *,
    method: str,
    gaps: Sequence[float] = (),
    probabilities: Sequence[float] = (),
) -> list[dict[str, Any]]:
    """Drive all bracket devices at given gaps (steps) or delivery probabilities, now.

    Returns:
        One entry per gap, then per probability: ``d`` or ``p``, ``score``, ``ci95``, ``lq_ratio``,
        ``n_devices``, as in the curves of :func:`run`.

    Raises:
        UsageError: the method cannot be measured.
    """
    settings = subject.settings
    if split_late(method)[0] not in subject.methods:
        raise UsageError(
            f"no model for method '{method}'; choose from {', '.join(subject.methods)}",
            hint=how_to_train(method, settings),
        )
    points = [Point("gap", gap) for gap in gaps]
    points += [Point("delivery", 1 / p) for p in probabilities]
    devices = settings.protocol.bracket_devices
    device_steps = (len(points) + 1) * _device_steps(settings)
    with (
        open_workers(_device_steps(settings)) as workers,
        ticking(screen, f"verify {method}", device_steps) as tick,
    ):
        runner = workers.runner(settings, subject.of(method).file)
        bench = Bench(settings.protocol, settings.seed, runner, tick)
        outcome = bench.measure(method, points, devices)
    return bench.reference.describe(points, outcome)


def show(result: dict[str, Any], screen: Screen) -> None:
    """Print the tables of an evaluation: what each method does, and its score over the gap."""
    entries = result["methods"]
    if not entries:
        return
    first = next(iter(entries.values()))
    windows = [f"{start}-{end}" for start, end in WINDOWS]
    where = f"{result['plant']}, seed {result['seed']}"
    scored = described_steps(first)
    screen.table(
        f"{where}: NMAE by steps since the packet ({first['n_rollouts']} rollouts), score and LQ "
        f"ratio with every packet ({first['n_curve_devices']} devices)",
        ["method", *(f"NMAE {window}" for window in windows), "score", "LQ", "bits"],
        [
            [
                name,
                *(_number(entry["nmae_windows"].get(window), 3) for window in windows),
                _number(entry["score"], 3),
                _number(entry["lq_ratio"], 3),
                entry["bits_per_transmission"],
            ]
            for name, entry in entries.items()
        ],
    )
    screen.table(
        f"{where}: tolerances at score {result['acceptable_score']:g} and, last, at LQ ratio "
        f"{result['acceptable_lq_ratio']:g} ({first['n_devices']} devices, {scored}, 95 % CI); "
        "beside each the share of steps in the band, the LQ ratio and the loops lost there",
        [
            *("method", "gap D* [steps]", "in band", "LQ", "lost"),
            *("delivery p*", "in band", "LQ", "lost", "D* by LQ"),
        ],
        [
            [
                name,
                tolerance(entry, "gap_steps", "gap", 1, "≥"),
                *(_number(entry.get(f"tolerance_gap_{key}"), 2) for key in BESIDE),
                tolerance(entry, "p", "p", 4, "≤"),
                *(_number(entry.get(f"tolerance_p_{key}"), 2) for key in BESIDE),
                _number(entry["tolerance_gap_lq_steps"], 1),
            ]
            for name, entry in entries.items()
        ],
    )
    screen.table(
        f"{where}: score over the gap between packets ({first['n_curve_devices']} devices)",
        ["method", *(f"{point['d']:g}" for point in first["gap_curve"])],
        [
            [name, *(_number(point["score"], 2) for point in entry["gap_curve"])]
            for name, entry in entries.items()
        ],
    )
    for name, path in result.get("checkpoints", {}).items():
        if path != result["checkpoint"]:
            screen.say(f"{name} is of model {path}")
    screen.say(result["source"])


@dataclasses.dataclass(frozen=True)
class _Job:
    """One method to measure, and who has its model and keeps its entry."""

    method: str
    share: _Share


def _measure(
    subject: Subject, screen: Screen, jobs: Sequence[_Job]
) -> Generator[tuple[_Job, Entry], None, None]:
    """Entries of ``eval --json``, in the order in which they are ready."""
    if not jobs:
        return
    settings, protocol = subject.settings, subject.settings.protocol
    rollouts = _clean_rollouts(subject)
    with open_workers(_device_steps(settings)) as workers:
        with ticking(screen, "eval teacher", _device_steps(settings)) as tick:
            runner = workers.runner(settings, subject.file)
            bench = Bench(protocol, settings.seed, runner, tick)
        if bench.teacher_score < MIN_TEACHER_SCORE:
            screen.say(
                f"the teacher itself scores only {bench.teacher_score:.2f} here (a sound protocol "
                f"gives it {MIN_TEACHER_SCORE}): normalised scores say little"
            )
        label = f"eval {jobs[0].method}" if len(jobs) == 1 else f"eval {len(jobs)} methods"
        with ticking(screen, label, len(jobs) * _usual_device_steps(settings)) as tick:
            bench.tick = tick
            measured = {
                share: _Measured(share.subject, bench, workers, rollouts)
                for share in {job.share for job in jobs}
            }
            yield from workers.each(lambda job: measured[job.share].entry(job.method), jobs)


class _Measured:
    """Measures the methods of one model; several threads may ask for some.

    Args:
        subject: whose model that is.
        bench: with the teacher.
        workers: compute.
        rollouts: clean ones, for the NMAE.
    """

    def __init__(
        self, subject: Subject, bench: Bench, workers: Workers, rollouts: tuple[Floats, Floats]
    ) -> None:
        self._settings, self._model, self._workers = subject.settings, subject.file, workers
        self._bench = bench.sharing(workers.runner(subject.settings, subject.file))
        self._rollouts = rollouts
        self._every_packet: dict[str, Future[Any]] = {}
        self._lock = threading.Lock()

    def entry(self, name: str) -> Entry:
        """What ``eval --json`` prints about a method."""
        waited = [self._submit(LeftAlone(name, *self._rollouts))]
        [alone] = self._workers.results(waited, self._bench.tick)
        assert isinstance(alone, Alone)
        with self._lock:  # with every packet a family plays the same
            if alone.family not in self._every_packet:
                unit = WithEveryPacket(name, *self._rollouts)
                self._every_packet[alone.family] = self._submit(unit)
        curves_of = self._bench.entry(alone)
        waited = [self._every_packet[alone.family]]
        [every] = self._workers.results(waited, self._bench.tick)
        seed, replicates = self._settings.seed, self._settings.protocol.bootstrap
        return {
            **control_entry(alone.errors, every, replicates, seed),
            **curves_of,
            "teacher_score": self._bench.teacher_score,
            "seed": seed,
        }

    def _submit(self, unit: LeftAlone | WithEveryPacket) -> "Future[Any]":
        return self._workers.submit(Simulator, self._settings, self._model, unit)


def _clean_rollouts(subject: Subject) -> tuple[Floats, Floats]:
    """States [R, steps + 1, 4] and teacher's forces [R, steps] without exploration or noise."""
    settings = subject.settings
    if subject.dataset:
        rollouts = subject.dataset.split("clean")
    else:
        rollouts = generate(settings, "clean")
    return rollouts.states.astype("float64"), rollouts.teacher_n.astype("float64")


def check_rollouts(subject: Subject) -> None:
    """Raise UsageError where the subject's clean rollouts, once made, would be too short."""
    settings, data = subject.settings, subject.dataset
    steps = data.splits["clean"]["steps"] if data else settings.collect.clean_steps
    check_horizon(settings.protocol.horizon, steps)


def check_horizon(horizon: int, steps: int) -> None:
    """Raise UsageError where clean rollouts of so many steps end before the horizon."""
    if steps <= horizon:
        raise UsageError(
            f"protocol.horizon = {horizon} needs clean rollouts of {horizon + 1} steps; "
            f"they have {steps}"
        )


def _source(found: dict[str, tuple[Entry, Path]]) -> str:
    paths = ", ".join(dict.fromkeys(str(path) for _, path in found.values()))
    return f"curves of {paths or 'nothing'}; --remeasure measures them again"


def _is_run(directory: Path) -> bool:
    """A run directory of ours that we may write to; the zoo has none."""
    return (directory / runs.CONFIG).is_file() and os.access(directory, os.W_OK)


def _device_steps(settings: Settings) -> int:
    """Of one curve point with all devices."""
    return settings.protocol.total_steps * settings.protocol.bracket_devices


def _usual_device_steps(settings: Settings) -> int:
    """Of one method: two grids, then rounds of two points."""
    protocol = settings.protocol
    grids = 2 * len(protocol.gaps) * protocol.curve_devices * protocol.total_steps
    return grids + 2 * USUAL_ROUNDS * _device_steps(settings)


def _number(value: float | None, decimals: int) -> str | None:
    return None if value is None else f"{value:.{decimals}f}"
