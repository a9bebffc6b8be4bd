"""Files are put on disk complete and durable, or not at all.

A file is written under a temporary name beside its target, flushed to the disk and then renamed,
so a crash, a kill or a full disk leaves either the old file or the new one. The same directory
helpers serve run directories and datasets.
"""

import contextlib
import errno
import fcntl
import io
import itertools
import json
import os
import platform
import re
import secrets
import shutil
import stat
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any

import msgspec

from hjepa_cli import errors
from hjepa_cli.errors import DataError, MissingInputError, StorageError

LOCK_FILE = ".lock"
JSON_LIMIT_BYTES = 16 * 2**20
TEMPORARY = re.compile(r"\..+\.(\d+)\.tmp")  # .<name>.<random>.<pid>.tmp: a half-written file

_HOLDER = re.compile(rb"process \d{1,20} on [\w.-]{1,64}")
_AGAIN = "run the same command again"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Replace ``path`` atomically by what is written inside; mode by the umask; else StorageError.

    An error inside leaves the old file.
    """
    _refuse_special(path)
    temporary = _temporary(path)
    try:
        with writing(path):
            _check_held(path.parent)
            with open(temporary, "wb") as file:
                yield file
                file.flush()
                _sync(file.fileno())
            _check_held(path.parent)
            os.replace(temporary, path)
            _sync_directory(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def write_bytes(path: Path, data: bytes) -> None:
    """Replace ``path`` by ``data`` atomically, with a mode by the umask; else StorageError."""
    with replacing(path) as file:
        file.write(data)


def create_private(path: Path, data: bytes) -> None:
    """Make ``path``, which its owner alone may read, with all of ``data`` in it, or not at all.

    What is there already stays, with a StorageError, as where the disk refuses.
    """
    temporary = _temporary(path)
    try:
        with writing(path):
            handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with open(handle, "wb") as file:
                file.write(data)
                file.flush()
                _sync(file.fileno())
            os.link(temporary, path)  # unlike a rename it replaces nothing
            temporary.unlink()
            _sync_directory(path.parent)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _temporary(path: Path) -> Path:
    # Workers in containers have equal pids, and two may write the same shard at the same time.
    unique = f"{secrets.token_hex(4)}.{os.getpid()}"
    return path.with_name(f".{path.name}.{unique}.tmp")


def append(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Add ``data`` to ``path``, flushed to the disk if ``durable``; else StorageError."""
    with writing(path):
        _check_held(path.parent)
        with open(path, "ab") as file:
            file.write(data)
            file.flush()
            if durable:
                _sync(file.fileno())


def target(path: Path) -> Path:
    """Return where to write a file that a person named: where links lead; its directory is made.

    What a directory of ours holds is written with :func:`write_bytes` alone, which follows no link.

    Raises:
        StorageError: it is a device, a pipe, a socket or a circle of links.
    """
    path = Path(os.path.realpath(path)) if path.is_symlink() else path
    _refuse_special(path, _SPECIAL | {stat.S_IFLNK: "a circle of links"})
    make_directory(path.parent)
    return path


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by UTF-8 ``text`` atomically; else StorageError."""
    write_bytes(path, encoded(text))


def write_json(path: Path, value: Any) -> None:
    """Replace ``path`` by readable JSON with sorted keys, atomically; NaN is a ValueError."""
    write_text(path, _dumps(value, indent=2) + "\n")


def canonical_json(value: Any) -> str:
    """Return the one JSON text of ``value``: sorted keys, no spaces, no NaN (ValueError)."""
    return _dumps(value, separators=(",", ":"))


def encoded(text: str) -> bytes:
    """Return UTF-8; bytes of a path that are none are escapes, which JSON reads back."""
    return text.encode(errors="backslashreplace")


def _dumps(value: Any, **layout: Any) -> str:
    text = json.dumps(value, sort_keys=True, allow_nan=False, ensure_ascii=False, **layout)
    return encoded(text).decode()


def parse_json(text: str | bytes) -> dict[str, Any]:
    """Parse a JSON object strictly: a NaN or a duplicate key is a ValueError."""
    try:
        value = json.loads(text, object_pairs_hook=_unique_keys)
        text = json.dumps(value, allow_nan=False, ensure_ascii=False)  # no NaN, no infinity
        text.encode(errors="surrogateescape")  # no lone surrogates, but bytes of a path
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(value, dict):
        raise ValueError("not a JSON object")
    return value


def read_json(path: Path) -> dict[str, Any]:
    """Read a strict JSON object of at most :data:`JSON_LIMIT_BYTES`; errors as of read_bytes."""
    try:
        return parse_json(read_bytes(path, limit=JSON_LIMIT_BYTES))
    except ValueError as error:
        raise DataError(f"{path} is not valid JSON: {error}") from None


def check_schema(found: object, newest: int, what: str) -> None:
    """Raise DataError, naming ``what``, for a schema version other than ``newest``."""
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
    with reading(path):
        if not path.is_file():
            if path.exists():
                raise DataError(f"{path} is not a regular file")
            raise MissingInputError(f"{path} does not exist")
        size = path.stat().st_size
        if limit is not None and size > limit:
            raise DataError(f"{path} is too large: {size} bytes, at most {limit} are accepted")
        return path.read_bytes()


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn every OSError inside the ``with`` block into a StorageError."""
    try:
        yield
    except OSError as error:
        raise StorageError(f"cannot read {path}: {error.strerror or error}") from None


