"""A dataset keeps one plant's trajectories in safetensors shards; ``dataset.json`` describes them.

``dataset.json`` is written last and names every shard with its sha256, so a directory is a
dataset only when it is complete. No time, host or path is stored: equal inputs, equal bytes.
"""

import contextlib
import dataclasses
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from hjepa_cli.config.schema import RECORDED, CameraSettings, SensorSettings
from hjepa_cli.core.datasets.importing import arrays as arrays_of
from hjepa_cli.core.datasets.importing.aligned import largest
from hjepa_cli.core.datasets.importing.assembly import Assembly
from hjepa_cli.core.datasets.importing.prepared import Options, Prepared, prepare
from hjepa_cli.core.plants.named import camera_in, plant_in
from hjepa_cli.core.plants.recorded import RecordedCamera
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    MissingInputError,
    NumericalError,
    UsageError,
    shell,
)
from hjepa_cli.storage import files, seals
from hjepa_cli.storage import tensors as arrays
from hjepa_cli.storage.shards import LOG, Described, Shard
from hjepa_cli.storage.shards import NAME as SHARD_NAME

SCHEMA = 1
FORMAT = "hjepa-dataset"
MANIFEST = "dataset.json"
SHARD_TRAJECTORIES = 1000
SHARD_TRAJECTORIES_WITH_FRAMES = 50  # about 120 MB


