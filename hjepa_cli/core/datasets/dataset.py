"""Datasets: trajectories of one plant in safetensors shards, described by ``dataset.json``.

``dataset.json`` is written last and names every shard with its sha256, so a directory is a
dataset only when it is complete. No time, host or path is stored: equal inputs, equal bytes.
"""

import contextlib
import dataclasses
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    MissingInputError,
    NumericalError,
    UsageError,
)
from hjepa_cli.storage import files
from hjepa_cli.storage import tensors as arrays
from hjepa_cli.storage.shards import LOG, Described, Shard, cut
from hjepa_cli.storage.shards import NAME as SHARD_NAME

SCHEMA = 1
FORMAT = "hjepa-dataset"
MANIFEST = "dataset.json"
SPLITS = ("train", "test", "clean")
SHARD_TRAJECTORIES = 1000
SHARD_TRAJECTORIES_WITH_FRAMES = 50  # about 120 MB


@dataclasses.dataclass(frozen=True)
class Trajectories:
    """N trajectories of T steps; index 0 of states and frames is the frame before k = 0.

    The state at step k is ``states[:, k + 1]``.

    Args:
        states: float32 [N, T + 1, S], the plant's states; of a cart-pole x (m), x_dot (m/s), theta
            (rad), theta_dot (rad/s).
        applied_n: float32 [N, T, *A], the force or forces applied at step k (N).
        teacher_n: float32 [N, T, *A], the teacher's for the state at step k (N).
        frames: uint8 [N, T + 1, 64, 128, 3], or ``None`` if they are rendered on load.
    """

    states: np.ndarray
    applied_n: np.ndarray
    teacher_n: np.ndarray
    frames: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.applied_n)

    @property
    def steps(self) -> int:
        """T, the number of control steps of each trajectory."""
        return int(self.applied_n.shape[1])

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the arrays by name, without absent frames."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {name: array for name, array in named.items() if array is not None}

    def __getitem__(self, rows: slice) -> "Trajectories":
        return Trajectories(**{name: array[rows] for name, array in self.tensors().items()})


@dataclasses.dataclass(frozen=True)
class Dataset:
    """An opened dataset directory; shards are read and verified by :meth:`split`."""

    path: Path
    plant: str
    settings: dict[str, Any]
    camera: dict[str, Any]
    digest: str
    frames: str
    splits: dict[str, Any]

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

    def _read_shard(self, shard: Mapping[str, Any], steps: int) -> dict[str, np.ndarray]:
        path = self.path / shard["name"]
        stored = self.frames == "stored"
        expected = _expected(shard["trajectories"], steps, stored, path, self.plant)
        data = files.read_bytes(path, limit=_largest_bytes(expected))
        if hashlib.sha256(data).hexdigest() != shard["sha256"]:
            raise DataError(
                f"{path} was changed or truncated after it was written: its sha256 does not match",
                hint="collect the dataset again: hjepa collect",
            )
        tensors, _ = arrays.unpack(data, path)
        _check(tensors, expected, path)
        if bad := _not_finite(tensors):
            raise DataError(f"{path}: '{bad}' holds NaN or an infinity")
        return tensors


def write_dataset(
    directory: Path,
    *,
    settings: Mapping[str, Any],
    splits: Mapping[str, Trajectories],
    plant_name: str,
    camera_manifest: Mapping[str, Any],
) -> Dataset:
    """Write the splits into ``directory`` (see :func:`open_directory`), ``dataset.json`` last.

    Args:
        directory: an existing directory without a dataset.
        settings: what the data was made with, including ``seed``; plain JSON data.
        splits: ``train``, ``test`` and ``clean``; all with frames, or none.
        plant_name: the plant the trajectories come from.
        camera_manifest: the renderer's version, colours and sizes.

    Raises:
        DataError: wrong shapes or dtypes.
        NumericalError: values that are not finite; they are not written.
        UsageError: there is a dataset in ``directory`` already.
        StorageError: the disk refused; no dataset is left behind.
    """
    if (directory / MANIFEST).exists():
        raise UsageError(f"{directory} holds a dataset already", hint="choose another --out DIR")
    _remove_shards(directory)
    stored = any(split.frames is not None for split in splits.values())
    for name, split in splits.items():
        where = directory / name
        expected = _expected(len(split), split.steps, stored, where, plant_name)
        _check(split.tensors(), expected, where)
    done = [
        write_shard(directory, shard, splits[shard.split][shard.start : shard.stop], plant_name)
        for shard in cut({name: len(split) for name, split in splits.items()}, per_shard(stored))
    ]
    return write_manifest(
        directory,
        settings=settings,
        shards=done,
        plant_name=plant_name,
        camera_manifest=camera_manifest,
    )


