"""A dataset in the making has shards that are done, so that collecting goes on after a stop.

``collecting.jsonl`` lies beside the shards until ``dataset.json`` replaces it. Its first line says
what is collected, each other line describes a finished shard. A shard counts only if it is the
file that its line describes, bit for bit; that it exists proves nothing.
"""

import dataclasses
import hashlib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.storage import files, seals

LOG = "collecting.jsonl"
SCHEMA = 2  # of its first line; 1, or none, had no seal
NAME = re.compile(r"shard-\d{5,9}\.safetensors")

Described = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Shard:
    """It holds trajectories ``start`` … ``stop`` − 1 of a split, in one file."""

    number: int
    split: str
    start: int
    stop: int

    @property
    def name(self) -> str:
        """Return the name of the file."""
        return f"shard-{self.number:05d}.safetensors"


def cut(sizes: Mapping[str, int], trajectories: int) -> list[Shard]:
    """Cut splits of ``sizes`` trajectories into shards of at most ``trajectories``."""
    starts = ((split, start) for split in sizes for start in range(0, sizes[split], trajectories))
    return [
        Shard(number, split, start, min(start + trajectories, sizes[split]))
        for number, (split, start) in enumerate(starts)
    ]


class ShardLog:
    """It logs the shards in ``directory``, which is locked for this process.

    ``task``, plain JSON data, says what is collected; a log that is there keeps its own. ``done``
    has what :meth:`add` was given, by name, of the finished shards whose files are intact.

    Raises:
        DataError: the log is damaged, or of a newer schema.
        StorageError: the disk refused.
    """

    def __init__(self, directory: Path, task: Mapping[str, Any]) -> None:
        self._path = directory / LOG
        self.done: dict[str, Described] = {}
        if not self._path.exists():  # written at once: it never lacks its first line
            files.write_bytes(self._path, _line(seals.sealed({**task, "schema": SCHEMA})))
            return
        read_task(directory)
        first, *lines = files.read_bytes(self._path).split(b"\n")
        for line in lines[:-1]:  # a kill may have cut the last one
            try:
                described = files.parse_json(line)
                name, digest = described["name"], described["sha256"]
                path = directory / name
                if not NAME.fullmatch(name) or not path.is_file():
                    continue
                if hashlib.sha256(files.read_bytes(path)).hexdigest() == digest:
                    self.done[name] = described
            except (ValueError, KeyError, TypeError, HjepaError):
                continue  # collected again
        files.write_bytes(self._path, first + b"\n" + b"".join(map(_line, self.done.values())))

    def add(self, described: Described) -> None:
        """Record a finished shard: ``name``, ``sha256`` and whatever else the manifest needs."""
        files.append(self._path, _line(described), durable=True)
        self.done[described["name"]] = described


def check_room(directory: Path, size_bytes: int) -> None:
    """Raise StorageError if the disk cannot hold what a dataset of that size still lacks."""
    there = (path for path in directory.iterdir() if NAME.fullmatch(path.name))
    files.check_free_space(directory, size_bytes - sum(path.stat().st_size for path in there))


def remove_log(directory: Path) -> None:
    """Delete the progress log once the manifest exists. Raises StorageError."""
    with files.writing(directory / LOG):
        (directory / LOG).unlink(missing_ok=True)


def read_task(directory: Path) -> dict[str, Any]:
    """Return what is being collected in ``directory``; DataError where its log is damaged."""
    path = directory / LOG
    again = f"delete {directory} to collect again, or choose another --out DIR"
    data = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES)
    try:
        first = files.parse_json(data.split(b"\n")[0])
    except ValueError as error:
        raise DataError(f"{path} is damaged: {error}", hint=again) from None
    task = seals.verified(first, SCHEMA, path, again)
    if seals.SEAL not in task:
        seals.warn(path)
    return {key: task[key] for key in task if key not in ("schema", seals.SEAL)}


def _line(value: Mapping[str, Any]) -> bytes:
    return files.canonical_json(value).encode() + b"\n"