@dataclasses.dataclass(frozen=True)
class Trajectories:
    """It holds N trajectories of T steps; the state at step k is ``states[:, k + 1]``.

    Args:
        states: float32 [N, T + 1, S], the plant's states; of a cart-pole x (m), x_dot (m/s), theta
            (rad), theta_dot (rad/s). S = 0 where none were recorded.
        applied_n: float32 [N, T, *A], the force or forces applied at step k (N).
        teacher_n: float32 [N, T, *A], the teacher's for the state at step k (N).
        frames: uint8 [N, T + 1, H, W, C], or ``None`` if they are rendered on load.
    """

    states: np.ndarray
    applied_n: np.ndarray
    teacher_n: np.ndarray
    frames: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.applied_n)

    @property
    def steps(self) -> int:
        """Return T, the number of control steps of each trajectory."""
        return int(self.applied_n.shape[1])

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the arrays by name, without absent frames."""
        return {name: array for name, array in vars(self).items() if array is not None}

    def __getitem__(self, rows: slice) -> "Trajectories":
        return Trajectories(**{name: array[rows] for name, array in self.tensors().items()})


class _ShardEntry(msgspec.Struct):
    name: Annotated[str, msgspec.Meta(pattern=rf"\A{SHARD_NAME.pattern}\Z")]  # leads nowhere else
    trajectories: int
    sha256: str


class _SplitEntry(msgspec.Struct):
    steps: int
    trajectories: int
    shards: Annotated[list[_ShardEntry], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        if self.trajectories != sum(shard.trajectories for shard in self.shards):
            raise ValueError("`trajectories` is not the sum over the shards")


class _Config(msgspec.Struct):
    collect: dict[str, Any] = {}
    camera: CameraSettings = CameraSettings()
    sensor: SensorSettings = SensorSettings()


class _Manifest(msgspec.Struct):
    """It is all of ``dataset.json`` that :class:`Dataset` relies on."""

    plant: str
    config: _Config
    camera: dict[str, Any]
    frames: Literal["stored", "rendered"]
    splits: Annotated[
        dict[Literal["train", "test", "clean"], _SplitEntry], msgspec.Meta(min_length=1)
    ]


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Its manifest is verified; shards are read and verified by :meth:`split`."""

    path: Path  # the others in the order in which :func:`load_dataset` takes them
    plant: str
    settings: dict[str, Any]
    camera: dict[str, Any]
    digest: str
    frames: str
    splits: dict[str, Any]

    @classmethod
    def from_arrays(
        cls,
        frames: Sequence[np.ndarray] | np.ndarray,
        actions: Sequence[np.ndarray] | np.ndarray,
        states: Sequence[np.ndarray] | np.ndarray | None = None,
        *,
        expert_actions: Sequence[np.ndarray] | np.ndarray | None = None,
        limits: Sequence[float] | None = None,
        fps: float = 50.0,
        size: tuple[int, int] = (64, 128),
        grey: bool = False,
        mirror_signs: Sequence[float] = (),
        steps: int | None = None,
        action_offset: int = 0,
        held_out: float = 0.2,
        out: str | Path | None = None,
    ) -> "Dataset":
        """Write a dataset of recorded arrays; see ``hjepa data import`` for what the rest means.

        Args:
            frames: [N, R, H, W, C], or a list with [R, H, W, C] of each episode, R its own.
            actions: [N, R, A] or [N, R − 1, A], or a list; row j leads from frame j to frame j + 1.
            states: [N, R, S], or a list, if anybody knows them.
            expert_actions: what an expert would do at each frame; default: the actions.
            limits: of the actions; default: the largest of each.
            fps: frames a second.
            size, grey: of the frames in the dataset.
            mirror_signs: what a mirror does to each action, 1 or −1, where that is true at all.
            steps: of a trajectory; default: of the shortest episode.
            action_offset: row j + ``action_offset`` leads from frame j to frame j + 1.
            held_out: share of the episodes for the split ``test``.
            out: its directory; default: the next free ``data/recorded-<nnnn>``.

        Raises:
            UsageError: an argument that makes no sense, or ``out`` holds a dataset already.
            DataError: an episode is unsound; the message says which row.
        """
        given = {"actions": actions, "states": states, "expert": expert_actions}
        columns = {key: list(values) for key, values in given.items() if values is not None}
        recording = arrays_of.recording(list(frames), columns, format="arrays")
        if limits is None:
            limits = [float(most) or 1.0 for most in largest(recording)]
        camera = CameraSettings(*size, grey)
        options = Options(
            camera,
            limits=tuple(limits),
            step_s=1 / fps,
            offset=action_offset,
            steps=steps,
            held_out=held_out,
            mirror=tuple(mirror_signs),
        )
        prepared = prepare({"train": recording}, options)
        place = None if out is None else Path(out)
        existed = place is not None and place.exists()
        with open_directory(place, RECORDED) as directory:
            for name, what in ((MANIFEST, "a dataset"), (LOG, "an unfinished dataset")):
                if (directory / name).exists():
                    raise UsageError(f"{directory} holds {what} already; choose another out")
            definition = definition_of(prepared, camera)
            with undone(directory, BaseException, keep=existed):
                made = write_shards(directory, prepared.assembly, definition)
                return write_recording(directory, list(made), definition)

    @property
    def kind(self) -> System:
        """Return the plant. Raises DataError where no plugin in force adds it."""
        return _plant(self.plant, self.settings, self.path)

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """Return (H, W, C) of its pictures."""
        return camera_in(self.settings).frame_shape

    @property
    def rollouts(self) -> str:
        """Name the split on which predicted forces are compared with the right ones."""
        return "clean" if "clean" in self.splits else "test"

    def split(self, name: str) -> Trajectories:
        """Read one of ``train``, ``test``, ``clean``, verifying sha256, shapes and values.

        Raises:
            MissingInputError: a shard is gone.
            DataError: a shard is truncated, changed, misshapen or not finite.
        """
        if name not in self.splits:
            raise DataError(
                f"dataset {self.path} has no split '{name}'; it has {', '.join(self.splits)}"
            )
        described = self.splits[name]
        parts = [self._read_shard(shard, described["steps"]) for shard in described["shards"]]
        joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        return Trajectories(**joined)

    def flaws(self) -> Iterator[HjepaError]:
        """Yield what is wrong with each shard that is gone, unreadable or not as it was written."""
        for split in self.splits.values():
            for shard in split["shards"]:
                try:
                    self._read_shard(shard, split["steps"])
                except HjepaError as error:
                    yield error

    def _read_shard(self, shard: Mapping[str, Any], steps: int) -> dict[str, np.ndarray]:
        path = self.path / shard["name"]
        stored = self.frames == "stored"
        count, kind, frame_shape = shard["trajectories"], self.kind, self.frame_shape
        expected = _expected(count, steps, stored, path, kind, frame_shape)
        values = (np.dtype(name).itemsize * math.prod(shape) for name, shape in expected.values())
        limit_bytes = sum(values) + arrays.HEADER_LIMIT_BYTES + 8
        data = files.read_bytes(path, limit=limit_bytes)
        if hashlib.sha256(data).hexdigest() != shard["sha256"]:
            raise DataError(
                f"{path} was changed or truncated after it was written: its sha256 does not match",
                hint="collect the dataset again: hjepa collect",
            )
        tensors, _ = arrays.unpack(data, path)
        if reason := arrays.difference(tensors, expected):
            raise DataError(f"{path}: {reason}")
        if bad := arrays.non_finite(tensors):
            raise DataError(f"{path}: '{bad}' holds NaN or an infinity")
        return tensors


