"""``hjepa data import SOURCE`` makes a dataset of recordings of a plant that hjepa does not know.

Recording → checked and aligned episodes → trajectories of one length → dataset. Actions are read
first and pictures one after the other, so that memory does not grow with the recording; finished
shards are kept, so that an import that was interrupted goes on.
"""

import contextlib
import dataclasses
import hashlib
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from hjepa_cli.config.schema import RECORDED, CameraSettings
from hjepa_cli.core.datasets.dataset import (
    MANIFEST,
    Dataset,
    definition_of,
    open_directory,
    undone,
    write_recording,
    write_shards,
)
from hjepa_cli.core.datasets.importing import alignment
from hjepa_cli.core.datasets.importing.aligned import TIMES
from hjepa_cli.core.datasets.importing.columns import Chosen
from hjepa_cli.core.datasets.importing.episode import Recording
from hjepa_cli.core.datasets.importing.opening import open_recording
from hjepa_cli.core.datasets.importing.prepared import Options, Prepared, prepare
from hjepa_cli.core.plants.frames import frame_bits
from hjepa_cli.errors import DataError, UsageError, shell
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.collect import telling_how_to_go_on
from hjepa_cli.stages.plan import Plan
from hjepa_cli.storage.runs import continue_command
from hjepa_cli.storage.shards import LOG, ShardLog, check_room, read_task, remove_log

TASK = "import"  # in the first line of the log of an unfinished import
SMALL = 0.05  # of a limit
SLOW_S = 1.0  # between pictures
IMPORTED_FRAMES_PER_S = 3000.0

Result = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Task:
    """All that an import is asked for.

    Attributes:
        sources: paths by split, absolute.
        format: one of :data:`~.opening.FORMATS`; ``None`` to see for itself.
        camera: feature with the pictures, where there are several.
    """

    sources: dict[str, str]
    format: str | None
    chosen: Chosen
    camera: str | None
    options: Options

    @contextlib.contextmanager
    def recordings(self) -> Iterator[dict[str, Recording]]:
        """Open all sources, and close them in the end."""
        with contextlib.ExitStack() as stack:
            found = {}
            for split, path in self.sources.items():
                found[split] = open_recording(Path(path), self.format, self.chosen, self.camera)
                stack.callback(found[split].close)
            yield found


def run(screen: Screen, *, out: Path | None = None, **asked: Any) -> Result:
    """Import a recording; return the document of ``--json``.

    ``out`` is the directory of the dataset, ``None`` the next free ``data/recorded-<nnnn>``; what
    else may be asked for are the arguments of :func:`task_of`.

    Raises:
        UsageError: a limit or a frame rate is missing, or a value makes no sense.
        MissingInputError: there is nothing, or what reads it is not installed.
        DataError: an episode is unsound; the message says in which row. Nothing is left behind.
        StorageError, LockedError: ``out`` cannot be written, or is being written.
    """
    return import_task(screen, task_of(**asked), out)


def plan(*, out: Path | None = None, **asked: Any) -> Plan:
    """Plan an import, after checking all but the pictures; arguments as of :func:`run`."""
    return plan_task(task_of(**asked), out)


def import_task(screen: Screen, task: Task, out: Path | None) -> Result:
    """Do what :func:`run` says; an unfinished import in ``out`` goes on."""
    if out is not None and (out / MANIFEST).exists():
        raise UsageError(
            f"{out} holds a finished dataset", hint="choose a new or empty directory with --out DIR"
        )
    with task.recordings() as recordings:
        return import_recordings(screen, recordings, task, out)


