"""Directories that are moved while a run works in them, and file systems that lack something."""

import errno
import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, open_shell

from hjepa_cli.compute import executors
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.errors import NumericalError, StorageError, Unlocked
from hjepa_cli.stages import collect
from hjepa_cli.storage import files
from hjepa_cli.storage.runs import RESULT, Run

SETTINGS = load_settings("smoke")
SMALL = ("--preset", "smoke", "--trajectories", "3", "--test-trajectories", "2")


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


def test_a_run_whose_directory_was_moved_writes_into_no_other(tmp_path: Path) -> None:
    place, moved = tmp_path / "run", tmp_path / "moved"
    with Run.create("eval", place, SETTINGS.as_dict()) as first:
        place.rename(moved)
        place.mkdir()  # by another process
        for write in (
            lambda: first.metric({"step": 1}),
            lambda: first.event("measured"),
            lambda: first.finish({"score": 1.0}),
        ):
            with pytest.raises(StorageError, match="moved or deleted"):
                write()
        assert not any(place.iterdir())
    assert not (moved / RESULT).exists()
    with Run.create("eval", moved, SETTINGS.as_dict()) as again:  # where it is now, it goes on
        again.finish({"score": 1.0})


def test_a_deleted_directory_is_not_made_again(tmp_path: Path) -> None:
    with Run.create("eval", tmp_path / "run", SETTINGS.as_dict()) as run:
        shutil.rmtree(run.directory)
        (tmp_path / "run").mkdir()  # perhaps with the same inode
        with pytest.raises(StorageError, match="moved or deleted"):
            run.metric({"step": 1})
    assert not any((tmp_path / "run").iterdir())


def test_two_collections_one_in_the_place_of_the_other_do_not_mix(hjepa, monkeypatch) -> None:
    place, moved, begun = hjepa.directory / "data", hjepa.directory / "moved", []

    def move_once(*arguments):
        begun.append(True)
        if len(begun) == 2:  # the first one is a sample, before anything is there
            place.rename(moved)
            other = [sys.executable, "-m", "hjepa_cli", "collect", *SMALL, "--out", str(place)]
            subprocess.run(other, env=ENVIRONMENT, check=True, capture_output=True)
        return generate(*arguments)

    monkeypatch.setattr(collect, "generate", move_once)
    failed = hjepa("collect", *SMALL, "--seed", "9", "--out", place, "--quiet")
    assert_one_line_error(failed, 74, "moved or deleted", f"hjepa resume {moved}")
    found = load_dataset(place)
    assert found.settings["seed"] == 0 and all(len(found.split(name)) for name in found.splits)
    assert hjepa("resume", moved).code == 0 and load_dataset(moved).settings["seed"] == 9


def test_a_worker_writes_into_the_directory_that_was_locked(tmp_path: Path) -> None:
    (shard, *_) = collect.shards_of(SETTINGS)
    which = files.identity(tmp_path)
    (tmp_path / "other").mkdir()
    with pytest.raises(StorageError, match="moved or deleted"):
        collect.make_shard(SETTINGS, tmp_path / "other", which, shard)
    assert collect.make_shard(SETTINGS, tmp_path, which, shard)["name"] == shard.name


LACKS = [errno.EINVAL, errno.ENOTSUP, errno.ENOLCK, errno.ENOSYS]


@pytest.mark.parametrize("number", LACKS)
def test_a_disk_without_locks_is_said_and_used(tmp_path, monkeypatch, number) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.warns(Unlocked, match="cannot be locked"):
        lock = files.lock_directory(tmp_path)
    files.write_bytes(tmp_path / "a", b"a")
    lock.close()


def test_the_command_line_says_that_nothing_is_locked(hjepa, monkeypatch) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    done = hjepa("collect", *SMALL, "--out", "data")
    assert done.code == 0 and "warning: data cannot be locked on this file system" in done.err


@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES])
def test_a_disk_that_fails_is_not_taken_for_one_without_locks(
    tmp_path, monkeypatch, number
) -> None:
    def refuse(*_: object) -> NoReturn:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(StorageError, match=os.strerror(number)):
        files.lock_directory(tmp_path)


@pytest.mark.parametrize("number", LACKS)
def test_a_disk_that_cannot_flush_directories_is_used(tmp_path, monkeypatch, number) -> None:
    fsync = os.fsync

    def refuse(handle: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{handle}"):
            raise OSError(number, os.strerror(number))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", refuse)
    files.write_bytes(tmp_path / "a", b"a")
    files.make_durable(tmp_path / "a")
    assert (tmp_path / "a").read_bytes() == b"a"


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSYS, "Function not implemented"), PermissionError(13, "denied")]
)
def test_without_semaphores_there_is_one_process(hjepa, monkeypatch, error) -> None:
    """As in containers without /dev/shm, and on some systems."""

    def refuse(*_: object, **__: object) -> NoReturn:
        raise error

    monkeypatch.setattr("multiprocessing.synchronize._multiprocessing.SemLock", refuse)
    failed = hjepa("collect", *SMALL, "--workers", "1", "--out", "data", "--quiet")
    assert_one_line_error(failed, 70, "semaphores", "--workers 0")
    assert hjepa("collect", *SMALL, "--workers", "0", "--out", "data").code == 0
    with pytest.raises(NumericalError, match="semaphores"), executors.worker_pool(1, print):
        pass
