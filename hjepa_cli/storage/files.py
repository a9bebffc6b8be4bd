"""One way to put files on disk: complete and durable, or not at all.

A file is written under a temporary name beside its target, flushed to the disk and then renamed,
so a crash, a kill or a full disk leaves either the old file or the new one. The same directory
helpers serve run directories and datasets.
"""

import contextlib
import errno
import fcntl
import io
import json
import math
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from hjepa_cli.errors import (
    DataError,
    HjepaError,
    LockedError,
    MissingInputError,
    StorageError,
)

LOCK_FILE = ".lock"
JSON_LIMIT_BYTES = 16 * 2**20

_TEMPORARY = re.compile(r"\..+\.(\d+)\.tmp")  # .<name>.<random>.<pid>.tmp
_HOLDER = re.compile(rb"process \d{1,20} on [\w.-]{1,64}")
_NO_SPACE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_AGAIN = "run the same command again"


def write_bytes(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data`` atomically; its mode follows the umask.

    Raises:
        StorageError: the disk refused; ``path`` is what it was before.
    """
    # Workers in containers have equal pids, and two may write the same shard at the same time.
    unique = f"{secrets.token_hex(4)}.{os.getpid()}"
    temporary = path.with_name(f".{path.name}.{unique}.tmp")
    try:
        with open(temporary, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_directory(path.parent)
    except OSError as error:
        raise storage_error(path, error) from None
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by UTF-8 ``text`` atomically. Raises StorageError."""
    write_bytes(path, text.encode("utf-8"))


def write_json(path: Path, value: Any) -> None:
    """Replace ``path`` by readable JSON with sorted keys, atomically; NaN is a ValueError."""
    text = json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False, indent=2)
    write_text(path, text + "\n")


def canonical_json(value: Any) -> str:
    """Return the one JSON text of ``value``: sorted keys, no spaces, no NaN (ValueError)."""
    return json.dumps(
        value, sort_keys=True, allow_nan=False, ensure_ascii=False, separators=(",", ":")
    )


