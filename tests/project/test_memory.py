"""Sizes that no memory holds get one line, and what can be streamed is."""

import errno
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.compute import memory
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets import exports
from hjepa_cli.errors import OutOfMemory
from hjepa_cli.stages import models

HUGE = 10**14  # bytes


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize(
    "run_out",
    [
        lambda: bytearray(10**18),
        lambda: np.empty(10**15),
        lambda: np.empty((2**40, 2**40)),
        lambda: torch.empty(10**15),
        lambda: torch.empty((2**40, 2**40)),
    ],
)
def test_running_out_of_memory_is_no_error_to_report(hjepa, monkeypatch, run_out) -> None:
    monkeypatch.setattr(models, "show_list", lambda **_: run_out())
    failed = hjepa("models", "list")
    assert_one_line_error(failed, 70, "not enough memory")
    assert "report" not in failed.err


@pytest.mark.parametrize("error", [ValueError("x is too large"), RuntimeError("no")])
def test_other_errors_stay_what_they_are(error) -> None:
    assert not memory.ran_out(error)


@pytest.mark.parametrize(
    "command",
    [
        "collect --steps 900000000",
        "collect --frames stored --steps 90000000",
        "view --devices 3 --config long.toml --preset smoke",
        "eval --methods oracle --config long.toml --preset smoke",
        "scale --methods oracle --config long.toml --preset smoke --law scheduled",
        "reproduce --config long.toml --preset smoke",
        "reproduce --config much.toml --preset smoke",
    ],
)
def test_sizes_beyond_the_memory_are_refused_before_any_work(hjepa, command) -> None:
    (hjepa.directory / "long.toml").write_text("[protocol]\nsteps = 900000000\n")
    (hjepa.directory / "much.toml").write_text("[collect]\nsteps = 900000000\n")
    with hjepa.untouched():
        assert_one_line_error(hjepa(*command.split(), "--dry-run"), 70, "GB of memory")
    assert_one_line_error(hjepa(*command.split(), "--quiet"), 70, "GB of memory", "--dry-run")


@pytest.mark.parametrize(
    "flag",
    [
        ("collect", "--trajectories", "1e20"),
        ("collect", "--trajectories", str(10**18)),
        ("collect", "--steps", str(10**10)),
        ("train-encoder", "--steps", str(10**12)),
        ("view", "--devices", str(10**12)),
    ],
)
def test_sizes_have_upper_bounds(hjepa, flag) -> None:
    with hjepa.untouched():
        assert_one_line_error(hjepa(*flag, "--dry-run"), 2, flag[1][2:], "1000000000")


def test_layers_have_a_largest_width(hjepa) -> None:
    (hjepa.directory / "c.toml").write_text("[encoder]\nembedding = 100000\n")
    assert_one_line_error(hjepa("config", "show", "--config", "c.toml"), 2, "65536")


def test_a_training_beyond_the_memory_is_refused(hjepa, monkeypatch) -> None:
    assert hjepa("collect", "--preset", "smoke", "--out", "data").code == 0
    needed = 2 * 24576 * (load_settings("smoke").collect.steps + 1)
    monkeypatch.setattr(memory, "limit_bytes", lambda: needed)
    train = ("train-encoder", "--preset", "smoke", "--dataset", "data", "--quiet")
    with hjepa.untouched():
        assert_one_line_error(hjepa(*train), 70, "GB of memory")
        assert_one_line_error(hjepa(*train, "--dry-run"), 70, "GB of memory")


def test_a_dry_run_tells_memory(hjepa) -> None:
    plan = hjepa("collect", "--dry-run", "--json").document["plan"]
    assert 1e6 < plan["memory_bytes"] < 1e9
    assert "of memory" in hjepa("collect", "--dry-run").out


def test_an_export_beyond_the_memory_is_refused(hjepa, monkeypatch) -> None:
    assert hjepa("collect", "--preset", "smoke", "--frames", "stored", "--out", "data").code == 0
    monkeypatch.setattr(memory, "limit_bytes", lambda: 10_000_000)
    with hjepa.untouched():
        for flags in ([], ["--dry-run"]):
            failed = hjepa("data", "export", "data", "--format", "npz", *flags)
            assert_one_line_error(failed, 70, "GB of memory")


def test_limits_of_shells_count() -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    try:
        resource.setrlimit(resource.RLIMIT_DATA, (2**40, hard))
        assert memory.limit_bytes() <= 2**40
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
    with pytest.raises(OutOfMemory):
        memory.check(HUGE, "it")


def test_an_export_takes_no_more_memory_for_more_trajectories(tmp_path: Path) -> None:
    """Raw frames are 80 times larger than the file."""

    def peak_bytes(trajectories: int) -> int:
        frames = (np.zeros((20, 64, 128, 3), np.uint8) for _ in range(trajectories))
        values = {"state": np.zeros((20 * trajectories, 4), np.float32)}
        tracemalloc.start()
        exports.write_npz(tmp_path / "a.npz", values, frames, (64, 128, 3), {})
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return peak

    peak_bytes(1)
    few, many = peak_bytes(20), peak_bytes(60)
    assert many < few + 500_000 + 40 * 20 * 16
    assert np.load(tmp_path / "a.npz")["pixels"].shape == (1200, 64, 128, 3)


def test_streamed_files_are_as_numpy_writes_them(tmp_path: Path) -> None:
    chance = np.random.default_rng(0)
    frames = chance.integers(0, 255, (3, 5, 64, 128, 3)).astype(np.uint8)
    values = {"state": chance.random((15, 4)).astype(np.float32), "ep_len": np.full(3, 5, np.int32)}
    exports.write_npz(tmp_path / "a.npz", values, iter(frames), (64, 128, 3), {"plant": "desktop"})
    found = np.load(tmp_path / "a.npz")
    assert np.array_equal(found["pixels"], frames.reshape(15, 64, 128, 3))
    for name, array in values.items():
        assert np.array_equal(found[name], array) and found[name].dtype == array.dtype
    np.savez_compressed(tmp_path / "b.npz", hjepa=found["hjepa"], **values, pixels=found["pixels"])
    with zipfile.ZipFile(tmp_path / "a.npz") as ours, zipfile.ZipFile(tmp_path / "b.npz") as theirs:
        assert [ours.read(name) for name in ours.namelist()] == [
            theirs.read(name) for name in theirs.namelist()
        ]


def test_an_export_that_fails_leaves_the_old_file(tmp_path: Path) -> None:
    def failing():
        yield np.zeros((1, 64, 128, 3), np.uint8)
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "a.npz").write_bytes(b"old")
    with pytest.raises(Exception, match="No space"):
        exports.write_npz(
            tmp_path / "a.npz", {"state": np.zeros((1, 4))}, failing(), (64, 128, 3), {}
        )
    assert [one.name for one in tmp_path.iterdir()] == ["a.npz"]
    assert (tmp_path / "a.npz").read_bytes() == b"old"