def import_recordings(
    screen: Screen, recordings: Mapping[str, Recording], task: Task, out: Path | None
) -> Result:
    """Import what was opened."""
    started = time.perf_counter()
    prepared = prepare(recordings, task.options)
    verdict = prepared.judge()
    definition = definition_of(prepared, task.options.camera)
    existed = out is not None and out.exists()
    with open_directory(out, RECORDED) as directory:
        begun = begun_with(task)
        if (directory / LOG).exists():
            check_same(directory, begun)
        check_room(directory, size_bytes(prepared))
        with telling_how_to_go_on(directory), undone(directory, DataError, keep=existed):
            data = write(directory, prepared, definition, ShardLog(directory, begun), screen)
    result = describe(data, prepared, verdict, time.perf_counter() - started)
    if prepared.lossy:
        screen.say(
            "warning: the pictures were compressed with losses, which breaks motion of less than a "
            "pixel: velocities are seen worse; record losslessly where you can"
        )
    tell_alignment(verdict, task.options.offset, screen)
    tell(result, screen)
    return result


def write(
    directory: Path,
    prepared: Prepared,
    definition: Mapping[str, Any],
    log: ShardLog,
    screen: Screen,
) -> Dataset:
    """Write all shards that the log does not have, and the manifest."""
    made = prepared.assembly
    shards = made.shards()
    frames = {
        shard.name: sum(
            piece.steps + 1 for piece in made.splits[shard.split][shard.start : shard.stop]
        )
        for shard in shards
    }
    # Those with flaws are made again: all of an unsound episode is left out, in later shards too.
    done = {name: described for name, described in log.done.items() if not described.get("bad")}
    for described in done.values():
        made.said |= set(described.get("said", []))
    there, told = sum(frames[name] for name in done if name in frames), len(made.bad)
    with screen.progress("import", made.frames(), "frames", done=there) as bar:
        for described in write_shards(directory, made, definition, done):
            log.add({**described, "bad": made.bad[told:], "said": sorted(made.said)})
            told = len(made.bad)
            bar.advance(frames[described["name"]])
    data = write_recording(directory, [log.done[shard.name] for shard in shards], definition)
    remove_log(directory)
    return data


def task_of(
    source: Path,
    *,
    test: Path | None = None,
    clean: Path | None = None,
    kind: str | None = None,
    size: tuple[int, int] = (64, 128),
    grey: bool = False,
    limit: Sequence[float] | None = None,
    fps: float | None = None,
    action_offset: int = 0,
    steps: int | None = None,
    held_out: float = 0.2,
    mirror_signs: Sequence[float] | None = None,
    actions: Sequence[str] | None = None,
    states: Sequence[str] | None = None,
    expert: Sequence[str] | None = None,
    camera: str | None = None,
    skip_bad: bool = False,
) -> Task:
    """Put together what is asked for.

    Args:
        source: the recording, whose format is known by what lies there.
        test, clean: recordings for these splits; without ``test`` some episodes are held out.
        kind: the format.
        size, grey: of the frames.
        limit, fps, action_offset, steps, held_out, mirror_signs, skip_bad: see :class:`Options`.
        actions, states, expert: columns; see :class:`Chosen`.
        camera: see :class:`Task`.

    Raises:
        UsageError: a size that networks cannot read, or a test of what is trained on.
    """
    sources = {"train": source, "test": test, "clean": clean}
    named = (None if some is None else tuple(some) for some in (actions, states, expert))
    options = Options(
        camera=frame_size(size, grey),
        limits=None if limit is None else tuple(limit),
        step_s=None if fps is None else 1 / fps,
        offset=action_offset,
        steps=steps,
        held_out=held_out,
        mirror=tuple(mirror_signs or ()),
        skip_bad=skip_bad,
    )
    paths = {split: str(path.absolute()) for split, path in sources.items() if path}
    for split in ("test", "clean"):
        if split in paths and Path(paths[split]).resolve() == source.resolve():
            raise UsageError(
                f"--{split} {sources[split]} is what is trained on",
                hint=f"leave out --{split}: --held-out holds some of it out",
            )
    return Task(paths, kind, Chosen(*named), camera, options)