def parse_json(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object strictly: no NaN, no duplicate keys. Raises ValueError."""
    try:
        value = json.loads(text, object_pairs_hook=_unique_keys)
        canonical_json(value).encode()  # refuses NaN, infinities and lone surrogates
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return value


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of at most :data:`JSON_LIMIT_BYTES`.

    Raises:
        MissingInputError: no such file.
        DataError: too large, or not a strict JSON object.
        StorageError: the disk refused.
    """
    data = read_bytes(path, limit=JSON_LIMIT_BYTES)
    try:
        return parse_json(data)
    except ValueError as error:
        raise DataError(f"{path} is not valid JSON: {error}") from None


def check_schema(found: object, newest: int, what: str) -> None:
    """Demand the schema version this program writes. Raises DataError naming ``what``."""
    if type(found) is int and found > newest:
        raise DataError(
            f"{what} has schema {found}; this hjepa reads up to {newest}",
            hint="pip install --upgrade hjepa",
        )
    if type(found) is not int or found != newest:
        raise DataError(f"{what} has schema {found!r}; expected {newest}")


def read_bytes(path: Path, *, limit: int | None = None) -> bytes:
    """Read a whole file, refusing more than ``limit`` bytes.

    Raises:
        MissingInputError: no such file.
        DataError: larger than ``limit``, or not a regular file.
        StorageError: the disk refused.
    """
    try:
        if not path.is_file():
            if path.exists():
                raise DataError(f"{path} is not a regular file")
            raise MissingInputError(f"{path} does not exist")
        size = path.stat().st_size
        if limit is not None and size > limit:
            raise DataError(f"{path} is too large: {size} bytes, at most {limit} are accepted")
        return path.read_bytes()
    except OSError as error:
        raise StorageError(f"cannot read {path}: {error.strerror or error}") from None


def make_durable(path: Path) -> None:
    """Flush to the disk what was appended to ``path``, if it is there. Raises StorageError."""
    try:
        with open(path, "rb") as file:
            os.fsync(file.fileno())
        _sync_directory(path.parent)
    except FileNotFoundError:
        return
    except OSError as error:
        raise storage_error(path, error) from None


def jsonable(value: Any) -> Any:
    """Return ``value`` as plain JSON data: numpy becomes lists, undefined numbers become null."""
    if isinstance(value, Mapping):
        return {str(key): jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    if hasattr(value, "tolist"):
        return jsonable(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value


def make_directory(path: Path) -> None:
    """Create ``path`` and its parents if needed. Raises StorageError."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(path, error) from None


def next_directory(parent: Path, prefix: str = "") -> Path:
    """Create ``parent/<prefix>0001``, or the number after the highest. Raises StorageError."""
    make_directory(parent)
    pattern = re.compile(re.escape(prefix) + r"(\d{4,})")
    number = max((int(m[1]) for m in map(pattern.fullmatch, list_names(parent)) if m), default=0)
    while True:
        number += 1
        directory = parent / f"{prefix}{number:04d}"
        try:
            directory.mkdir()
            return directory
        except FileExistsError:
            continue  # another process took this number in between
        except OSError as error:
            raise storage_error(directory, error) from None


def list_names(directory: Path) -> list[str]:
    """Return the sorted names in ``directory``; none if it is not there. Raises StorageError."""
    try:
        return sorted(os.listdir(directory))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"cannot read {directory}: {error.strerror or error}") from None


class _Lock(io.FileIO):
    """A lock file that says who holds it, and nothing any more once it is given back.

    What a directory holds in the end must not depend on who made it.
    """

    held = False

    def close(self) -> None:
        if self.held and not self.closed:
            with contextlib.suppress(OSError):
                self.truncate(0)
        super().close()


def lock_directory(directory: Path) -> IO[bytes]:
    """Take ``directory`` for this process alone, until the returned file is closed.

    Also proves that the directory is writable and sweeps temporaries of processes that died. The
    lock is the kernel's and ends with its holder; the text in the file is for people.

    Raises:
        LockedError: another process holds it.
        StorageError: not writable.
    """
    try:
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW  # never write to where a link leads
        file = _Lock(os.open(directory / LOCK_FILE, flags, 0o666), "r+")
    except OSError as error:
        raise storage_error(directory, error) from None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        found = _HOLDER.fullmatch(file.read(100) or b"")
        file.close()
        raise LockedError(
            f"another process is working in {directory}"
            + (f": {found[0].decode()}" if found else ""),
            hint="wait until it has ended, or choose another place with --out DIR",
        ) from None
    except OSError as error:
        file.close()
        raise storage_error(directory, error) from None
    file.held = True
    with contextlib.suppress(OSError):  # a full disk does not unlock the directory
        file.truncate(0)  # what a killed holder has left
        file.write(f"process {os.getpid()} on {platform.node()}".encode())
    sweep_temporaries(directory)
    return file


@contextlib.contextmanager
def taking_turns(directory: Path) -> Iterator[None]:
    """Let one process after the other add to a file in ``directory``. Raises StorageError."""
    try:
        handle = os.open(directory, os.O_RDONLY)
    except OSError as error:
        raise storage_error(directory, error) from None
    try:
        with contextlib.suppress(OSError):  # some network disks lock no directories
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def sweep_temporaries(directory: Path) -> None:
    """Delete what killed writers left behind: temporaries whose process is gone."""
    for name in list_names(directory):
        match = _TEMPORARY.fullmatch(name)
        if match and not _writing(int(match[1])):
            with contextlib.suppress(OSError):
                (directory / name).unlink()


def is_temporary(name: str) -> bool:
    """Tell whether ``name`` is a half-written file of :func:`write_bytes`."""
    return _TEMPORARY.fullmatch(name) is not None


def storage_error(path: Path, error: OSError) -> StorageError:
    """Turn an OSError on ``path`` into one line with the next step."""
    if error.errno in _NO_SPACE:
        hint = f"free some disk space, then {_AGAIN}"
    else:
        hint = "choose a directory that you may write to with --out DIR"
    return StorageError(f"cannot write {path}: {error.strerror or error}", hint=hint)


def check_free_space(directory: Path, size_bytes: int) -> None:
    """Refuse to begin what the disk cannot hold. Raises StorageError."""
    free_bytes = shutil.disk_usage(directory).free
    if free_bytes < size_bytes:
        raise StorageError(
            f"{directory} has {free_bytes / 1e6:,.1f} MB free; {size_bytes / 1e6:,.1f} are needed",
            hint="free some disk space, or choose another disk with --out DIR",
        )


def point_to(command: str, error: BaseException | None) -> None:
    """Let a hint to repeat the command name the one that goes on: without --out, the same one
    begins again in a new directory.
    """
    if isinstance(error, HjepaError) and (error.hint or "").endswith(_AGAIN):
        error.hint = f"{(error.hint or '').removesuffix(_AGAIN)}{command}"


def _writing(pid: int) -> bool:
    if pid == os.getpid():
        return False  # our own writes are never open while a directory is being opened
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _sync_directory(directory: Path) -> None:
    """Make a rename durable: the new name is an entry of the directory, not of the file."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = dict(pairs)
    if len(keys) != len(pairs):
        raise ValueError("duplicate keys")
    return keys
