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

from hjepa_cli.errors import DataError, HjepaError, UsageError
from hjepa_cli.storage import files

LOG = "collecting.jsonl"
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
        task: what is collected; plain JSON data.

    Attributes:
        done: finished shards by name, as :meth:`add` was told; their files are intact.

    Raises:
        UsageError: something else is being collected there.
    """

    def __init__(self, directory: Path, task: Mapping[str, Any]) -> None:
        self._path = directory / LOG
        self.done: dict[str, Described] = {}
        if not self._path.exists():
            self._write_line(dict(task))
            return
        if read_task(directory) != dict(task):
            raise UsageError(
                f"{directory} holds an unfinished dataset with other settings",
                hint=f"hjepa resume {directory} continues it; or choose another --out DIR",
            )
        lines = self._path.read_bytes().split(b"\n")[1:-1]  # a kill may have cut the last one
        for line in lines:
            try:
                described = files.parse_json(line)
                name, digest = described["name"], described["sha256"]
                if NAME.fullmatch(name) and _intact(directory / name, digest):
                    self.done[described["name"]] = described
            except (ValueError, KeyError, TypeError, HjepaError):
                continue  # collected again
        files.write_bytes(self._path, self._path.read_bytes().split(b"\n")[0] + b"\n")
        for described in self.done.values():
            self._write_line(described)

    def add(self, described: Described) -> None:
        """Record a finished shard: ``name``, ``sha256`` and whatever else the manifest needs."""
        self._write_line(described)
        self.done[described["name"]] = described

    def remove(self) -> None:
        """The dataset is complete."""
        self._path.unlink(missing_ok=True)

    def _write_line(self, value: Described) -> None:
        try:
            with open(self._path, "ab") as file:
                file.write(files.canonical_json(value).encode() + b"\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise files.storage_error(self._path, error) from None


def read_task(directory: Path) -> dict[str, Any]:
    """Return what is being collected in ``directory``. Raises DataError."""
    data = files.read_bytes(directory / LOG, limit=files.JSON_LIMIT_BYTES)
    try:
        return files.parse_json(data.split(b"\n")[0])
    except ValueError as error:
        raise DataError(f"{directory / LOG} is damaged: {error}") from None


def _intact(path: Path, digest: str) -> bool:
    return path.is_file() and hashlib.sha256(files.read_bytes(path)).hexdigest() == digest
