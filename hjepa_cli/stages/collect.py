"""``hjepa collect`` simulates plants under an exploring teacher and keeps them as a dataset.

Settings → dataset directory. Frames are stored only with ``--frames stored``, because states are
1,500 times smaller and render to the same pixels every time; otherwise a sample is rendered, to
report how fast that goes on this machine.
"""

import contextlib
import dataclasses
import functools
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hjepa_cli.compute import memory
from hjepa_cli.compute.executors import MAX_WORKERS, cores, finished, open_executor
from hjepa_cli.compute.interrupts import exit_code
from hjepa_cli.config.checks import check_settings
from hjepa_cli.config.schema import RECORDED, Settings, dotted, unsaid
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import (
    MANIFEST,
    Dataset,
    load_dataset,
    open_directory,
    per_shard,
    undone,
    write_manifest,
    write_shard,
)
from hjepa_cli.core.datasets.trajectories import generate, split_sizes
from hjepa_cli.core.plants.conditions import altered
from hjepa_cli.core.plants.frames import frame_bits, frames_of
from hjepa_cli.core.plants.named import camera_of, plant, plant_of
from hjepa_cli.errors import DataError, HjepaError, Interrupted, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import PLANTS
from hjepa_cli.stages.plan import Plan, seconds_of
from hjepa_cli.storage.files import holding, identity, point_to, refuse_foreign
from hjepa_cli.storage.runs import continue_command, differences
from hjepa_cli.storage.shards import (
    LOG,
    NAME,
    Described,
    Shard,
    ShardLog,
    check_room,
    cut,
    read_task,
    remove_log,
)

PLUGIN = "plugin"  # of the plant, by its digest, in the first line of the log
OWN = ("control", "camera", "sensor")  # what a dataset brings along for all that is done with it
FRAMES_PER_SAMPLE = 2  # the paper's pairs
TOGETHER = 20  # trajectories rendered at a time; the sample is one such batch
WORTH_WORKERS = 4_000_000  # simulated steps; below, processes cost more than they bring
MAX_SHARDS = 50_000  # which make a dataset.json of 10 MB; readers take 16


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Collect a dataset; return the document of ``--json``, see :func:`describe`.

    ``out`` is its directory, ``None`` the next free ``data/<plant>-<nnnn>``. One that holds a
    finished dataset is left as it is and described again.

    Raises:
        UsageError: a count that is too small, or ``out`` holds something else.
        DataError: ``out`` holds a dataset of another plant, or a damaged one.
        StorageError, LockedError: ``out`` cannot be written, or is being written.
    """
    check(settings)
    started = time.perf_counter()
    camera = camera_of(plant_of(settings), settings.camera, settings.sensor)
    definition: dict[str, Any] = {
        "seed": settings.seed,
        "collect": settings.as_dict()["collect"] | {"plant": settings.plant},
    }
    if conditions := altered(settings.as_dict()):  # clean rollouts are of such devices
        definition["conditions"] = conditions
    definition |= {key: value for key, value in settings.as_dict().items() if key in OWN}
    existed = out is not None and out.exists()
    with open_directory(out, settings.plant) as directory:
        if (directory / MANIFEST).exists():
            return describe_finished(directory, screen, settings.plant, definition)
        check_same(directory, settings)
        check_room(directory, size_bytes(settings))
        begun = (directory / LOG).exists()
        # What a plant cannot do shows here, before anything is there that could be taken up.
        with contextlib.nullcontext() if begun else undone(directory, BaseException, keep=existed):
            sample = generate(
                settings, "train", range(min(TOGETHER, settings.collect.trajectories))
            )
            began = time.perf_counter()
            frames_of(camera, sample.states)  # rendered and dropped
            frames_per_s = sample.states[..., 0].size / (time.perf_counter() - began)
        with telling_how_to_go_on(directory):
            log = ShardLog(directory, begun_with(settings))
            data = write_manifest(
                directory,
                settings=definition,
                shards=make_shards(settings, directory.absolute(), log, screen),
                plant_name=settings.plant,
                camera_manifest=camera.manifest(),
            )
            remove_log(directory)
    result = describe(data, time.perf_counter() - started, frames_per_s)
    bits = FRAMES_PER_SAMPLE * frame_bits(settings.camera.frame_shape)
    screen.say(
        f"{result['trajectories']} training trajectories in {result['seconds']:.1f} s: "
        f"{result['dataset']}; as raw frames the training phase takes "
        f"{result['training_uplink_bits'] / 1e9:.3g} Gbit of uplink ({bits} bits a step)"
    )
    return result


def plan(settings: Settings, *, out: Path | None = None) -> Plan:
    """Plan the simulation of all splits and, if frames are stored, their pictures.

    It refuses what :func:`run` would refuse, but for a full or read-only disk.
    """
    check(settings)
    plant_of(settings)
    if out is not None and (out / MANIFEST).exists():
        load_dataset(out, settings.plant)
    elif out is not None:
        refuse_foreign(out, "dataset", lambda name: name == LOG or bool(NAME.fullmatch(name)))
        check_same(out, settings)
    sizes = split_sizes(settings)
    train, test, clean = (count for count, _ in sizes.values())
    steps = sum(count * steps for count, steps in sizes.values())
    frames = steps + train + test + clean if settings.collect.frames == "stored" else 0
    work = [
        f"simulate {train} training, {test} held-out and "
        f"{clean} clean trajectories of plant {settings.plant} ({steps} steps)"
    ]
    if frames:
        height_px, width_px, channels = settings.camera.frame_shape
        colours = "RGB" if channels == 3 else "grey"
        work.append(f"render {frames} frames of {height_px} x {width_px} {colours}")
    directory = out or f"data/{settings.plant}-<next number>"
    return Plan(
        command="collect",
        reads=[],
        work=work,
        writes=[f"dataset {directory} in {len(shards_of(settings))} shards"],
        writes_bytes=size_bytes(settings),
        seconds=2 + seconds_of({"simulated steps": steps, "rendered frames": frames}),
        memory_bytes=memory_bytes(settings),
    )


def describe_finished(
    directory: Path,
    screen: Screen,
    plant_name: str | None = None,
    definition: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the document of a complete dataset, and say if other settings than these made it.

    Raises DataError if it is damaged, or of another plant.
    """
    remove_log(directory)  # a kill between the two has left it behind
    data = load_dataset(directory, plant_name)
    changed = definition is not None and data.settings != definition
    made = ", made with other settings" * changed
    screen.say(f"{directory} holds a finished dataset{made}; it is left as it is")
    return describe(data, 0.0, frames_per_s=None)


