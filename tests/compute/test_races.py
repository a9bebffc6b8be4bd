"""Two at a time: no write is lost, no lock is broken, no foreign process is ended."""

import multiprocessing
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, open_shell

from hjepa_cli.compute import executors
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation import workers
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, silent
from hjepa_cli.errors import LockedError, NumericalError, StorageError
from hjepa_cli.storage import files
from hjepa_cli.storage.runs import Run

SETTINGS = load_settings().as_dict()


def start(code: str, *arguments: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)


def test_two_writers_with_one_pid_do_not_meet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in two containers on one disk: the second writes all of it while the first one does."""
    fsync, inside = os.fsync, []

    def interleave(handle: int) -> None:
        fsync(handle)
        if not inside:
            inside.append(True)
            files.write_bytes(tmp_path / "a", b"second")

    monkeypatch.setattr(os, "fsync", interleave)
    files.write_bytes(tmp_path / "a", b"first")
    assert (tmp_path / "a").read_bytes() == b"first" and os.listdir(tmp_path) == ["a"]


def test_evaluations_that_share_a_file_of_curves_lose_none(tmp_path: Path) -> None:
    code = """
        import sys
        from pathlib import Path
        from hjepa_cli.core.evaluation import curves
        curves.flaw = lambda entry, complete: None  # the entries here are no real ones
        digest = curves.Digest("0" * 64, "1" * 64)
        for number in range(20):
            curves.write(Path(sys.argv[1]), digest, {f"{sys.argv[2]}{number}": {"score": 1}})
    """
    path = tmp_path / "curves.json"
    for child in [start(code, path, name) for name in ("a", "b")]:
        child.communicate(timeout=60)
        assert child.returncode == 0
    assert len(files.read_json(path)["methods"]) == 40
    assert os.listdir(tmp_path) == ["curves.json"]


def test_a_refusal_says_who_is_working_there(tmp_path: Path) -> None:
    code = """
        import os, sys, time
        from pathlib import Path
        from hjepa_cli.storage import files
        lock = files.lock_directory(Path(sys.argv[1]))
        print(os.getpid(), flush=True)
        time.sleep(60)
    """
    with start(code, tmp_path) as holder:
        assert holder.stdout is not None
        pid = int(holder.stdout.readline())
        with pytest.raises(LockedError, match=rf"{tmp_path}: process {pid} on [\w.-]+$"):
            files.lock_directory(tmp_path)
        assert (tmp_path / files.LOCK_FILE).stat().st_size  # the refused one wiped nothing out
        holder.kill()
    with files.lock_directory(tmp_path):
        assert f"process {os.getpid()} on" in (tmp_path / files.LOCK_FILE).read_text()
    assert (tmp_path / files.LOCK_FILE).read_bytes() == b""  # equal inputs, equal directories


@pytest.mark.parametrize(
    "text", ["", "rm -rf /", "process 1 on \x1b[2J", "process 1 on h\nhint: x"]
)
def test_what_stands_in_a_foreign_lock_is_not_repeated(tmp_path: Path, text: str) -> None:
    with files.lock_directory(tmp_path):
        (tmp_path / files.LOCK_FILE).write_text(text)
        with pytest.raises(LockedError, match=rf"working in {tmp_path}$"):
            files.lock_directory(tmp_path)


def test_nothing_is_written_to_where_links_lead(tmp_path: Path) -> None:
    """A directory from elsewhere may hold links instead of the files that a run keeps."""
    victim, run = tmp_path / "victim", tmp_path / "run"
    with Run.create("eval", run, SETTINGS) as record:
        record.metric({"epoch": 1})
    config = (run / "config.toml").read_bytes()
    names = ["metrics.csv", "events.jsonl", "result.json"]
    for name in names:
        (run / name).unlink(missing_ok=True)
        (run / name).symlink_to(victim if name != "result.json" else tmp_path / "nowhere")
    victim.write_text("epoch\nprecious\n")
    with Run.create("eval", run, SETTINGS) as record:
        record.metric({"epoch": 2})
        record.event("measured")
        record.finish({"score": 1})
    assert victim.read_text() == "epoch\nprecious\n" and not (tmp_path / "nowhere").exists()
    assert not any((run / name).is_symlink() for name in names)
    assert (run / "config.toml").read_bytes() == config
    (run / files.LOCK_FILE).unlink()
    (run / files.LOCK_FILE).symlink_to(victim)
    with pytest.raises(StorageError, match="cannot write"):
        Run.create("eval", run, SETTINGS)
    assert victim.read_text() == "epoch\nprecious\n"


def test_a_directory_that_cannot_be_read_is_not_called_unwritable(tmp_path: Path) -> None:
    (tmp_path / "data").write_text("")
    with pytest.raises(StorageError, match="cannot read") as caught:
        files.list_names(tmp_path / "data")
    assert "--out" not in (caught.value.hint or "")


def test_the_caller_s_own_processes_survive_ours() -> None:
    context = multiprocessing.get_context("spawn")
    theirs = context.Process(target=time.sleep, args=(60,))
    theirs.start()
    try:
        with (
            pytest.raises(KeyboardInterrupt),
            executors.worker_pool(1, executors.prepare_worker) as pool,
        ):
            pool.submit(os.getpid).result()
            raise KeyboardInterrupt
        assert multiprocessing.active_children() == [theirs]
        theirs.join(0.2)
        assert theirs.is_alive()
    finally:
        theirs.kill()
        theirs.join()


def die_with_the_lock(*_: object) -> None:
    assert workers._done is not None
    workers._done.get_lock().acquire()
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_worker_that_dies_with_the_lock_of_progress_stops_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The parent would wait for that lock forever."""
    monkeypatch.setattr(workers, "compute", die_with_the_lock)
    block = Block("oracle", (Point("gap", 3.0),), 0, 1)
    before = signal.signal(signal.SIGALRM, signal.default_int_handler)
    signal.alarm(60)
    try:
        with (
            pytest.raises(NumericalError, match="a worker process died"),
            executors.placed(1),
            workers.open_workers(0) as opened,
        ):
            opened.runner(load_settings(), None)([block], silent)()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def processes_of(session: int) -> list[int]:
    """Processes of a session that are alive, by what the kernel says."""
    found = []
    for entry in Path("/proc").iterdir():
        try:
            state, _, _, of = re.sub(r"^.*\) ", "", (entry / "stat").read_text()).split()[:4]
        except (OSError, ValueError):
            continue
        if entry.name.isdecimal() and int(of) == session and state != "Z":
            found.append(int(entry.name))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "number", "code"),
    [
        (("--workers", "2"), signal.SIGTERM, 143),
        (("--cluster", "local", "--workers", "2"), signal.SIGINT, 130),
    ],
)
def test_ctrl_c_leaves_no_process_behind_and_the_command_goes_on(
    place: tuple[str, ...], number: int, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A terminal sends it to the whole group: parent, workers and all."""
    if "--cluster" in place:
        pytest.importorskip("distributed")
    shell: Shell = open_shell(tmp_path, monkeypatch, capsys)
    command = [sys.executable, "-m", "hjepa_cli", "collect", "--steps", "20", "--out", "data"]
    command += ["--trajectories", "30000", *place]  # and as many by the tuned law
    with subprocess.Popen(
        command, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as child:
        log = tmp_path / "data" / "collecting.jsonl"
        while child.poll() is None and (not log.exists() or log.read_bytes().count(b"\n") < 3):
            time.sleep(0.01)
        second = shell("collect", "--trajectories", "30000", "--steps", "20", "--out", "data")
        assert_one_line_error(second, 75, f"process {child.pid} on")
        os.killpg(child.pid, number)
        _, errors = child.communicate(timeout=60)
        ended_s = time.monotonic()
        while left := processes_of(child.pid):
            assert time.monotonic() - ended_s < 2, left
            time.sleep(0.05)
    assert child.returncode == code, errors
    lines = [line for line in errors.splitlines() if not line.startswith("collect")]
    assert lines[-2:] == [
        "error: interrupted; finished shards are kept",
        "hint: hjepa resume data",
    ], errors
    assert "Traceback" not in errors
    done = log.read_bytes().count(b"\n") - 1
    assert 2 <= done < 61
    kept = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "data").glob("shard-*")}
    assert len(kept) >= done


@pytest.mark.parametrize("where", ["pool", "workers", "local"])
def test_children_import_nothing_from_the_current_directory(where: str, tmp_path: Path) -> None:
    """With a look-alike of every module that they could find there."""
    if where == "local":
        pytest.importorskip("distributed")
    here, elsewhere = tmp_path / "here", tmp_path / "elsewhere"
    here.mkdir(), elsewhere.mkdir()
    look_alike = f"open({str(tmp_path / 'executed')!r}, 'a').write(__name__ + ' ')\n"
    for name in (*sys.stdlib_module_names, "numpy", "torch", "hjepa_cli", "distributed", "dask"):
        (here / f"{name}.py").write_text(look_alike)
    launcher = elsewhere / "launcher.py"  # as the command hjepa lies elsewhere
    launcher.write_text(
        textwrap.dedent(f"""
        import operator
        from hjepa_cli.compute.executors import finished, open_executor, placed
        if {where!r} == "workers":
            from hjepa_cli.core.evaluation.workers import open_workers
            with placed(1), open_workers(0):
                pass  # its counter has a lock, which starts a process
        else:
            with (
                placed(1, "local" if {where!r} == "local" else None),
                open_executor(1) as (executor, count),
            ):
                assert sorted(finished(executor, count, operator.neg, [1, 2])) == [-2, -1]
        """)
    )
    ended = subprocess.run(
        [sys.executable, str(launcher)], cwd=here, env=ENVIRONMENT, capture_output=True, text=True
    )
    executed = tmp_path / "executed"
    assert not executed.exists(), executed.read_text()
    assert ended.returncode == 0, ended.stderr


def test_the_environment_of_the_caller_is_put_back(monkeypatch: pytest.MonkeyPatch) -> None:
    for before in (None, "", "yes"):
        if before is None:
            monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
        else:
            monkeypatch.setenv("PYTHONSAFEPATH", before)
        with executors.spawning():
            assert os.environ["PYTHONSAFEPATH"] == "1"
        assert os.environ.get("PYTHONSAFEPATH") == before