def write_shard(
    directory: Path, shard: Shard, trajectories: Trajectories, plant_name: str
) -> Described:
    """Write one shard and return how the manifest will describe it.

    Raises:
        DataError: wrong shapes or dtypes.
        NumericalError: values that are not finite; they are not written.
        StorageError: the disk refused.
    """
    stored = trajectories.frames is not None
    path = directory / shard.name
    expected = _expected(len(trajectories), trajectories.steps, stored, path, plant_name)
    _check(trajectories.tensors(), expected, path)
    if bad := _not_finite(trajectories.tensors()):
        row, index, *_ = np.argwhere(~np.isfinite(trajectories.tensors()[bad]))[0]
        raise NumericalError(
            f"trajectory {shard.start + row} of split '{shard.split}': '{bad}' is not finite from "
            f"index {index} on",
            hint="--config FILE.toml with smaller forces or starts in [collect]",
        )
    data = arrays.pack(trajectories.tensors())
    files.write_bytes(path, data)
    return {
        "name": shard.name,
        "split": shard.split,
        "trajectories": len(trajectories),
        "steps": trajectories.steps,
        "stored": stored,
        "sha256": hashlib.sha256(data).hexdigest(),
    }


def write_manifest(
    directory: Path,
    *,
    settings: Mapping[str, Any],
    shards: Sequence[Described],
    plant_name: str,
    camera_manifest: Mapping[str, Any],
) -> Dataset:
    """Write ``dataset.json``, which makes the written shards a dataset.

    Args:
        directory: where the shards are.
        settings, plant_name, camera_manifest: as for :func:`write_dataset`.
        shards: what :func:`write_shard` returned, in the order of their numbers.
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
        "sha256": "",
        "plant": plant_name,
        "seed": settings.get("seed"),
        "config": dict(settings),
        "camera": dict(camera_manifest),
        "frames": "stored" if stored else "rendered",
        "splits": described,
    }
    manifest["sha256"] = arrays.content_digest(manifest, {})
    files.write_json(directory / MANIFEST, manifest)
    return load_dataset(directory)


def load_dataset(path: Path, plant_name: str | None = None) -> Dataset:
    """Open a dataset directory and verify its manifest.

    Args:
        path: the directory.
        plant_name: refuse a dataset of any other plant.

    Raises:
        MissingInputError: no such directory.
        DataError: not a dataset, changed, of a newer schema, or of another plant.
    """
    if not path.exists():
        raise MissingInputError(f"dataset {path} does not exist", hint="hjepa collect")
    if not (path / MANIFEST).is_file():
        raise DataError(f"{path} is not an hjepa dataset: no {MANIFEST}", hint="hjepa collect")
    manifest = files.read_json(path / MANIFEST)
    if manifest.get("format") != FORMAT:
        raise DataError(f"{path} is not an hjepa dataset: its {MANIFEST} is of another program")
    files.check_schema(manifest.get("schema"), SCHEMA, f"dataset {path}")
    digest = arrays.content_digest({**manifest, "sha256": ""}, {})
    if manifest.get("sha256") != digest:
        raise DataError(
            f"{path / MANIFEST} was changed after it was written: its sha256 does not match",
            hint="collect the dataset again: hjepa collect",
        )
    _check_manifest(manifest, path)
    if plant_name is not None and manifest["plant"] != plant_name:
        raise DataError(
            f"dataset {path} belongs to plant {manifest['plant']}, not {plant_name}",
            hint=f"hjepa collect with a preset of plant {plant_name}",
        )
    return Dataset(
        path=path,
        plant=manifest["plant"],
        settings=manifest["config"],
        camera=manifest["camera"],
        digest=digest,
        frames=manifest["frames"],
        splits=manifest["splits"],
    )


@contextlib.contextmanager
def open_directory(out: Path | None, plant_name: str, root: Path = Path("data")) -> Iterator[Path]:
    """Create and lock the directory for a new dataset: ``out``, else ``data/<plant>-<nnnn>``.

    If it holds a dataset already it is yielded as it is: check for ``dataset.json``.

    Raises:
        UsageError: ``out`` holds files that are not ours.
        LockedError: another process collects into it.
        StorageError: not writable.
    """
    if out is None:
        directory = files.next_directory(root, f"{plant_name}-")
    else:
        directory = out
        files.make_directory(directory)
        _refuse_foreign(directory)
    with files.lock_directory(directory):
        yield directory


def find_newest_dataset(root: Path, plant_name: str | None = None) -> Path | None:
    """Return the most recently finished dataset (of a plant) directly under ``root``, if any."""
    found = []
    for name in files.list_names(root):
        with contextlib.suppress(HjepaError, OSError):
            load_dataset(root / name, plant_name)
            found.append(((root / name / MANIFEST).stat().st_mtime_ns, name))
    return root / max(found)[1] if found else None


def per_shard(stored: bool) -> int:
    """Trajectories of a shard, with stored frames or without."""
    return SHARD_TRAJECTORIES_WITH_FRAMES if stored else SHARD_TRAJECTORIES


Shapes = Mapping[str, tuple[str, tuple[int, ...]]]
"""Names of tensors with dtype and shape."""


def _expected(count: int, steps: int, stored: bool, where: Path, plant_name: str) -> Shapes:
    """The tensors of :class:`Trajectories` for ``count`` trajectories of ``steps``."""
    try:
        kind = plant(plant_name)
    except UsageError as error:
        raise DataError(f"{where}: {error.message}") from None
    if count < 1 or steps < 1:
        raise DataError(f"{where} holds {count} trajectories of {steps} steps; at least 1 of each")
    forces = (count, steps, *kind.action_shape)
    expected: dict[str, tuple[str, tuple[int, ...]]] = {
        "states": ("float32", (count, steps + 1, len(kind.state_names))),
        "applied_n": ("float32", forces),
        "teacher_n": ("float32", forces),
    }
    if stored:
        expected["frames"] = ("uint8", (count, steps + 1, *FRAME_SHAPE))
    return expected


def _largest_bytes(expected: Shapes) -> int:
    """What a shard may take on disk; more is not even read."""
    values = sum(np.dtype(name).itemsize * math.prod(shape) for name, shape in expected.values())
    return values + arrays.HEADER_LIMIT_BYTES + 8


def _check(tensors: Mapping[str, np.ndarray], expected: Shapes, where: Path) -> None:
    """Demand these tensors and no others."""
    if tensors.keys() != expected.keys():
        raise DataError(f"{where} holds {sorted(tensors)}; expected {sorted(expected)}")
    for name, (dtype, shape) in expected.items():
        array = tensors[name]
        if (array.dtype.name, array.shape) != (dtype, shape):
            raise DataError(
                f"{where}: '{name}' is {array.dtype.name} {array.shape}; expected {dtype} {shape}"
            )


def _not_finite(tensors: Mapping[str, np.ndarray]) -> str | None:
    return arrays.non_finite({key: tensors[key] for key in tensors if key != "frames"})


def _check_manifest(manifest: Mapping[str, Any], path: Path) -> None:
    """Check what :class:`Dataset` relies on; shard names must not leave the directory."""
    try:
        good = (
            isinstance(manifest["plant"], str)
            and isinstance(manifest["config"], dict)
            and isinstance(manifest["config"].get("collect", {}), dict)
            and isinstance(manifest["camera"], dict)
            and manifest["frames"] in ("stored", "rendered")
            and 0 < len(manifest["splits"].keys() & set(SPLITS)) == len(manifest["splits"])
            and all(
                type(split["steps"]) is int
                and len(split["shards"]) > 0
                and all(SHARD_NAME.fullmatch(shard["name"]) for shard in split["shards"])
                and all(type(shard["trajectories"]) is int for shard in split["shards"])
                and all(isinstance(shard["sha256"], str) for shard in split["shards"])
                and split["trajectories"] == sum(n["trajectories"] for n in split["shards"])
                and type(split["trajectories"]) is int
                for split in manifest["splits"].values()
            )
        )
    except (KeyError, TypeError, AttributeError):
        good = False
    if not good:
        raise DataError(f"{path / MANIFEST} lacks fields or has malformed ones")


def _refuse_foreign(directory: Path) -> None:
    entries = files.list_names(directory)
    if MANIFEST in entries:
        load_dataset(directory)  # a foreign or damaged dataset.json says so itself
        return
    for name in entries:
        ours = name in (files.LOCK_FILE, LOG) or SHARD_NAME.fullmatch(name)
        if not ours and not files.is_temporary(name):
            raise UsageError(
                f"{directory} is not empty and not an hjepa dataset: it holds '{name}'",
                hint="choose a new or empty directory with --out DIR",
            )


def _remove_shards(directory: Path) -> None:
    """Delete the shards of a collection that was interrupted before its manifest."""
    for name in files.list_names(directory):
        if SHARD_NAME.fullmatch(name):
            try:
                (directory / name).unlink()
            except OSError as error:
                raise files.storage_error(directory / name, error) from None
