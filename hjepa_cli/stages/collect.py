"""``hjepa collect``: simulate cart-poles under an exploring teacher and keep them as a dataset.

Settings → dataset directory. Frames are stored only with ``--frames stored``, because states are
1,500 times smaller and render to the same pixels every time; otherwise a sample is rendered, to
report how fast that goes on this machine.
"""

import contextlib
import dataclasses
import functools
import math
import shlex
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.compute.executors import MAX_WORKERS, cores, finished, open_executor
from hjepa_cli.compute.interrupts import exit_code
from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.settings import Settings, dotted, load_settings
from hjepa_cli.core.control.payload import raw_frame_bits
from hjepa_cli.core.datasets.dataset import (
    MANIFEST,
    Dataset,
    Trajectories,
    load_dataset,
    open_directory,
    per_shard,
    write_manifest,
    write_shard,
)
from hjepa_cli.core.datasets.trajectories import generate, split_sizes
from hjepa_cli.core.plants.conditions import altered
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.named import plant, plant_of
from hjepa_cli.core.plants.system import Camera
from hjepa_cli.errors import DataError, HjepaError, Interrupted, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.storage.files import check_free_space, point_to
from hjepa_cli.storage.shards import (
    LOG,
    NAME,
    Described,
    Shard,
    ShardLog,
    cut,
    read_task,
    remove_log,
)

FRAMES_PER_SAMPLE = 2  # κ: current and previous
TOGETHER = 20  # trajectories rendered at a time; the sample is one such batch
WORTH_WORKERS = 4_000_000  # simulated steps; below, processes cost more than they bring
MAX_SHARDS = 50_000  # which make a dataset.json of 10 MB; readers take 16


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Collect a dataset.

    Args:
        settings: ``settings.collect`` of ``settings.plant``, drawn from ``settings.seed``.
        screen: where progress goes.
        out: the dataset's directory; ``None`` is the next free ``data/<plant>-<nnnn>``. One that
            holds a finished dataset is left as it is and described again.

    Returns:
        The document of ``--json``; ``frames_per_s`` is null if nothing was rendered.

    Raises:
        UsageError: a count that is too small, or ``out`` holds something else.
        DataError: ``out`` holds a dataset of another plant, or a damaged one.
        StorageError, LockedError: ``out`` cannot be written, or is being written.
    """
    check(settings)
    started = time.perf_counter()
    camera = plant_of(settings).camera()
    definition: dict[str, Any] = {
        "seed": settings.seed,
        "collect": settings.as_dict()["collect"] | {"plant": settings.plant},
    }
    if conditions := altered(settings.as_dict()):  # clean rollouts are of such devices
        definition["conditions"] = conditions
    with open_directory(out, settings.plant) as directory:
        if (directory / MANIFEST).exists():
            remove_log(directory)  # a kill between the two has left it behind
            data = load_dataset(directory, settings.plant)
            changed = "" if data.settings == definition else ", made with other settings"
            screen.say(f"{directory} holds a finished dataset{changed}; it is left as it is")
            return describe(data, time.perf_counter() - started, frames_per_s=None)

        check_same(directory, settings)
        shards_there = (path for path in directory.iterdir() if NAME.fullmatch(path.name))
        there_bytes = sum(path.stat().st_size for path in shards_there)
        check_free_space(directory, size_bytes(settings) - there_bytes)
        with telling_how_to_go_on(directory):
            log = ShardLog(directory, settings.as_dict())
            frames_per_s = rate(camera, settings)
            data = write_manifest(
                directory,
                settings=definition,
                shards=make_shards(settings, directory.absolute(), log, screen),
                plant_name=settings.plant,
                camera_manifest=camera.manifest(),
            )
            remove_log(directory)
    result = describe(data, time.perf_counter() - started, frames_per_s)
    bits = raw_frame_bits(FRAMES_PER_SAMPLE, HEIGHT_PX, WIDTH_PX)
    screen.say(
        f"{result['trajectories']} training trajectories in {result['seconds']:.1f} s: "
        f"{result['dataset']}; as raw frames the training phase takes "
        f"{result['training_uplink_bits'] / 1e9:.3g} Gbit of uplink ({bits} bits a step)"
    )
    return result


@contextlib.contextmanager
def telling_how_to_go_on(directory: Path) -> Iterator[None]:
    """From the first byte to the last: nothing finished is lost, and the message says so."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            "interrupted; finished shards are kept",
            hint=continue_command(directory),
            code=exit_code(error),
        ) from None
    except HjepaError as error:
        point_to(continue_command(directory), error)
        raise


def check_same(directory: Path, settings: Settings) -> None:
    """Refuse to go on with other settings than those that a collection was begun with.

    Raises:
        UsageError: naming them.
    """
    if not (directory / LOG).exists():
        return
    before, now = (
        dotted(given.as_dict() | {"preset": None})
        for given in (recorded_settings(directory), settings)
    )
    changed = [
        f"{key} = {before.get(key)!r}, not {now.get(key)!r}"
        for key in sorted(before.keys() | now.keys())
        if before.get(key) != now.get(key)
    ]
    if changed:
        raise UsageError(
            f"{directory} holds an unfinished dataset with other settings: {'; '.join(changed)}",
            hint=f"{continue_command(directory)} continues it; or choose another --out DIR",
        )


def recorded_settings(directory: Path) -> Settings:
    """What is being collected in ``directory``; settings that its version had not, by its preset.

    Raises:
        DataError: the log is damaged, or of a version with other settings.
    """
    task = read_task(directory)
    preset = task.pop("preset", None)
    if preset is not None and not isinstance(preset, str):
        raise DataError(f"{directory} is of preset {preset!r}")
    try:
        settings = load_settings(preset, None, dotted(task))
        check_settings(settings)
    except UsageError as error:
        raise DataError(
            f"{directory / LOG} was not written by this version: {error.message}",
            hint=f"delete {directory} to collect again, or choose another --out DIR",
        ) from None
    return settings