@contextlib.contextmanager
def telling_how_to_go_on(directory: Path) -> Iterator[None]:
    """Turn what stops a collection into a message that nothing finished is lost."""
    try:
        yield
    except KeyboardInterrupt as error:
        raise Interrupted(
            "interrupted; finished shards are kept",
            hint=continue_command(directory),
            code=exit_code(error),
        ) from None
    except HjepaError as error:
        if (directory / LOG).exists():  # else nothing is there yet that could be resumed
            point_to(continue_command(directory), error)
        raise


def check_same(directory: Path, settings: Settings) -> None:
    """Raise UsageError where a collection was begun with other settings."""
    begun = recorded_settings(directory) if (directory / LOG).exists() else settings
    if changed := differences(begun.as_dict(), settings.as_dict()):
        raise UsageError(
            f"{directory} holds an unfinished dataset with other settings: {'; '.join(changed)}",
            hint=f"{continue_command(directory)} continues it; or choose another --out DIR",
        )


def begun_with(settings: Settings) -> dict[str, Any]:
    """Return the first line of the log: the settings, and which text of a plugin is the plant."""
    source = PLANTS.source(settings.plant)
    return settings.as_dict() | ({PLUGIN: source.sha256} if source else {})


def recorded_settings(directory: Path) -> Settings:
    """Return what is being collected; settings that its version had not are its preset's.

    Raises:
        UsageError: no plugin in force adds its plant, or its file has changed.
        DataError: the log is damaged, or of a version with other settings.
    """
    task = read_task(directory)
    again = f"delete {directory} to collect again, or choose another --out DIR"
    if isinstance(name := task.get("plant"), str) and name not in PLANTS:
        raise UsageError(
            f"{directory} collects of plant '{name}', which no plugin in force adds",
            hint=f"{continue_command(directory)} --plugin FILE.py",
        )
    begun, source = task.pop(PLUGIN, None), PLANTS.source(str(name))
    if begun and source and begun != source.sha256:
        raise UsageError(
            f"{directory} was begun with plugin {source.name}, which has changed since",
            hint=f"restore the file; or {again}",
        )
    preset = task.pop("preset", None)
    if preset is not None and not isinstance(preset, str):
        raise DataError(f"{directory} is of preset {preset!r}")
    try:
        settings = load_settings(preset, None, unsaid(task) | dotted(task))
        check_settings(settings)
    except UsageError as error:
        raise DataError(
            f"{directory / LOG} was not written by this version: {error.message}", hint=again
        ) from None
    return settings


