"""Wherever parallel work runs, the bytes are the same; what dies is done again or reported."""

import dataclasses
import hashlib
import importlib
import io
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, open_shell
from test_evaluate import untrained

from hjepa_cli.compute import executors
from hjepa_cli.compute.executors import InProcess, finished, open_executor, placed
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.errors import ClusterLost, Interrupted, NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect, resume, scale
from hjepa_cli.storage.shards import LOG, Shard, ShardLog, cut

SCREEN = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
SETTINGS = load_settings(
    flags={
        "control.gains_n": [],
        "collect.trajectories": 9,
        "collect.test_trajectories": 3,
        "collect.clean_trajectories": 2,
        "collect.steps": 12,
        "collect.clean_steps": 12,
        "collect.frames": "stored",
        "protocol": "paper",
        "protocol.steps": 16,
        "protocol.curve_devices": 4,
        "protocol.bracket_devices": 40,
        "protocol.gaps": [1, 8],
        "protocol.bracket": 0.3,
        "protocol.horizon": 8,
        "protocol.bootstrap": 20,
        "radio.snr_db": "0:49:1",
        "methods": ["hjepa", "hold-true", "zero-true", "oracle"],
    }
)


@pytest.fixture(autouse=True)
def small_shards(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(datasets, "SHARD_TRAJECTORIES_WITH_FRAMES", 2)


class Cluster:
    """A Dask scheduler and its workers: processes of their own, started as a user starts them."""

    def __init__(self, directory: Path) -> None:
        pytest.importorskip("distributed")
        self._directory, self._running = directory, list[subprocess.Popen[bytes]]()
        self.file = directory / "scheduler.json"
        self._start("scheduler", "--host", "127.0.0.1", "--port", "0")
        self.workers = [self.start_worker() for _ in range(2)]

    def start_worker(self) -> subprocess.Popen[bytes]:
        """Without a nanny: what is killed stays dead."""
        return self._start("worker", "--nthreads", "1", "--no-nanny")

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options]
        command += ["--scheduler-file", str(self.file), "--no-dashboard"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen(command, cwd=self._directory, env=ENVIRONMENT, **quiet)
        self._running.append(process)
        return process

    def wait(self) -> None:
        """Until two workers are there."""
        distributed: Any = importlib.import_module("distributed")
        while not self.file.exists():
            time.sleep(0.05)
        with distributed.Client(scheduler_file=str(self.file), set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)

    def kill_worker(self, when: Path, unless: Path) -> threading.Thread:
        """SIGKILL a worker as soon as ``when`` exists; the work must not have ended by then."""

        def kill() -> None:
            while not when.exists():
                time.sleep(0.001)
            worker = self.workers.pop(0)
            worker.kill()
            self.midway = not unless.exists()
            worker.wait()

        thread = threading.Thread(target=kill)
        thread.start()
        return thread

    def close(self) -> None:
        for process in self._running:
            process.kill()
            process.wait()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    started = Cluster(tmp_path_factory.mktemp("cluster"))
    try:
        yield started
    finally:
        started.close()


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def places(cluster: Cluster) -> dict[str, Any]:
    """Where parallel work can run, by name; ``killed`` loses one of its two workers."""
    return {
        "zero": placed(0),
        "two": placed(2),
        "local": placed(2, "local"),
        "killed": placed(cluster=str(cluster.file)),
    }


@pytest.mark.slow
def test_a_dataset_is_the_same_from_any_number_of_workers_and_from_a_cluster(
    cluster: Cluster,
) -> None:
    for name, place in (places(cluster) | {"one": placed(1)}).items():
        killer = None
        if name == "killed":
            cluster.wait()
            killer = cluster.kill_worker(Path(name, LOG), Path(name, datasets.MANIFEST))
        with place:
            collect.run(SETTINGS, SCREEN, out=Path(name))
        if killer:
            killer.join()
            assert cluster.midway
        assert len(list(Path(name).glob("shard-*"))) == 5 + 2 + 1
        assert contents(Path(name)) == contents(Path("zero"))


@pytest.mark.slow
def test_a_sweep_is_the_same_from_any_number_of_workers_and_from_a_cluster(
    cluster: Cluster, tmp_path: Path
) -> None:
    """50 signal-to-noise ratios by 4 methods: 200 cells, four times the same CSV."""
    if len(cluster.workers) < 2:
        cluster.workers.append(cluster.start_worker())
    found, model = [], str(untrained(tmp_path / "model.safetensors"))
    for name, place in places(cluster).items():
        out, killer = Path(name), None
        if name == "killed":
            cluster.wait()
            killer = cluster.kill_worker(out / "curves.json", out / "result.json")
        with place:
            result = scale.run(SETTINGS, SCREEN, checkpoint=model, out=out, remeasure=True)
        if killer:
            killer.join()
            assert cluster.midway
        assert len(result["rows"]) == 200
        found.append((out / "devices.csv").read_bytes())
    assert len(found) == 4 and len(set(found)) == 1
    assert len(found[0].splitlines()) == 201


def test_units_come_back_few_at_a_time() -> None:
    asked: list[int] = []

    def square(number: int) -> int:
        asked.append(number)
        return number**2

    results = finished(InProcess(), 1, square, range(10**9))  # never held in memory
    assert [next(results) for _ in range(3)] == [0, 1, 4] and asked == [0, 1, 2]
    assert sorted(finished(InProcess(), 1, square, range(7))) == [n**2 for n in range(7)]
    assert list(finished(InProcess(), 1, square, [])) == []


def test_errors_of_a_unit_come_through() -> None:
    def fail(_: int) -> int:
        raise UsageError("no")

    with pytest.raises(UsageError, match="no"):
        list(finished(InProcess(), 1, fail, [1]))


def test_a_dead_worker_is_one_line() -> None:
    with (
        pytest.raises(NumericalError, match="a worker process died"),
        placed(1),
        open_executor(0) as (executor, workers),
    ):
        list(finished(executor, workers, os._exit, [9]))


def test_an_interrupted_collection_keeps_its_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    collect.run(SETTINGS, SCREEN, out=Path("whole"))
    write, made = collect.write_shard, []

    def interrupt(directory: Path, shard: Shard, *rest: Any) -> Any:
        if len(made) == 3:
            raise KeyboardInterrupt
        made.append(shard.name)
        return write(directory, shard, *rest)

    monkeypatch.setattr(collect, "write_shard", interrupt)
    with pytest.raises(Interrupted) as caught:
        collect.run(SETTINGS, SCREEN, out=Path("part"))
    assert caught.value.hint == "hjepa resume part"
    other = dataclasses.replace(SETTINGS, seed=5)
    with pytest.raises(UsageError, match="with other settings: seed = 0, not 5"):
        collect.run(other, SCREEN, out=Path("part"))
    with open(f"part/{LOG}", "ab") as log:
        log.write(b'{"name": "shard-00')  # a kill in the middle of a line
    flipped = bytearray(Path("part/shard-00001.safetensors").read_bytes())
    flipped[-1] ^= 1
    Path("part/shard-00001.safetensors").write_bytes(flipped)
    Path("part/shard-00005.safetensors").write_bytes(b"there, but not ours")
    made.clear()
    made.extend(["x", "x", "x", "x"])
    resume.run(Path("part"), SCREEN)
    assert made[4:] == [f"shard-{number:05d}.safetensors" for number in (1, 3, 4, 5, 6, 7)]
    assert contents(Path("part")) == contents(Path("whole"))
    assert resume.run(Path("part"), SCREEN)["trajectories"] == 9


def test_a_log_that_lies_is_not_believed(tmp_path: Path) -> None:
    outside = tmp_path / "shard-00000.safetensors"
    outside.write_bytes(b"x")
    directory = tmp_path / "d"
    directory.mkdir()
    ShardLog(directory, {"seed": 1})
    digest = hashlib.sha256(b"x").hexdigest()
    with open(directory / LOG, "a") as log:
        log.write(f'{{"name": "../shard-00000.safetensors", "sha256": "{digest}"}}\n')
        log.write('{"name": 3, "sha256": "x"}\n{"sha256": "x"}\n[]\n\xff\n')
    assert ShardLog(directory, {"seed": 1}).done == {}


def test_shards_cut_every_split() -> None:
    shards = cut({"a": 5, "b": 2}, 2)
    assert [(s.number, s.split, s.start, s.stop) for s in shards] == [
        (0, "a", 0, 2), (1, "a", 2, 4), (2, "a", 4, 5), (3, "b", 0, 2),
    ]  # fmt: skip


def test_no_room_is_said_before_any_work(monkeypatch: pytest.MonkeyPatch) -> None:
    usage = type("Usage", (), {"free": 1_000_000})
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(Exception, match=r"1\.0 MB free; 4\.\d are needed") as caught:
        collect.run(SETTINGS, SCREEN, out=Path("full"))
    assert caught.value.exit_code == 74  # type: ignore[attr-defined]
    assert contents(Path("full")).keys() == {".lock"}


def test_the_size_that_is_promised_is_the_size_on_disk() -> None:
    collect.run(SETTINGS, SCREEN, out=Path("data"))
    shards = sum(path.stat().st_size for path in Path("data").glob("shard-*"))
    assert shards == pytest.approx(collect.size_bytes(SETTINGS), rel=0.01)


@pytest.fixture
def hjepa(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


def test_places_that_are_not_there(hjepa: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    assert_one_line_error(hjepa("collect", "--workers", "-1"), 2, "--workers")
    monkeypatch.setattr(executors, "CONNECT_S", 1)
    assert_one_line_error(hjepa("collect", "--quiet", "--cluster", "nonsense:1"), 2, "nonsense:1")
    absent = hjepa("scale", "--snr", "20", "--quiet", "--cluster", "nosuch.json")  # all is cached
    assert_one_line_error(absent, 2, "nosuch.json: no such file", "dask scheduler")
    both = hjepa("collect", "--quiet", "--cluster", "local", "--workers", "0")
    assert_one_line_error(both, 2, "--workers 0", "--cluster local")
    monkeypatch.setattr(executors.importlib.util, "find_spec", lambda _: None)
    missing = hjepa("collect", "--quiet", "--cluster", "local")
    assert_one_line_error(missing, 2, "needs Dask", 'pip install "hjepa[cluster]"')


def test_a_million_trajectories_are_planned(hjepa: Shell) -> None:
    plan = hjepa("collect", "--trajectories", "1000000", "--dry-run", "--json").document["plan"]
    assert "in 2002 shards" in plan["writes"][0]  # of both laws
    assert plan["writes_bytes"] == pytest.approx(2e6 * (161 * 16 + 160 * 8), rel=0.01)
    assert 1 < plan["minutes"] < 60
    assert hjepa.files() == {}


def test_places_are_forgotten_afterwards() -> None:
    with placed(3, None):
        assert executors.placement().workers == 3
    assert executors.placement().workers is None


class Told:
    """A client of a cluster that answers as it is told."""

    def __init__(self, answer: dict[str, dict[str, str]] | Exception) -> None:
        self.answer = answer

    def wait_for_workers(self, count: int, timeout: float) -> None:
        if self.answer == {}:
            raise TimeoutError

    def run(self, function: Any, names: Any) -> dict[str, dict[str, str]]:
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def test_workers_must_be_there_and_compute_the_same() -> None:
    here = executors.versions(executors.NUMBERS_FROM)
    executors.check_cluster(Told({"tcp://a:1": here, "tcp://b:1": dict(here)}), "x")
    for answer, message in (
        ({}, "--cluster x: the scheduler has no workers"),
        ({"tcp://a:1": here, "tcp://b:1": here | {"pymunk": "6"}}, r"tcp://b:1 has pymunk 6, not "),
        ({"tcp://a:1": {}}, r"hjepa None, not "),
        (ModuleNotFoundError("No module named 'hjepa_cli'"), "cannot import hjepa: No module"),
    ):
        with pytest.raises(UsageError, match=message) as caught:
            executors.check_cluster(Told(answer), "x")
        assert caught.value.hint


def test_a_scheduler_that_ends_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    distributed: Any = pytest.importorskip("distributed")

    class Client(Told):
        def __init__(self, *_: Any, **__: Any) -> None:
            super().__init__({"tcp://a:1": executors.versions(executors.NUMBERS_FROM)})
            self.status = "running"

        def nthreads(self) -> dict[str, int]:
            return {"tcp://a:1": 2}

        def get_executor(self, **_: Any) -> Any:
            return self

        def close(self) -> None:
            pass

    monkeypatch.setattr(distributed, "Client", Client)
    with (
        pytest.raises(ClusterLost, match="the scheduler has gone; what is finished") as caught,
        executors.open_cluster("tcp://there:1", 1) as (client, threads),
    ):
        assert threads == 2
        client.status = "closed"  # type: ignore[attr-defined]
        raise CancelledError
    assert caught.value.exit_code == 74
    for error in (RuntimeError("a bug of ours"), UsageError("of a unit")):
        with pytest.raises(type(error)), executors.open_cluster("tcp://there:1", 1):
            raise error


def test_hints_to_repeat_name_the_command_that_goes_on() -> None:
    """The same command without --out would begin again elsewhere."""
    Path("data").mkdir()
    Path("data", collect.LOG).touch()
    with pytest.raises(NumericalError) as caught, collect.telling_how_to_go_on(Path("data")):
        with executors.broken_pool_reported():
            raise executors.BrokenProcessPool
    assert caught.value.hint == "free some memory, then hjepa resume data"
