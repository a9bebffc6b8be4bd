"""A dataset in the making: shards that are done, so that a collection is taken up after a stop.

``collecting.jsonl`` lies beside the shards until ``dataset.json`` replaces it. Its first line says
what is collected, each other line describes a finished shard. A shard counts only if it is the
file that its line describes, bit for bit; that it exists proves nothing.
"""

import dataclasses
import hashlib
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.storage import files

LOG = "collecting.jsonl"
SCHEMA = 1  # of its first line; none was written there at first, which is 1 too
NAME = re.compile(r"shard-\d{5,9}\.safetensors")

Described = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Shard:
    """Trajectories ``start`` … ``stop`` − 1 of a split, in one file."""

    number: int
    split: str
    start: int
    stop: int

    @property
    def name(self) -> str:
        """The file's name."""
        return f"shard-{self.number:05d}.safetensors"


def cut(sizes: Mapping[str, int], trajectories: int) -> list[Shard]:
    """Cut splits of ``sizes`` trajectories into shards of at most ``trajectories``."""
    shards: list[Shard] = []
    for split, size in sizes.items():
        for start in range(0, size, trajectories):
            stop = min(start + trajectories, size)
            shards.append(Shard(len(shards), split, start, stop))
    return shards


class ShardLog:
    """The log of the shards in ``directory``.

    Args:
        directory: locked for this process.
        task: what is collected, plain JSON data; a log that is there keeps its own: see
            :func:`read_task`.

    Attributes:
        done: finished shards by name, as :meth:`add` was told; their files are intact.

    Raises:
        DataError: the log is damaged, or of a newer schema.
        StorageError: the disk refused.
    """

    def __init__(self, directory: Path, task: Mapping[str, Any]) -> None:
        self._path = directory / LOG
        self.done: dict[str, Described] = {}
        if not self._path.exists():  # written at once: it never lacks its first line
            files.write_bytes(self._path, _line({"schema": SCHEMA, **task}))
            return
        read_task(directory)
        first, *lines = files.read_bytes(self._path).split(b"\n")
        for line in lines[:-1]:  # a kill may have cut the last one
            try:
                described = files.parse_json(line)
                name, digest = described["name"], described["sha256"]
                if NAME.fullmatch(name) and _intact(directory / name, digest):
                    self.done[described["name"]] = described
            except (ValueError, KeyError, TypeError, HjepaError):
                continue  # collected again
        files.write_bytes(self._path, first + b"\n" + b"".join(map(_line, self.done.values())))

    def add(self, described: Described) -> None:
        """Record a finished shard: ``name``, ``sha256`` and whatever else the manifest needs."""
        try:
            with open(self._path, "ab") as file:
                file.write(_line(described))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise files.storage_error(self._path, error) from None
        self.done[described["name"]] = described


def remove_log(directory: Path) -> None:
    """The dataset is complete, if it was not so before. Raises StorageError."""
    path = directory / LOG
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise files.storage_error(path, error) from None


def read_task(directory: Path) -> dict[str, Any]:
    """Return what is being collected in ``directory``.

    Raises:
        DataError: the log is damaged, or of a newer schema.
    """
    path = directory / LOG
    data = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES)
    try:
        task = {"schema": SCHEMA, **files.parse_json(data.split(b"\n")[0])}
    except ValueError as error:
        raise DataError(
            f"{path} is damaged: {error}",
            hint=f"delete {directory} to collect again, or choose another --out DIR",
        ) from None
    files.check_schema(task.pop("schema"), SCHEMA, f"unfinished dataset {directory}")
    return task


def _line(value: Mapping[str, Any]) -> bytes:
    return files.canonical_json(value).encode() + b"\n"


def _intact(path: Path, digest: str) -> bool:
    return path.is_file() and hashlib.sha256(files.read_bytes(path)).hexdigest() == digest