def make_durable(path: Path) -> None:
    """Flush to the disk what was appended to ``path``, if it is there."""
    with writing(path), contextlib.suppress(FileNotFoundError):
        with open(path, "rb") as file:
            _sync(file.fileno())
        _sync_directory(path.parent)


def jsonable(value: Any) -> Any:
    """Return ``value`` as plain JSON data: numpy becomes lists, undefined numbers become null."""
    try:
        return msgspec.json.decode(msgspec.json.encode(value, enc_hook=_plain))
    except UnicodeEncodeError:  # a path that is not UTF-8
        text = json.dumps(msgspec.to_builtins(value, enc_hook=_plain, str_keys=True))
        return json.loads(text, parse_constant=lambda name: None)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return os.fspath(value) if isinstance(value, os.PathLike) else value.tolist()


def make_directory(path: Path) -> None:
    """Create ``path`` and its parents if needed."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


def next_directory(parent: Path, prefix: str = "") -> Path:
    """Create ``parent/<prefix>0001``, or the number after the highest."""
    make_directory(parent)
    pattern = re.compile(re.escape(prefix) + r"(\d{4,})")
    last = max((int(m[1]) for m in map(pattern.fullmatch, list_names(parent)) if m), default=0)
    for number in itertools.count(last + 1):  # another process may take one in between
        directory = parent / f"{prefix}{number:04d}"
        with writing(directory), contextlib.suppress(FileExistsError):
            directory.mkdir()
            break
    return directory


def list_names(directory: Path) -> list[str]:
    """Return the sorted names in ``directory``; none if it is not there."""
    try:
        return sorted(os.listdir(directory))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise StorageError(f"cannot read {directory}: {error.strerror or error}") from None


class _Lock(io.FileIO):
    """It says who holds it, and nothing once given back: directories do not show who made them."""

    _directory: str | None = None

    def hold(self, directory: Path) -> None:
        """Remember which directory this is, and keep its inode from being given to another."""
        self._directory, self._handle = os.path.abspath(directory), os.open(directory, os.O_RDONLY)
        _HELD[self._directory] = os.fstat(self._handle).st_ino, self._handle

    def close(self) -> None:
        if self._directory is not None and not self.closed:
            with contextlib.suppress(OSError):
                self.truncate(0)
            _HELD.pop(self._directory, None)
            os.close(self._handle)
        super().close()


# Directories that are locked here, with their inodes and handles, or for us: then without.
_HELD: dict[str, tuple[int, int | None]] = {}


def _check_held(directory: Path) -> None:
    """Raise StorageError where another directory is in the place of one that is locked here."""
    inode, handle = _HELD.get(os.path.abspath(directory), (None, None))
    if inode is None:
        return
    with contextlib.suppress(FileNotFoundError):
        if directory.stat().st_ino == inode:
            return
    hint = "put it back, then run the same command again"
    with contextlib.suppress(OSError):  # Linux knows where it is now
        now = os.readlink(f"/proc/self/fd/{handle}")
        hint = errors.shell(["hjepa", "resume", now])
        hint = "choose another place with --out DIR" if now.endswith(" (deleted)") else hint
    raise StorageError(
        f"{directory} is not the directory that this run began in: that was moved or deleted",
        hint=hint,
    )


def lock_directory(directory: Path) -> IO[bytes]:
    """Take ``directory`` for this process alone, until the returned file is closed.

    Also proves that the directory is writable and sweeps temporaries of processes that died. The
    lock is the kernel's and ends with its holder; the text in the file is for people. Until then
    nothing is written to another directory that comes to be in its place. Where the file system
    has no locks an :class:`~hjepa_cli.errors.Unlocked` warning says so.

    Raises:
        LockedError: another process holds it.
        StorageError: not writable.
    """
    with writing(directory):
        flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW  # never write to where a link leads
        file = _Lock(os.open(directory / LOCK_FILE, flags, 0o666), "r+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            with file:
                found = _HOLDER.fullmatch(file.read(100) or b"")
            raise errors.LockedError(
                f"another process is working in {directory}"
                + (f": {found[0].decode()}" if found else ""),
                hint="wait until it has ended, or choose another place with --out DIR",
            ) from None
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                file.close()
                raise
            warnings.warn(
                f"{directory} cannot be locked on this file system: run nothing else in it",
                errors.Unlocked,
                stacklevel=2,
            )
        file.hold(directory)
    with contextlib.suppress(OSError):  # a full disk does not unlock the directory
        file.truncate(0)  # what a killed holder has left
        file.write(f"process {os.getpid()} on {platform.node()}".encode())
    sweep_temporaries(directory)
    return file


def identity(directory: Path) -> tuple[str, int]:
    """Return what tells a directory from another that is put in its place, and to whom it does."""
    inode, _ = _HELD.get(os.path.abspath(directory), (None, None))  # once it was locked, for good
    return platform.node(), directory.stat().st_ino if inode is None else inode


@contextlib.contextmanager
def holding(directory: Path, which: tuple[str, int]) -> Iterator[None]:
    """Write to ``directory`` only while it is the one of this :func:`identity`, in a worker."""
    node, inode = which
    if node != platform.node():  # disks over a network may number files for each machine
        yield
        return
    before = _HELD.get(key := os.path.abspath(directory))
    _HELD[key] = before if before is not None and before[0] == inode else (inode, None)
    try:
        yield
    finally:
        _HELD.pop(key, None) if before is None else _HELD.update({key: before})


@contextlib.contextmanager
def taking_turns(directory: Path) -> Iterator[None]:
    """Let one process after the other add to a file in ``directory``."""
    with writing(directory):
        handle = os.open(directory, os.O_RDONLY)
    try:
        with contextlib.suppress(OSError):  # some network disks lock no directories
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def sweep_temporaries(directory: Path) -> None:
    """Delete what killed writers left behind: temporaries whose process is gone."""
    for name in list_names(directory):
        if match := TEMPORARY.fullmatch(name):
            try:
                if (pid := int(match[1])) != os.getpid():  # our own are never open meanwhile
                    os.kill(pid, 0)
                    continue
            except (ProcessLookupError, OverflowError):
                pass
            except PermissionError:
                continue
            with contextlib.suppress(OSError):
                (directory / name).unlink()


def refuse_foreign(directory: Path, kind: str, is_ours: Callable[[str], bool]) -> None:
    """Raise UsageError if a directory holds something that belongs to no ``kind`` of ours."""
    for name in list_names(directory):
        if name != LOCK_FILE and not TEMPORARY.fullmatch(name) and not is_ours(name):
            raise errors.UsageError(
                f"{directory} is not empty and not an hjepa {kind}: it holds '{name}'",
                hint="choose a new or empty directory with --out DIR",
            )


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn every OSError inside the ``with`` block into a StorageError: one line, the next step."""
    try:
        yield
    except OSError as error:
        hint = "choose a directory that you may write to with --out DIR"
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            hint = f"free some disk space, then {_AGAIN}"
        reason = error.strerror or error
        raise StorageError(f"cannot write {path}: {reason}", hint=hint) from None