def frame_size(size: tuple[int, int], grey: bool) -> CameraSettings:
    """Return the size of frames. Raises UsageError where networks cannot read it."""
    height, width = size
    try:
        return msgspec.convert(
            {"height_px": height, "width_px": width, "grey": grey}, CameraSettings
        )
    except msgspec.ValidationError:
        raise UsageError(f"--size {height} {width}; expected 16 to 1024 pixels each") from None


def resume(directory: Path, screen: Screen) -> Result:
    """Take up the unfinished import in a directory."""
    return import_task(screen, recorded_task(directory), directory)


def plan_resume(directory: Path) -> Plan:
    """Plan to take up the unfinished import in a directory; it refuses what :func:`resume` does."""
    task = recorded_task(directory)
    check_same(directory, begun_with(task))
    return plan_task(task, directory)


def is_import(directory: Path) -> bool:
    """Tell whether an unfinished dataset is imported, not collected."""
    return TASK in read_task(directory)


def recorded_task(directory: Path) -> Task:
    """Return what is being imported. Raises DataError where the log says nothing sound."""
    try:
        return msgspec.convert(read_task(directory)[TASK], Task)
    except msgspec.ValidationError as error:
        raise DataError(
            f"{directory / LOG} was not written by this version: {error}",
            hint=f"delete {directory} to import again, or choose another --out DIR",
        ) from None


def begun_with(task: Task) -> dict[str, Any]:
    """Return the first line of the log of an import."""
    return {TASK: msgspec.json.decode(msgspec.json.encode(task)), "sources": stamps(task)}


def stamps(task: Task) -> dict[str, Any]:
    """Return size and time of each source, or what follows from those of all files in it.

    A folder's own do not change where a picture in it is replaced.
    """
    return {split: _stamp(Path(path)) for split, path in task.sources.items()}


def _stamp(source: Path) -> list[int] | str:
    if not source.is_dir():
        found = source.stat()
        return [found.st_size, found.st_mtime_ns]
    inside = sorted(path for path in source.rglob("*") if path.is_file())
    each = [[os.fspath(path.relative_to(source)), *_stamp(path)] for path in inside]
    return hashlib.sha256(repr(each).encode()).hexdigest()


def check_same(directory: Path, begun: Mapping[str, Any]) -> None:
    """Raise UsageError where another import was begun in a directory, or its source has changed."""
    there = read_task(directory)
    if there.get(TASK) != begun[TASK]:
        raise UsageError(
            f"{directory} holds an unfinished dataset of something else",
            hint=f"{continue_command(directory)} continues it; or choose another --out DIR",
        )
    if there.get("sources") != begun["sources"]:
        raise UsageError(
            f"the source has changed since {directory} was begun",
            hint=f"delete {directory} to import again, or choose another --out DIR",
        )


def plan_task(task: Task, out: Path | None) -> Plan:
    """Plan a task."""
    with task.recordings() as recordings:
        prepared = prepare(recordings, task.options)
    made = prepared.assembly
    count = sum(map(len, made.splits.values()))
    steps = {split: pieces[0].steps for split, pieces in made.splits.items()}
    height, width, channels = made.frame_shape
    return Plan(
        command="data import",
        reads=[f"{split}: {path}" for split, path in task.sources.items()],
        work=[
            f"cut {prepared.episodes} episodes into {count} trajectories of {steps['train']} "
            f"steps, {len(prepared.known.limits)} actions, {len(prepared.known.states)} states",
            f"convert {made.frames()} frames to {height} x {width} x {channels}",
            *(f"leave out {flaw}" for flaw in made.bad),
        ],
        writes=[f"dataset {out or 'data/recorded-<next number>'} in {len(made.shards())} shards"],
        writes_bytes=size_bytes(prepared),
        seconds=2 + made.frames() / IMPORTED_FRAMES_PER_S,
    )


def size_bytes(prepared: Prepared) -> int:
    """Return what the frames of a dataset take on disk."""
    made = prepared.assembly
    return made.frames() * frame_bits(made.frame_shape) // 8


