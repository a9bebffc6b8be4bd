"""The atomic writer: whole files or none, under kills, full disks and concurrent writers."""

import json
import os
import socket
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from hjepa_cli.errors import DataError, LockedError, MissingInputError, StorageError
from hjepa_cli.storage import files


def run_child(code: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_mode_follows_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        files.write_bytes(tmp_path / "a", b"x")
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o666 & ~umask


def test_order_is_data_then_rename_then_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A power loss leaves an empty file without the first fsync, the old one without the second."""
    calls: list[str] = []
    fsync, replace = os.fsync, os.replace

    def traced_fsync(handle: int) -> None:
        kind = "directory" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file"
        if kind == "file":
            assert os.fstat(handle).st_size == 3, "synced before the data was written"
        calls.append(f"fsync {kind}")
        fsync(handle)

    def traced_replace(source: Path, target: Path) -> None:
        calls.append("replace")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", traced_fsync)
    monkeypatch.setattr(os, "replace", traced_replace)
    files.write_bytes(tmp_path / "a", b"abc")
    assert calls == ["fsync file", "replace", "fsync directory"]
    assert (tmp_path / "a").read_bytes() == b"abc"


@pytest.mark.parametrize("failing", ["fsync", "replace"])
def test_a_failing_write_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    files.write_bytes(tmp_path / "a", b"old")

    def refuse(*_: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, failing, refuse)
    with pytest.raises(StorageError, match="Input/output error"):
        files.write_bytes(tmp_path / "a", b"new")
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


@pytest.mark.parametrize("failing", ["fsync", "link"])
def test_a_private_file_is_there_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(os, failing, refuse)
        with pytest.raises(StorageError, match="No space left"):
            files.create_private(tmp_path / "a", b"key")
    assert os.listdir(tmp_path) == []
    files.create_private(tmp_path / "a", b"key")
    with pytest.raises(StorageError, match="File exists"):
        files.create_private(tmp_path / "a", b"other")
    assert (tmp_path / "a").read_bytes() == b"key" and os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o600


def test_full_disk(tmp_path: Path) -> None:
    """A file size limit makes the kernel refuse the write, as a full disk or a quota does."""
    files.write_bytes(tmp_path / "a", b"old")
    child = run_child(
        """
        import resource, sys
        from pathlib import Path
        from hjepa_cli.errors import StorageError
        from hjepa_cli.storage import files
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
        try:
            files.write_bytes(Path(sys.argv[1]), b"n" * 200_000)
        except StorageError as error:
            print(error.message, "|", error.hint)
            sys.exit(error.exit_code)
        """,
        tmp_path / "a",
    )
    assert child.returncode == 74, child.stderr
    assert "File too large" in child.stdout and "free some disk space" in child.stdout
    assert os.listdir(tmp_path) == ["a"]
    assert (tmp_path / "a").read_bytes() == b"old"


def test_killed_writers_leave_old_or_new(tmp_path: Path) -> None:
    """SIGKILL at arbitrary moments of a write loop: the file is always one whole version."""
    target = tmp_path / "a"
    files.write_bytes(target, bytes([0]) * 1_000_000)
    for delay_s in np.linspace(0.0, 0.04, 6):
        child = subprocess.Popen(
            [
                sys.executable,
                "-c",
                "import itertools, sys; from pathlib import Path; "
                "from hjepa_cli.storage.files import write_bytes; print('go', flush=True)\n"
                "for i in itertools.count(): "
                "write_bytes(Path(sys.argv[1]), bytes([i % 256]) * 1_000_000)",
                str(target),
            ],
            stdout=subprocess.PIPE,
        )
        assert child.stdout is not None
        with child, child.stdout:
            child.stdout.readline()
            with pytest.raises(subprocess.TimeoutExpired):
                child.wait(timeout=float(delay_s))
            child.kill()
        data = target.read_bytes()
        assert len(data) == 1_000_000 and len(set(data)) == 1
    files.lock_directory(tmp_path).close()
    assert sorted(os.listdir(tmp_path)) == [files.LOCK_FILE, "a"]


def test_sweep_spares_living_writers(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    stale = tmp_path / f".a.{ended.pid}.tmp"
    living = tmp_path / f".a.{os.getppid()}.tmp"
    foreign = tmp_path / "notes.tmp"
    for path in (stale, living, foreign):
        path.write_bytes(b"half")
    files.sweep_temporaries(tmp_path)
    assert not stale.exists() and living.exists() and foreign.exists()


def test_lock_excludes_another_process_and_dies_with_its_holder(tmp_path: Path) -> None:
    code = """
        import sys
        from pathlib import Path
        from hjepa_cli.errors import LockedError
        from hjepa_cli.storage import files
        try:
            lock = files.lock_directory(Path(sys.argv[1]))
        except LockedError as error:
            sys.exit(error.exit_code)
        import os; os._exit(0)  # no clean-up at all
    """
    with files.lock_directory(tmp_path):
        assert run_child(code, tmp_path).returncode == 75
        with pytest.raises(LockedError, match="another process is working in"):
            files.lock_directory(tmp_path)
    assert run_child(code, tmp_path).returncode == 0
    files.lock_directory(tmp_path).close()


@pytest.mark.parametrize(
    "act",
    [
        lambda path: files.write_bytes(path / "a", b""),
        lambda path: files.make_directory(path / "a"),
        lambda path: files.next_directory(path),
        lambda path: files.lock_directory(path),
    ],
)
def test_a_file_in_the_way_is_one_clear_line(tmp_path: Path, act: object) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"cannot write .*file") as caught:
        act(tmp_path / "file")  # type: ignore[operator]
    assert "\n" not in caught.value.message and "--out" in (caught.value.hint or "")


def test_writing_over_a_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with pytest.raises(StorageError):
        files.write_bytes(tmp_path / "a", b"")
    assert os.listdir(tmp_path) == ["a"]


def test_next_directory_counts_on_from_the_highest(tmp_path: Path) -> None:
    parent = tmp_path / "data"
    assert files.next_directory(parent, "gym-").name == "gym-0001"
    (parent / "gym-0041").mkdir()
    (parent / "gym-9999999x").mkdir()
    (parent / "desktop-0100").mkdir()
    assert files.next_directory(parent, "gym-").name == "gym-0042"
    (parent / "gym-9999").mkdir()
    assert files.next_directory(parent, "gym-").name == "gym-10000"


def test_next_directory_never_shares_a_number(tmp_path: Path) -> None:
    code = """
        import sys
        from pathlib import Path
        from hjepa_cli.storage.files import next_directory
        print(*(next_directory(Path(sys.argv[1])).name for _ in range(50)))
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path)]
    children = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    names = [name for child in children for name in child.communicate(timeout=60)[0].split()]
    assert sorted(names) == [f"{number:04d}" for number in range(1, 101)]