def check_free_space(directory: Path, size_bytes: int) -> None:
    """Raise StorageError before the work if the disk cannot hold it."""
    free_bytes = shutil.disk_usage(directory).free
    if free_bytes < size_bytes:
        raise StorageError(
            f"{directory} has {free_bytes / 1e6:,.1f} MB free; {size_bytes / 1e6:,.1f} are needed",
            hint="free some disk space, or choose another disk with --out DIR",
        )


def point_to(command: str, error: BaseException | None) -> None:
    """Replace "run the same command again", which begins anew without --out, by what resumes."""
    if isinstance(error, errors.HjepaError) and (error.hint or "").endswith(_AGAIN):
        error.hint = f"{(error.hint or '').removesuffix(_AGAIN)}{command}"


_SPECIAL = {stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
_SPECIAL |= dict.fromkeys((stat.S_IFCHR, stat.S_IFBLK), "a device")


def _refuse_special(path: Path, kinds: Mapping[int, str] = _SPECIAL) -> None:
    """Raise StorageError for what is there and would be replaced, not filled."""
    with writing(path), contextlib.suppress(FileNotFoundError):
        if kind := kinds.get(stat.S_IFMT(path.lstat().st_mode)):
            raise StorageError(
                f"cannot write {path}: it is {kind}, not a regular file",
                hint="choose a regular file or a new one with --out FILE",
            )


# What file systems answer that have no locks, or cannot flush a directory.
_UNSUPPORTED = {errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.ENOSYS}


def _sync(handle: int) -> None:
    """Flush to the disk; some file systems do not have that, which is no reason to stop."""
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in _UNSUPPORTED:
            raise


def _sync_directory(directory: Path) -> None:
    """Make a rename durable: the new name is an entry of the directory, not of the file."""
    handle = os.open(directory, os.O_RDONLY)
    try:
        _sync(handle)
    finally:
        os.close(handle)


def _unique_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    if len(keys := dict(pairs)) != len(pairs):
        raise ValueError("duplicate keys")
    return keys