def tell_alignment(verdict: alignment.Verdict | None, offset: int, screen: Screen) -> None:
    """Say what the pictures say of the actions that lead from them."""
    if verdict is None:
        screen.say("too little to test by inverse dynamics which action leads from which picture")
        return
    stated, best = verdict.r2[0], verdict.r2[verdict.best]
    warn = verdict.best and verdict.clear
    said = verdict.best if warn else 0
    others = [f"{offset + n} (R² {verdict.r2[n]:.2f})" for n in verdict.alike if n != said]
    also = f"; about as well fits {', '.join(others)}: this test cannot tell" if others else ""
    if warn:
        screen.say(
            f"warning: pictures show the action of row j + {offset + said} between picture "
            f"j and j + 1 (R² {best:.2f}), not that of row j + {offset} (R² {stated:.2f}); "
            f"--action-offset {offset + said} says so{also}"
        )
    elif best < alignment.LEAST_R2:
        screen.say(f"pictures hardly show any action (R² {best:.2f}): alignment is untested")
    else:
        screen.say(
            f"alignment: no offset fits the pictures clearly better than {offset} "
            f"(R² {stated:.2f}){also if said in verdict.alike else ''}"
        )


def describe(
    data: Dataset, prepared: Prepared, verdict: alignment.Verdict | None, seconds: float
) -> Result:
    """Return the document of ``--json``."""
    made = prepared.assembly
    frames = sum(of["trajectories"] * (of["steps"] + 1) for of in data.splits.values())
    return {
        "dataset": str(data.path),
        "plant": data.plant,
        "episodes": prepared.episodes,
        "steps": data.splits["train"]["steps"],
        **{f"{name}_trajectories": of["trajectories"] for name, of in data.splits.items()},
        "frames": frames,
        "frame_shape": list(made.frame_shape),
        "step_s": prepared.known.step_s,
        "step_from": prepared.step_from,
        "limits": list(prepared.known.limits),
        "largest": list(prepared.largest),
        "states": list(prepared.known.states),
        "converted": sorted(made.said),
        "left_out": list(made.bad),
        "alignment": None if verdict is None else dataclasses.asdict(verdict),
        "seconds": round(seconds, 3),
        "frames_per_s": round(frames / max(seconds, 1e-9), 1),
    }


def tell(result: Mapping[str, Any], screen: Screen) -> None:
    """Say what was imported, converted and left out."""
    for text in result["converted"]:
        screen.say(f"converted: {text}")
    for text in result["left_out"]:
        screen.say(f"left out: {text}")
    tell_units(result, screen)
    states = f"{len(result['states'])} states" if result["states"] else "no states"
    screen.say(
        f"{result['episodes']} episodes, {result['frames']} frames, {len(result['limits'])} "
        f"actions, {states} in {result['seconds']:.1f} s: {result['dataset']}; next: "
        f"{shell(['hjepa', 'data', 'preview', result['dataset']])}, "
        f"{shell(['hjepa', 'train-encoder', '--dataset', result['dataset']])}"
    )


def tell_units(result: Mapping[str, Any], screen: Screen) -> None:
    """Say what times and actions were taken for, and warn where another unit is likely."""
    step_s, limits, largest = (result[key] for key in ("step_s", "limits", "largest"))
    if step_s > SLOW_S and result["step_from"] == TIMES:
        screen.say(
            f"warning: {step_s:g} s between pictures, from {TIMES}, which is in seconds: divide "
            "it by 1000 if it holds milliseconds"
        )
    for number, (limit, most) in enumerate(zip(limits, largest, strict=True)):
        if most < SMALL * limit:
            screen.say(
                f"warning: action {number} is never above {most:.3g}, {most / limit:.1%} of its "
                f"limit {limit:g}: are they in the same unit?"
            )
    given, recorded = (", ".join(f"{one:.4g}" for one in values) for values in (limits, largest))
    screen.say(
        f"{1 / step_s:.4g} pictures/s (from {result['step_from']}), limits {given}; "
        f"largest recorded {recorded}"
    )
