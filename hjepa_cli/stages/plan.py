"""``--dry-run``: what a command would read, do and write, and about how long it would take.

Sizes follow from the settings; times from rates measured on two cores, so elsewhere they are right
within a factor of a few. Nothing is written here.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hjepa_cli.config.checks import LINKLESS, TRUE_STATE
from hjepa_cli.config.settings import Settings
from hjepa_cli.errors import HjepaError
from hjepa_cli.output.screen import Screen

if TYPE_CHECKING:
    from hjepa_cli.stages.model_set import Subject

ENCODER_PARAMETERS = 700_000
RATES_PER_S = {  # two cores of a server CPU
    "simulated steps": 400_000.0,
    "rendered frames": 6_000.0,
    "encoder training frames": 500.0,
    "encoded frames": 3_000.0,
    "level training steps": 10.0,
    "reflex training samples": 80_000.0,
    "device-steps of searches": 3_000_000.0,
    "closed-loop frames": 3_500.0,
    "device-steps on embeddings": 50_000.0,
    "device-steps on states": 300_000.0,
}
TRAINED = {  # by train-encoder --method: loops, and what they train
    "jepa": (1, "the encoder"),
    "supervised": (1, "frames to force"),
    "autoencoder": (2, "reconstruction, then reconstructed frames to force,"),
}
SEARCH_POINTS = 6  # of a tolerance, as a rule


@dataclasses.dataclass(frozen=True)
class Plan:
    """What one command would do.

    Args:
        command: its name.
        reads, work, writes: one line each.
        writes_bytes: about how much.
        seconds: about how long on two cores.
    """

    command: str
    reads: list[str]
    work: list[str]
    writes: list[str]
    writes_bytes: int
    seconds: float

    def as_dict(self) -> dict[str, Any]:
        """The document of ``--dry-run --json``."""
        return {"plan": dataclasses.asdict(self) | {"minutes": round(self.seconds / 60, 2)}}

    def show(self, screen: Screen) -> None:
        """Print the plan, one line per item, or as one JSON document."""
        if screen.json:
            screen.emit(self.as_dict())
            return
        screen.result(f"hjepa {self.command} would")
        for verb, lines in (("read", self.reads), ("do", self.work), ("write", self.writes)):
            for line in lines or ["nothing"]:
                screen.result(f"  {verb:6}{line}")
        screen.result(f"  in about {duration(self.seconds)}, {size(self.writes_bytes)} on disk")


def plan_collect(settings: Settings, out: Path | None) -> Plan:
    """Plan of ``hjepa collect``."""
    options = settings.collect
    trajectories = options.trajectories + options.test_trajectories
    steps = trajectories * options.steps + options.clean_trajectories * options.clean_steps
    frames = steps + trajectories + options.clean_trajectories
    from hjepa_cli.core.datasets.dataset import per_shard
    from hjepa_cli.stages.collect import size_bytes

    stored = options.frames == "stored"
    work = [
        f"simulate {options.trajectories} training, {options.test_trajectories} held-out and "
        f"{options.clean_trajectories} clean trajectories of plant {settings.plant} ({steps} steps)"
    ]
    if stored:
        work.append(f"render {frames} frames of 64 x 128 RGB")
    sizes = (options.trajectories, options.test_trajectories, options.clean_trajectories)
    shards = sum(-(-size // per_shard(stored)) for size in sizes)
    return Plan(
        command="collect",
        reads=[],
        work=work,
        writes=[f"dataset {out or f'data/{settings.plant}-<next number>'} in {shards} shards"],
        writes_bytes=size_bytes(settings),
        seconds=2 + _seconds({"simulated steps": steps, "rendered frames": frames * stored}),
    )


def plan_train_encoder(settings: Settings, dataset: Path | None, out: Path | None) -> Plan:
    """Plan of ``hjepa train-encoder``."""
    options = settings.encoder
    batch = options.batch_trajectories * options.batch_frames
    frames = _frames(settings)
    epochs = options.steps * batch / (settings.collect.trajectories * (settings.collect.steps + 1))
    loops, what = TRAINED[options.method]
    return Plan(
        command="train-encoder",
        reads=[_dataset(dataset, settings)],
        work=[
            f"render about {frames} frames",
            f"train {what} for {loops * options.steps} steps of {batch} frames "
            f"({loops * epochs:.0f} passes over the data), h = {options.h}",
            f"examine its health {'and stop at a missed gate' if options.gate else '(no gate)'}",
        ],
        writes=[f"run {_run('train-encoder', out)}"],
        writes_bytes=4 * (ENCODER_PARAMETERS + _predictor(settings, options.h)),
        seconds=5
        + _seconds(
            {
                "rendered frames": frames,
                "encoder training frames": loops * options.steps * batch,
                "encoded frames": (epochs / 4 + 3) * frames,
            }
        ),
    )


def plan_train_hierarchy(
    settings: Settings, dataset: Path | None, encoder: str | None, out: Path | None
) -> Plan:
    """Plan of ``hjepa train-hierarchy``."""
    options = settings.hierarchy
    frames = _frames(settings)
    h, m, l = options.h, options.m, options.l
    if h == m == l:
        levels = f"one level (h = {h})"
        steps = options.flat_steps + (options.coarse_steps if h > 1 else 0)
    else:
        levels = f"P^H, P^M, P^L (h, m, l = {h}, {m}, {l})"
        steps = options.coarse_steps + options.flat_steps
        steps += options.medium_steps + options.low_steps
    parameters = ENCODER_PARAMETERS + (2 if h == m == l else 4) * _predictor(settings, h)
    views = _views(settings)
    return Plan(
        command="train-hierarchy",
        reads=[_dataset(dataset, settings), _encoder(encoder, settings)],
        work=[
            f"render and encode about {frames} frames"
            + f", those for training {views} times" * (views > 1),
            f"train {levels}, ts-jepa-1 and the actor ({steps} steps)",
        ],
        writes=[f"run {_run('train-hierarchy', out)}"],
        writes_bytes=4 * parameters,
        seconds=5
        + _seconds(
            {
                "rendered frames": frames,
                "encoded frames": (1 + views) * frames,
                "level training steps": steps,
            }
        ),
    )


def plan_train_reflex(
    settings: Settings, dataset: Path | None, checkpoint: str | None, out: Path | None
) -> Plan:
    """Plan of ``hjepa train-reflex``."""
    from hjepa_cli.core.training.decay_fit import AROUND
    from hjepa_cli.stages.train_reflex import NETWORKS

    options, frames, views = settings.reflex, _frames(settings), _views(settings)
    samples = len(NETWORKS) * options.steps * options.batch_packets * options.batch_ages
    plans = len(NETWORKS) * views * settings.collect.trajectories * settings.collect.steps
    loops = options.search_candidates * options.search_rounds * options.search_devices
    steps = settings.protocol.warmup_steps + options.search_steps
    searched = 2 * loops * len(AROUND) * steps
    fitted = 2 * options.fit_candidates * options.fit_rounds * options.fit_devices * len(AROUND)
    seen = fitted * steps / settings.protocol.gaps[-1]  # about two packets a gap
    return Plan(
        command="train-reflex",
        reads=[_dataset(dataset, settings), _trained(checkpoint, settings)],
        work=[
            f"render and encode about {frames} frames"
            + f", those for training {views} times" * (views > 1),
            f"train {len(NETWORKS)} networks for {options.steps} steps of "
            f"{options.batch_packets} packets at {options.batch_ages} ages",
            "search a law whose force fades, and fit two decays on embeddings",
        ],
        writes=[f"run {_run('train-reflex', out)}"],
        writes_bytes=8 * ENCODER_PARAMETERS,
        seconds=5
        + _seconds(
            {
                "rendered frames": frames,
                "encoded frames": (1 + views) * frames,
                "reflex training samples": samples,
                "device-steps of searches": searched + plans * settings.protocol.gaps[-1],
                "device-steps on states": fitted * steps,
                "closed-loop frames": 4 * seen,
            }
        ),
    )


def plan_eval(
    settings: Settings,
    checkpoint: str | None,
    dataset: Path | None,
    out: Path | None,
    *,
    remeasure: bool,
    figure: bool = False,
) -> Plan:
    """Plan of ``hjepa eval``."""
    from hjepa_cli.stages.evaluate import open_measurable

    quiet = Screen(quiet=True)
    subject = open_measurable(settings, quiet, checkpoint, dataset, figure=figure)
    methods = subject.measurable(settings.methods)
    missing = _uncached(subject, methods, remeasure=remeasure)
    return Plan(
        command="eval",
        reads=[f"model {subject.name}", _clean(dataset, settings)],
        work=_loop_lines(subject, methods, missing),
        writes=[f"run {_run('eval', out)}"],
        writes_bytes=200_000,
        seconds=5 + _loop_seconds(settings, missing),
    )


def plan_scale(
    settings: Settings,
    checkpoint: str | None,
    dataset: Path | None,
    out: Path | None,
    snr_db: list[float],
    *,
    remeasure: bool,
    verify: bool,
) -> Plan:
    """Plan of ``hjepa scale``."""
    from hjepa_cli.stages.evaluate import open_measurable

    radio = settings.radio
    if radio.law == "scheduled":
        return _plan_scheduled(settings, checkpoint, out, snr_db, verify=verify)
    subject = open_measurable(settings, Screen(quiet=True), checkpoint, dataset)
    methods = _timed(subject, snr_db)
    missing = _uncached(subject, methods, remeasure=remeasure)
    work = [
        *_loop_lines(subject, methods, missing),
        f"count devices by law '{radio.law}' at {', '.join(f'{value:g}' for value in snr_db)} dB "
        f"in {radio.bandwidth_hz / 1e6:g} MHz for {len(methods)} methods",
    ]
    seconds = 5 + _loop_seconds(settings, missing)
    if verify:
        work.append("simulate one block at 0.9 and 1.1 of each tolerance")
        seconds += _drive_seconds(settings, methods, 2 * settings.protocol.bracket_devices)
    return Plan(
        command="scale",
        reads=[f"model {subject.name}", _clean(dataset, settings)],
        work=work,
        writes=[f"run {_run('scale', out)} with the table (CSV) and the figure (PNG, SVG)"],
        writes_bytes=300_000,
        seconds=seconds,
    )


def plan_reproduce(settings: Settings, out: Path | None) -> Plan:
    """Plan of ``hjepa reproduce``, whose curves are all measured."""
    from hjepa_cli.stages.reproduce import check

    check(settings)
    parts = reproduce_parts(settings)
    return Plan(
        command="reproduce",
        reads=[],
        work=[f"{name}: {line}" for name, (lines, _) in parts.items() for line in lines],
        writes=[f"folder {_run('reproduce', out)} with a report and its figures"],
        writes_bytes=plan_collect(settings, None).writes_bytes + 24 * ENCODER_PARAMETERS,
        seconds=15 + sum(seconds for _, seconds in parts.values()),
    )


def reproduce_parts(settings: Settings) -> dict[str, tuple[list[str], float]]:
    """What each stage of ``hjepa reproduce`` does, and about how many seconds that takes."""
    training = (
        plan_collect(settings, None),
        plan_train_encoder(settings, None, None),
        plan_train_hierarchy(settings, None, None, None),
    )
    from hjepa_cli.core.radio.capacity import parse_snr
    from hjepa_cli.stages.reproduce import left_out

    methods = [name for name in settings.methods if name not in left_out(settings)]
    counting: tuple[list[str], float] = (["count devices"], 5.0)
    if settings.radio.law == "scheduled":
        linked = [name for name in methods if name not in LINKLESS]
        counting = _scheduled_work(settings, linked, parse_snr(settings.radio.snr_db), verify=False)
    return {
        **{part.command: (part.work, part.seconds) for part in training},
        "eval": (
            [f"measure the curves of {', '.join(methods)}"],
            5 + _loop_seconds(settings, methods),
        ),
        "scale": counting,
    }


def plan_view(
    settings: Settings, checkpoint: str | None, out: Path, devices: int, *, live: bool
) -> Plan:
    """Plan of ``hjepa view``."""
    from hjepa_cli.stages.view import open_viewable

    subject = open_viewable(settings, Screen(quiet=True), checkpoint)
    steps, methods = settings.protocol.total_steps, settings.methods
    frames = 2 * len(methods) * devices * steps / 20 + 2000  # a packet in twenty; the probe's
    return Plan(
        command="view",
        reads=[f"model {subject.name}"],
        work=[
            "fit a linear probe of the state on embeddings",
            f"drive {devices} devices for {steps} steps with {', '.join(methods)}",
        ],
        writes=[] if live else [f"animation {out}"],
        writes_bytes=0 if live else 10_000 * 100 * devices * len(methods) // 4,
        seconds=10 + _seconds({"closed-loop frames": frames}),
    )


def _plan_scheduled(
    settings: Settings,
    checkpoint: str | None,
    out: Path | None,
    snr_db: list[float],
    *,
    verify: bool,
) -> Plan:
    """Plan of ``hjepa scale --law scheduled``: every load is simulated, none is cached."""
    from hjepa_cli.stages.scheduled import open_schedulable

    subject, methods = open_schedulable(settings, Screen(quiet=True), checkpoint)
    work, seconds = _scheduled_work(settings, methods, snr_db, verify=verify)
    return Plan(
        command="scale",
        reads=[f"model {subject.name}"],
        work=work,
        writes=[f"run {_run('scale', out)} with the table (CSV) and the figure"],
        writes_bytes=300_000,
        seconds=seconds,
    )


def _scheduled_work(
    settings: Settings, methods: list[str], snr_db: list[float], *, verify: bool
) -> tuple[list[str], float]:
    """What the searches of law scheduled do, and about how many seconds they take."""
    from hjepa_cli.core.evaluation.load_search import BLOCK_DEVICES, MAX_BISECTIONS, MAX_WIDENINGS

    radio = settings.radio
    searches = len(radio.schedulers) * radio.seeds
    if radio.load_depends_on_snr:
        searches *= len(snr_db)
    work = [
        f"simulate up to {MAX_BISECTIONS + 2 * MAX_WIDENINGS} loads of about {BLOCK_DEVICES} "
        f"devices for {settings.protocol.total_steps} slots in each of {searches} searches for "
        f"{len(methods)} methods under {', '.join(radio.schedulers)}"
    ]
    loads = searches * MAX_BISECTIONS  # as a rule
    if verify:
        work.append("simulate each load again, a little lighter and a little heavier")
        loads += 2 * searches
    return work, 5 + _drive_seconds(settings, methods, loads * BLOCK_DEVICES)


def size(count: float) -> str:
    """Bytes for people: 12 kB, 3.4 MB."""
    for unit in ("B", "kB", "MB", "GB"):
        if count < 1000 or unit == "GB":
            break
        count /= 1000
    return f"{count:.0f} {unit}" if count >= 10 or unit == "B" else f"{count:.1f} {unit}"


def duration(seconds: float) -> str:
    """A rough time for people: 20 s, 7 min, 3 h."""
    if seconds < 90:
        return f"{max(round(seconds, -1), 10):.0f} s"
    if seconds < 5400:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.0f} h"


def _seconds(work: dict[str, float]) -> float:
    return sum(amount / RATES_PER_S[kind] for kind, amount in work.items())


def _frames(settings: Settings) -> int:
    """Frames of the training and held-out splits, as the settings would collect them."""
    options = settings.collect
    return (options.trajectories + options.test_trajectories) * (options.steps + 1)


def _views(settings: Settings) -> int:
    """How many times training pictures are encoded: shifted, and mirrored."""
    views = 1 + (settings.hierarchy.shifted_copies if settings.encoder.shift_px else 0)
    return views * (2 if settings.encoder.mirror == "augment" else 1)


def _predictor(settings: Settings, actions: int) -> int:
    """Parameters of an anchored predictor, the largest kind."""
    inputs = 2 * settings.encoder.embedding + actions + 1
    parameters = (inputs + 1 + settings.encoder.embedding) * settings.encoder.hidden
    return parameters // 2 if settings.encoder.mirror == "exact" else parameters


def _timed(subject: "Subject", snr_db: list[float]) -> list[str]:
    """The methods as ``scale`` drives them: raw frames late."""
    from hjepa_cli.stages.scale import all_timed

    at = all_timed(subject, snr_db).values()
    return list(dict.fromkeys(name for names in at for name in names))


def _uncached(subject: "Subject", methods: list[str], *, remeasure: bool) -> list[str]:
    """The methods whose curves the stage would measure."""
    from hjepa_cli.stages.evaluate import cached

    found = {} if remeasure else cached(subject, methods)
    return [name for name in methods if name not in found]


def _loop_lines(subject: "Subject", methods: list[str], missing: list[str]) -> list[str]:
    options = subject.settings.protocol
    known = [name for name in methods if name not in missing]
    lines = [f"take the cached curves of {', '.join(known)}"] if known else []
    if missing:
        lines.append(
            f"drive {options.curve_devices} devices for {options.total_steps} steps at each of "
            f"{len(options.gaps)} gaps and as many delivery probabilities, "
            f"{options.bracket_devices} near the limit, with {', '.join(missing)}"
        )
    return lines


def _loop_seconds(settings: Settings, methods: list[str]) -> float:
    """Both grids with few devices, then the searches with many."""
    options = settings.protocol
    grids = 2 * len(options.gaps) * options.curve_devices
    searches = 2 * SEARCH_POINTS * options.bracket_devices
    per_step = sum(1.0 / gap for gap in options.gaps)
    frames = 2 * options.curve_devices * options.total_steps * per_step
    pixels = sum(name not in TRUE_STATE for name in methods)
    driving = _drive_seconds(settings, methods, grids + searches)
    return driving + _seconds({"closed-loop frames": pixels * frames})


def _drive_seconds(settings: Settings, methods: list[str], devices: int) -> float:
    """So many devices for all steps, under each of the methods."""
    device_steps = settings.protocol.total_steps * devices
    states = sum(name in TRUE_STATE for name in methods)
    return _seconds(
        {
            "device-steps on embeddings": (len(methods) - states) * device_steps,
            "device-steps on states": states * device_steps,
        }
    )


def _dataset(path: Path | None, settings: Settings) -> str:
    from hjepa_cli.core.datasets.dataset import find_newest_dataset, load_dataset

    if path is not None:
        return f"dataset {load_dataset(path, settings.plant).path}"
    found = _look(lambda: find_newest_dataset(Path("data"), settings.plant))
    return f"dataset {found}" if found else "dataset: none in data/ yet (hjepa collect)"


def _clean(path: Path | None, settings: Settings) -> str:
    return _dataset(path, settings) if path else "no dataset: clean rollouts come from the seed"


def _encoder(name: str | None, settings: Settings) -> str:
    from hjepa_cli.stages.train_hierarchy import open_encoder

    if name is not None:
        return f"encoder {open_encoder(name, settings, Screen(quiet=True)).path}"
    found = _look(lambda: open_encoder(None, settings, Screen(quiet=True)).path)
    return f"encoder {found}" if found else "encoder: none yet (hjepa train-encoder)"


def _trained(name: str | None, settings: Settings) -> str:
    from hjepa_cli.stages.train_reflex import open_model

    if name is not None:
        return f"model {open_model(name, settings, Screen(quiet=True)).path}"
    found = _look(lambda: open_model(None, settings, Screen(quiet=True)).path)
    return f"model {found}" if found else "model: none yet (hjepa train-hierarchy)"


def _look(find: Callable[[], Path | None]) -> Path | None:
    """An input that is not there yet, or not readable, does not spoil a plan."""
    try:
        return find()
    except HjepaError:
        return None


def _run(stage: str, out: Path | None) -> str:
    if out is not None:
        from hjepa_cli.storage.runs import check_ours

        check_ours(out)
    return str(out or f"runs/{stage}/<next number>")
