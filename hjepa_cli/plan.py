"""``--dry-run``: what a command would read, do and write, and about how long it would take.

Sizes follow from the settings; times from rates measured on two cores, so elsewhere they are right
within a factor of a few. Nothing is written here.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hjepa_cli.errors import HjepaError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings

FRAME_BYTES = 64 * 128 * 3
ENCODER_PARAMETERS = 1_500_000
RATES_PER_S = {  # two cores of a server CPU
    "simulated steps": 400_000.0,
    "rendered frames": 6_000.0,
    "encoder training frames": 450.0,
    "encoded frames": 3_000.0,
    "level training steps": 8.0,
    "closed-loop frames": 2_000.0,
}
STATE_METHODS = ("hold-true", "zero-true", "optimal", "oracle")  # these render and encode nothing


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
    stored = options.frames == "stored"
    work = [
        f"simulate {options.trajectories} training, {options.test_trajectories} held-out and "
        f"{options.clean_trajectories} clean trajectories of plant {settings.plant} ({steps} steps)"
    ]
    if stored:
        work.append(f"render {frames} frames of 64 x 128 RGB")
    return Plan(
        command="collect",
        reads=[],
        work=work,
        writes=[f"dataset {out or f'data/{settings.plant}-<next number>'}"],
        writes_bytes=frames * (16 + (FRAME_BYTES if stored else 0)) + steps * 8,
        seconds=2 + _seconds({"simulated steps": steps, "rendered frames": frames}),
    )


def plan_train_encoder(settings: Settings, dataset: Path | None, out: Path | None) -> Plan:
    """Plan of ``hjepa train-encoder``."""
    options = settings.encoder
    batch = options.batch_trajectories * options.batch_frames
    frames = _frames(settings)
    epochs = options.steps * batch / max(frames, 1)
    return Plan(
        command="train-encoder",
        reads=[_dataset(dataset, settings)],
        work=[
            f"render about {frames} frames",
            f"train the encoder for {options.steps} steps of {batch} frames "
            f"({epochs:.0f} passes over the data), h = {options.h}",
            f"examine its health {'and stop at a missed gate' if options.gate else '(no gate)'}",
        ],
        writes=[f"run {_run('train-encoder', out)}"],
        writes_bytes=4 * (ENCODER_PARAMETERS + _predictor(settings, options.h)),
        seconds=5
        + _seconds(
            {
                "rendered frames": frames,
                "encoder training frames": options.steps * batch,
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
    steps = options.coarse_steps + options.flat_steps + options.medium_steps + options.low_steps
    parameters = ENCODER_PARAMETERS + 4 * _predictor(settings, options.h)
    return Plan(
        command="train-hierarchy",
        reads=[_dataset(dataset, settings), _encoder(encoder, settings)],
        work=[
            f"render and encode about {frames} frames and their mirror images",
            f"train P^H, P^M, P^L (h, m, l = {options.h}, {options.m}, {options.l}), "
            f"ts-jepa-1 and the actor ({steps} steps)",
        ],
        writes=[f"run {_run('train-hierarchy', out)}"],
        writes_bytes=4 * parameters,
        seconds=5
        + _seconds(
            {
                "rendered frames": frames,
                "encoded frames": 2 * frames,
                "level training steps": steps,
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
) -> Plan:
    """Plan of ``hjepa eval``."""
    return Plan(
        command="eval",
        reads=[_model(checkpoint, settings), _clean(dataset, settings)],
        work=[_loop_line(settings) + ("" if remeasure else ", unless its curves are cached")],
        writes=[f"run {_run('eval', out)}"],
        writes_bytes=200_000,
        seconds=10 + _loop_seconds(settings),
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
    radio = settings.radio
    work = [
        "measure the closed-loop curves again" if remeasure else "use cached curves where they fit",
        f"count devices by law '{radio.law}' at {', '.join(f'{value:g}' for value in snr_db)} dB "
        f"in {radio.bandwidth_hz / 1e6:g} MHz for {len(settings.methods)} methods",
    ]
    if remeasure:
        work.insert(1, _loop_line(settings))
    if verify:
        work.append("simulate one block at 0.9 and 1.1 of each tolerance")
    return Plan(
        command="scale",
        reads=[_model(checkpoint, settings), _clean(dataset, settings)],
        work=work,
        writes=[f"run {_run('scale', out)} with the table (CSV) and the figure (PNG, SVG)"],
        writes_bytes=300_000,
        seconds=10 + (_loop_seconds(settings) if remeasure else 0.0),
    )


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


def _predictor(settings: Settings, actions: int) -> int:
    """Parameters of an anchored predictor, the largest kind."""
    inputs = 2 * settings.encoder.embedding + actions + 1
    return (inputs + 1 + settings.encoder.embedding) * settings.encoder.hidden


def _loop_line(settings: Settings) -> str:
    options = settings.protocol
    return (
        f"drive {options.curve_devices} devices for {options.steps} steps at each of "
        f"{len(options.gaps)} gaps and as many delivery probabilities, "
        f"{options.bracket_devices} near the limit, for {len(settings.methods)} methods"
    )


def _loop_seconds(settings: Settings) -> float:
    """Methods that see frames encode one per update; the others are nearly free."""
    options = settings.protocol
    updates = sum(1.0 / gap for gap in options.gaps)
    pixels = sum(method not in STATE_METHODS for method in settings.methods)
    frames = 2 * pixels * options.curve_devices * options.steps * updates
    return _seconds({"closed-loop frames": frames})


def _dataset(path: Path | None, settings: Settings) -> str:
    from hjepa_cli.storage.datasets import find_newest_dataset, load_dataset

    if path is not None:
        return f"dataset {load_dataset(path, settings.plant).path}"
    found = _look(lambda: find_newest_dataset(Path("data"), settings.plant))
    return f"dataset {found}" if found else "dataset: none in data/ yet (hjepa collect)"


def _clean(path: Path | None, settings: Settings) -> str:
    return _dataset(path, settings) if path else "no dataset: clean rollouts come from the seed"


def _encoder(name: str | None, settings: Settings) -> str:
    found = _named(name) or _newest_run("train-encoder", settings)
    return f"encoder {found}" if found else "encoder: none yet (hjepa train-encoder)"


def _model(name: str | None, settings: Settings) -> str:
    found = _named(name) or _newest_run("train-hierarchy", settings)
    return f"model {found}" if found else "model of the zoo, if it has one"


def _named(name: str | None) -> Path | None:
    from hjepa_cli.storage.zoo import resolve_model

    return None if name is None else resolve_model(name)


def _newest_run(stage: str, settings: Settings) -> Path | None:
    from hjepa_cli.storage.runs import newest_run, read_config

    return _look(
        lambda: newest_run(stage, lambda run: read_config(run).get("plant") == settings.plant)
    )


def _look(find: Callable[[], Path | None]) -> Path | None:
    """An input that is not there yet, or not readable, does not spoil a plan."""
    try:
        return find()
    except HjepaError:
        return None


def _run(stage: str, out: Path | None) -> str:
    return str(out or f"runs/{stage}/<next number>")