def check(settings: Settings) -> None:
    """Refuse sizes that make no dataset.

    Raises:
        UsageError: naming the flag or setting.
    """
    options = settings.collect
    for name, value, least in (
        ("--trajectories", options.trajectories, 1),
        ("--test-trajectories", options.test_trajectories, 1),
        ("collect.clean_trajectories", options.clean_trajectories, 1),
        ("--steps", options.steps, 1),
        ("collect.clean_steps", options.clean_steps, 1),
        ("collect.exploration_hold_steps", options.exploration_hold_steps, 1),
        ("collect.exploration_n", options.exploration_n, 0),
        ("collect.x_m", options.x_m, 0),
        ("collect.x_dot_m_s", options.x_dot_m_s, 0),
        ("collect.theta_rad", options.theta_rad, 0),
        ("collect.theta_dot_rad_s", options.theta_dot_rad_s, 0),
    ):
        if value < least:
            raise UsageError(f"{name} = {value}; expected at least {least}")
    total = sum(count for count, _ in split_sizes(settings).values())
    most = MAX_SHARDS * per_shard(options.frames == "stored")
    if total > most:
        raise UsageError(
            f"{total} trajectories; one dataset holds at most {most}",
            hint="collect several, each with its own --seed and --out DIR",
        )


def make_shards(
    settings: Settings, directory: Path, log: ShardLog, screen: Screen
) -> list[Described]:
    """Simulate, and render if frames are stored, every shard that is not there yet."""
    stored = settings.collect.frames == "stored"
    sizes = {name: count for name, (count, _) in split_sizes(settings).items()}
    shards = cut(sizes, per_shard(stored))
    left = [shard for shard in shards if not is_done(shard, settings, log)]
    done = sum(sizes.values()) - sum(shard.stop - shard.start for shard in left)
    screen.say(
        f"collecting trajectories of plant {settings.plant}: {len(left)} of {len(shards)} shards"
    )
    make = functools.partial(make_shard, settings, directory)
    enough = sum(count * steps for count, steps in split_sizes(settings).values()) >= WORTH_WORKERS
    with (
        screen.progress("collect", sum(sizes.values()), "trajectories", done=done) as bar,
        open_executor(min(cores(), MAX_WORKERS, len(left)) if enough else 0) as (executor, workers),
    ):
        for described in finished(executor, workers, make, left):
            log.add(described)
            bar.advance(described["trajectories"])
    return [log.done[shard.name] for shard in shards]


def is_done(shard: Shard, settings: Settings, log: ShardLog) -> bool:
    """Its file is intact, and described as ours would be."""
    expected = {
        "split": shard.split,
        "trajectories": shard.stop - shard.start,
        "steps": split_sizes(settings)[shard.split][1],
        "stored": settings.collect.frames == "stored",
    }
    described = log.done.get(shard.name, {})
    return all(described.get(key) == value for key, value in expected.items())


def make_shard(settings: Settings, directory: Path, shard: Shard) -> Described:
    """One unit of parallel work: decided by its arguments, written atomically, so repeatable."""
    made = generate(settings, shard.split, range(shard.start, shard.stop))
    if settings.collect.frames == "stored":
        made = dataclasses.replace(made, frames=film(plant(settings.plant).camera(), made))
    return write_shard(directory, shard, made, settings.plant)


def film(camera: Camera, made: Trajectories) -> np.ndarray:
    """Frames [N, T + 1, H, W, 3] of some trajectories."""
    frames = np.empty((*made.states.shape[:2], HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    for start in range(0, len(made), TOGETHER):
        states = made.states[start : start + TOGETHER]
        images = camera.render(states.reshape(-1, states.shape[-1]))
        frames[start : start + TOGETHER] = images.reshape(-1, *frames.shape[1:])
    return frames


def rate(camera: Camera, settings: Settings) -> float:
    """Frames per second of a sample that is rendered and dropped."""
    count = min(TOGETHER, settings.collect.trajectories)
    sample = generate(settings, "train", range(count))
    started = time.perf_counter()
    film(camera, sample)
    return sample.states[..., 0].size / (time.perf_counter() - started)


def size_bytes(settings: Settings) -> int:
    """What the dataset takes on disk, without headers."""
    kind, frame_bytes = plant(settings.plant), 0
    state_bytes, force_bytes = 4 * len(kind.state_names), 8 * math.prod(kind.action_shape)
    if settings.collect.frames == "stored":
        frame_bytes = HEIGHT_PX * WIDTH_PX * 3
    return sum(
        count * ((steps + 1) * (state_bytes + frame_bytes) + force_bytes * steps)
        for count, steps in split_sizes(settings).values()
    )


def continue_command(directory: Path) -> str:
    """What takes an interrupted collection up again."""
    return f"hjepa resume {shlex.quote(str(directory))}"


def describe(data: Dataset, seconds: float, frames_per_s: float | None) -> dict[str, Any]:
    """The document of ``--json``; ``training_uplink_bits``: what sending its frames would take."""
    count, steps = (data.splits["train"][key] for key in ("trajectories", "steps"))
    return {
        "dataset": str(data.path),
        "trajectories": count,
        "test_trajectories": data.splits["test"]["trajectories"],
        "clean_trajectories": data.splits["clean"]["trajectories"],
        "steps": steps,
        "seconds": round(seconds, 3),
        "frames_per_s": None if frames_per_s is None else round(frames_per_s, 1),
        "training_uplink_bits": count
        * steps
        * raw_frame_bits(FRAMES_PER_SAMPLE, HEIGHT_PX, WIDTH_PX),
    }