def check(settings: Settings) -> None:
    """Raise UsageError where sizes make no dataset, naming the setting."""
    check_settings(settings)
    if settings.plant == RECORDED:
        raise UsageError(
            "a recorded plant is not simulated; its datasets are imported",
            hint="hjepa data import SOURCE",
        )
    if settings.sensor.ideal:
        raise UsageError(
            "sensor.ideal = true is for models that bring a sensor along; a collection is ideal "
            "unless [sensor] says otherwise",
            key="sensor.ideal",
        )
    camera_of(plant(settings.plant), settings.camera, settings.sensor)
    total = sum(count for count, _ in split_sizes(settings).values())
    most = MAX_SHARDS * per_shard(settings.collect.frames == "stored")
    if total > most:
        raise UsageError(
            f"{total} trajectories; one dataset holds at most {most}",
            hint="collect several, each with its own --seed and --out DIR",
        )
    memory.check(memory_bytes(settings), "a shard of such trajectories")


def shards_of(settings: Settings) -> list[Shard]:
    """Return the shards that the settings make."""
    sizes = {name: count for name, (count, _) in split_sizes(settings).items()}
    return cut(sizes, per_shard(settings.collect.frames == "stored"))


def make_shards(
    settings: Settings, directory: Path, log: ShardLog, screen: Screen
) -> list[Described]:
    """Simulate, and render if frames are stored, every shard that is not there yet."""
    shards, stored = shards_of(settings), settings.collect.frames == "stored"
    sizes = split_sizes(settings)

    def is_done(shard: Shard) -> bool:
        count, (_, steps) = shard.stop - shard.start, sizes[shard.split]
        ours = {"split": shard.split, "trajectories": count, "steps": steps, "stored": stored}
        return ours.items() <= log.done.get(shard.name, {}).items()

    left = [shard for shard in shards if not is_done(shard)]
    total, to_do = (sum(shard.stop - shard.start for shard in some) for some in (shards, left))
    screen.say(
        f"collecting trajectories of plant {settings.plant}: {len(left)} of {len(shards)} shards"
    )
    make = functools.partial(make_shard, settings, directory, identity(directory))
    enough = sum(count * steps for count, steps in sizes.values()) >= WORTH_WORKERS
    with (
        screen.progress("collect", total, "trajectories", done=total - to_do) as bar,
        open_executor(min(cores(), MAX_WORKERS, len(left)) if enough else 0) as (executor, workers),
    ):
        for described in finished(executor, workers, make, left):
            log.add(described)
            bar.advance(described["trajectories"])
    return [log.done[shard.name] for shard in shards]


def make_shard(
    settings: Settings, directory: Path, which: tuple[str, int], shard: Shard
) -> Described:
    """Do a unit of parallel work: decided by its arguments, written atomically, so repeatable."""
    made = generate(settings, shard.split, range(shard.start, shard.stop))
    if settings.collect.frames == "stored":
        camera = camera_of(plant(settings.plant), settings.camera, settings.sensor)
        made = dataclasses.replace(made, frames=frames_of(camera, made.states, TOGETHER))
    with holding(directory, which):
        return write_shard(directory, shard, made, settings.plant, settings.as_dict())


def size_bytes(settings: Settings) -> int:
    """Return what the dataset takes on disk, without headers."""
    kind = plant(settings.plant)
    state_bytes, force_bytes = 4 * len(kind.state_names), 8 * math.prod(kind.action_shape)
    stored = settings.collect.frames == "stored"
    frame_bytes = stored * frame_bits(settings.camera.frame_shape) // 8
    return sum(
        count * ((steps + 1) * (state_bytes + frame_bytes) + force_bytes * steps)
        for count, steps in split_sizes(settings).values()
    )


def memory_bytes(settings: Settings) -> int:
    """Return what the largest shard takes while it is made: drawn, simulated, as it is written."""
    collect, kind = settings.collect, plant_of(settings)
    states, forces = len(kind.state_names), math.prod(kind.action_shape)
    stored = collect.frames == "stored"
    row_bytes = 8 * (states + 4 * forces) + 8 * (states + 2 * forces)
    row_bytes += 2 * frame_bits(settings.camera.frame_shape) // 8 * stored
    return max(
        min(count, per_shard(stored)) * (steps + 1) * row_bytes
        for count, steps in split_sizes(settings).values()
    )


def describe(data: Dataset, seconds: float, frames_per_s: float | None) -> dict[str, Any]:
    """Return the document of ``--json``; ``frames_per_s`` is ``None`` if nothing was rendered.

    Its uplink is what sending the frames would take.
    """
    counts = {name: split["trajectories"] for name, split in data.splits.items()}
    count, steps = counts["train"], data.splits["train"]["steps"]
    return {
        "dataset": str(data.path),
        "trajectories": count,
        "test_trajectories": counts["test"],
        "clean_trajectories": counts.get("clean", 0),
        "steps": steps,
        "seconds": round(seconds, 3),
        "frames_per_s": None if frames_per_s is None else round(frames_per_s, 1),
        "training_uplink_bits": count * steps * FRAMES_PER_SAMPLE * frame_bits(data.frame_shape),
    }