def test_json_is_canonical_strict_and_readable(tmp_path: Path) -> None:
    value = {"b": [1, 2.5, None], "a": "λ"}
    files.write_json(tmp_path / "a.json", value)
    assert files.read_json(tmp_path / "a.json") == value
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == value
    assert files.canonical_json(value) == '{"a":"λ","b":[1,2.5,null]}'
    with pytest.raises(ValueError):
        files.write_json(tmp_path / "a.json", {"a": float("nan")})
    assert files.read_json(tmp_path / "a.json") == value


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[1]",
        '{"a": NaN}',
        '{"a": -Infinity}',
        '{"a": 1e999}',
        '{"a": 1, "a": 2}',
        '{"a": {"b": 1, "b": 1}}',
        '{"a": "\\ud800"}',
        '{"a": ' + "[" * 100_000 + "]" * 100_000 + "}",
        '{"a": ' + "9" * 5000 + "}",
        '{"a": 1} x',
    ],
)
def test_json_that_lies_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(DataError, match=r"a\.json is not valid JSON"):
        files.read_json(tmp_path / "a.json")


def test_reading_is_bounded_and_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(MissingInputError, match=r"gone\.json does not exist"):
        files.read_json(tmp_path / "gone.json")
    with pytest.raises(DataError, match="not a regular file"):
        files.read_json(tmp_path)
    (tmp_path / "a.json").write_text('{"a": 1}')
    monkeypatch.setattr(files, "JSON_LIMIT_BYTES", 7)
    with pytest.raises(DataError, match="too large: 8 bytes, at most 7"):
        files.read_json(tmp_path / "a.json")


def test_jsonable_turns_undefined_into_null() -> None:
    value = {
        "a": np.float32(0.5),
        "b": np.array([1.0, np.nan]),
        "c": (np.int64(3), Path("x/y")),
        "d": float("inf"),
        "e": np.bool_(True),
        4: None,
    }
    expected = {"a": 0.5, "b": [1.0, None], "c": [3, "x/y"], "d": None, "e": True, "4": None}
    assert files.jsonable(value) == expected
    json.dumps(files.jsonable(value), allow_nan=False)


@pytest.mark.parametrize("kind", ["pipe", "socket", "device"])
def test_special_files_are_refused_and_stay(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "out.npz"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(str(path))
    else:
        try:
            os.mknod(path, 0o600 | stat.S_IFCHR, os.makedev(1, 3))
        except PermissionError:
            path = Path("/dev/null")
    mode = path.lstat().st_mode
    (tmp_path / "link").symlink_to(path)
    for write in (
        lambda: files.write_bytes(path, b"new"),
        lambda: files.target(path),
        lambda: files.target(tmp_path / "link"),
    ):
        with pytest.raises(StorageError, match=f"it is a {kind}, not a regular file"):
            write()
    assert path.lstat().st_mode == mode and (tmp_path / "link").is_symlink()


def test_links_that_a_person_names_are_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real/file")
    for data in (b"first", b"second"):
        files.write_bytes(files.target(tmp_path / "link"), data)
        assert (tmp_path / "real/file").read_bytes() == data and (tmp_path / "link").is_symlink()
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(StorageError, match="circle of links"):
        files.target(tmp_path / "circle")
    assert files.target(tmp_path / "new" / "file") == tmp_path / "new" / "file"
    assert (tmp_path / "new").is_dir()