def write_shard(
    directory: Path,
    shard: Shard,
    trajectories: Trajectories,
    plant_name: str,
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> Described:
    """Write one shard and return how the manifest will describe it.

    ``settings`` are those that the manifest will have.

    Raises:
        DataError: wrong shapes or dtypes.
        NumericalError: values that are not finite; they are not written.
        StorageError: the disk refused.
    """
    stored, tensors = trajectories.frames is not None, trajectories.tensors()
    path = directory / shard.name
    kind, frame_shape = _plant(plant_name, settings, path), camera_in(settings).frame_shape
    expected = _expected(len(trajectories), trajectories.steps, stored, path, kind, frame_shape)
    if reason := arrays.difference(tensors, expected):
        raise DataError(f"{path}: {reason}")
    if bad := arrays.non_finite(tensors):
        row, index, *_ = np.argwhere(~np.isfinite(tensors[bad]))[0]
        raise NumericalError(
            f"trajectory {shard.start + row} of split '{shard.split}': '{bad}' is not finite from "
            f"index {index} on",
            hint="--config FILE.toml with smaller forces or starts in [collect]",
        )
    data = arrays.pack(tensors)
    files.write_bytes(path, data)
    return {
        "name": shard.name,
        "split": shard.split,
        "trajectories": len(trajectories),
        "steps": trajectories.steps,
        "stored": stored,
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def definition_of(prepared: Prepared, camera: CameraSettings) -> dict[str, Any]:
    """Return the settings of an imported dataset: its plant, its pictures, how it was cut."""
    return {
        "seed": None,
        "recorded": dataclasses.asdict(prepared.known),
        "camera": dataclasses.asdict(camera),
        "import": {
            "format": prepared.format,
            "episodes": prepared.episodes,
            "lossy": prepared.lossy,
        },
    }


def write_shards(
    directory: Path,
    made: Assembly,
    settings: Mapping[str, Any],
    done: Mapping[str, Described] = MappingProxyType({}),
) -> Iterator[Described]:
    """Write the shards of an assembly that are not ``done``; yield what describes each.

    One without any sound trajectory has none, and no file.

    Raises:
        As :func:`write_shard` and :meth:`Assembly.trajectories`.
    """
    left = [shard for shard in made.shards() if shard.name not in done]
    for shard, tensors in made.trajectories(left):
        found = {"name": shard.name, "split": shard.split, "trajectories": 0}
        if tensors:
            found = write_shard(directory, shard, Trajectories(**tensors), RECORDED, settings)
        yield found


def write_recording(
    directory: Path, shards: Sequence[Described], settings: Mapping[str, Any]
) -> Dataset:
    """Write the manifest of an imported dataset. Raises DataError where a split is empty."""
    written = [shard for shard in shards if shard["trajectories"]]
    for split in dict.fromkeys(shard["split"] for shard in shards):
        if split not in {shard["split"] for shard in written}:
            raise DataError(f"no trajectory of split {split} is left")
    size = camera_in(settings)
    return write_manifest(
        directory,
        settings=settings,
        shards=written,
        plant_name=RECORDED,
        camera_manifest=RecordedCamera(size.frame_shape).manifest(),
    )


def write_manifest(
    directory: Path,
    *,
    settings: Mapping[str, Any],
    shards: Sequence[Described],
    plant_name: str,
    camera_manifest: Mapping[str, Any],
) -> Dataset:
    """Write ``dataset.json``, which makes the written shards a dataset.

    ``settings`` are what it was made with, ``seed`` included; ``shards`` are what
    :func:`write_shard` returned, in the order of their numbers.
    """
    stored = any(shard["stored"] for shard in shards)
    described: dict[str, Any] = {}
    for shard in shards:
        empty = {"trajectories": 0, "steps": shard["steps"], "shards": []}
        split = described.setdefault(shard["split"], empty)
        split["trajectories"] += shard["trajectories"]
        split["shards"].append({key: shard[key] for key in ("name", "trajectories", "sha256")})
    manifest = {
        "format": FORMAT,
        "schema": SCHEMA,
        "plant": plant_name,
        "seed": settings.get("seed"),
        "config": dict(settings),
        "camera": dict(camera_manifest),
        "frames": "stored" if stored else "rendered",
        "splits": described,
    }
    files.write_json(directory / MANIFEST, seals.sealed(manifest))
    return load_dataset(directory)


def load_dataset(path: Path, plant_name: str | None = None) -> Dataset:
    """Open a dataset directory (of a plant) and verify its manifest.

    Raises:
        MissingInputError: no such directory.
        DataError: not a dataset, changed, of a newer schema, or of another plant.
    """
    if not path.exists():
        raise MissingInputError(f"dataset {path} does not exist", hint="hjepa collect")
    if not (path / MANIFEST).is_file():
        raise DataError(
            f"{path} is not an hjepa dataset: no {MANIFEST}",
            hint=f"hjepa collect, or of a recording {shell(['hjepa', 'data', 'import', path])}",
        )
    manifest = files.read_json(path / MANIFEST)
    if manifest.get("format") != FORMAT:
        raise DataError(f"{path} is not an hjepa dataset: its {MANIFEST} is of another program")
    files.check_schema(manifest.get("schema"), SCHEMA, f"dataset {path}")
    seals.check(manifest, path / MANIFEST, "collect the dataset again: hjepa collect")
    try:
        msgspec.convert(manifest, _Manifest)
    except msgspec.ValidationError as error:
        raise DataError(f"{path / MANIFEST} lacks fields or has malformed ones: {error}") from None
    if plant_name is not None and manifest["plant"] != plant_name:
        raise DataError(
            f"dataset {path} belongs to plant {manifest['plant']}, not {plant_name}",
            hint=f"hjepa collect with a preset of plant {plant_name}",
        )
    fields = ("plant", "config", "camera", "sha256", "frames", "splits")
    data = Dataset(path, *(manifest[name] for name in fields))
    if data.plant == RECORDED:
        _ = data.kind  # described soundly
    return data


@contextlib.contextmanager
def open_directory(out: Path | None, plant_name: str) -> Iterator[Path]:
    """Create and lock ``out``, else ``data/<plant>-<nnnn>``; a dataset that is there stays.

    Raises:
        UsageError: ``out`` holds files that are not ours.
        LockedError: another process collects into it.
    """
    directory = out or files.next_directory(Path("data"), f"{plant_name}-")
    files.make_directory(directory)
    if (directory / MANIFEST).exists():
        load_dataset(directory)  # a foreign or damaged dataset.json says so itself
    else:
        files.refuse_foreign(
            directory, "dataset", lambda name: name == LOG or bool(SHARD_NAME.fullmatch(name))
        )
    with files.lock_directory(directory):
        yield directory


@contextlib.contextmanager
def undone(directory: Path, errors: type[BaseException], *, keep: bool) -> Iterator[None]:
    """Leave nothing of a dataset in the making, nor of its directory, after one of the errors.

    ``keep`` leaves the directory, which was there before.
    """
    try:
        yield
    except errors:
        for path in directory.iterdir():
            if SHARD_NAME.fullmatch(path.name) or path.name in (LOG, files.LOCK_FILE):
                path.unlink()
        if not keep:
            directory.rmdir()
        raise


def find_newest_dataset(root: Path, plant_name: str | None = None) -> Path | None:
    """Return the most recently finished dataset (of a plant) directly under ``root``, if any.

    Of those that we have numbered the number tells, whatever copying has made of their times.
    """
    found, latest = [], dict[str, int]()
    for name in files.list_names(root):  # sorted, numbers from low to high
        with contextlib.suppress(HjepaError, OSError):
            load_dataset(root / name, plant_name)
            time_ns = (root / name / MANIFEST).stat().st_mtime_ns
            if numbered := re.fullmatch(r"(.+)-\d{4,}", name):
                series = numbered[1]
                time_ns = latest[series] = max(time_ns, latest.get(series, 0))
            found.append((time_ns, name))
    return root / max(found)[1] if found else None


def per_shard(stored: bool) -> int:
    """Return how many trajectories a shard has, with stored frames or without."""
    return SHARD_TRAJECTORIES_WITH_FRAMES if stored else SHARD_TRAJECTORIES


def _plant(name: str, settings: Mapping[str, Any], where: Path) -> System:
    try:
        return plant_in(name, settings)
    except UsageError as error:
        raise DataError(f"{where}: {error.message}") from None


def _expected(
    count: int,
    steps: int,
    stored: bool,
    where: Path,
    kind: System,
    frame_shape: tuple[int, int, int],
) -> arrays.Shapes:
    """Return the tensors of :class:`Trajectories` for ``count`` trajectories of ``steps``."""
    if count < 1 or steps < 1:
        raise DataError(f"{where} holds {count} trajectories of {steps} steps; at least 1 of each")
    forces = (count, steps, *kind.action_shape)
    expected: dict[str, tuple[str, tuple[int, ...]]] = {
        "states": ("float32", (count, steps + 1, len(kind.state_names))),
        "applied_n": ("float32", forces),
        "teacher_n": ("float32", forces),
    }
    if stored:
        expected["frames"] = ("uint8", (count, steps + 1, *frame_shape))
    return expected
