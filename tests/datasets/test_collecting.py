"""A collection that is stopped, refused by the disk or of another version: nothing is lost."""

import dataclasses
import hashlib
import io
import json
import os
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hjepa_cli.compute.executors import placed
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    Interrupted,
    NumericalError,
    StorageError,
    Unsealed,
    UsageError,
)
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect, resume
from hjepa_cli.storage import files, seals, shards
from hjepa_cli.storage.shards import LOG, ShardLog

SCREEN = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())


def small(**changes: Any) -> Settings:
    flags = {"trajectories": 5, "test_trajectories": 1, "clean_trajectories": 1, "steps": 8}
    flags |= {"clean_steps": 8} | changes
    counted = {f"collect.{key}": value for key, value in flags.items()}
    return load_settings(flags=counted | {"control.gains_n": []})  # by the teacher alone


@pytest.fixture(autouse=True)
def shards_of_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(datasets, "SHARD_TRAJECTORIES", 1)


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def failing(function: Callable[..., Any], error: BaseException, when: str) -> Callable[..., Any]:
    """``function``, which raises where a file of that name is concerned."""

    def fail(source: Any, target: Any) -> Any:
        if Path(target).name == when:
            raise error
        return function(source, target)

    return fail


def test_a_log_has_its_first_line_or_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A kill between creating and writing it would make the directory useless for good."""
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing(os.replace, KeyboardInterrupt(), LOG))
        with pytest.raises(Interrupted):
            collect.run(small(), SCREEN, out=Path("data"))
    assert contents(Path("data")).keys() == {files.LOCK_FILE}
    assert collect.run(small(), SCREEN, out=Path("data"))["trajectories"] == 5


def test_a_log_keeps_its_lines_while_it_is_rewritten(monkeypatch: pytest.MonkeyPatch) -> None:
    Path("d").mkdir()
    log = ShardLog(Path("d"), {"seed": 1})
    for number in range(3):
        name = f"shard-{number:05d}.safetensors"
        Path("d", name).write_bytes(b"")
        log.add({"name": name, "sha256": hashlib.sha256(b"").hexdigest()})
    before = Path("d", LOG).read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing(os.replace, KeyboardInterrupt(), LOG))
        with pytest.raises(KeyboardInterrupt):
            ShardLog(Path("d"), {"seed": 1})
    assert Path("d", LOG).read_bytes() == before
    assert len(ShardLog(Path("d"), {"seed": 1}).done) == 3


@pytest.mark.parametrize("when", [LOG, "shard-00003.safetensors", datasets.MANIFEST])
def test_a_full_disk_names_what_goes_on_at_every_moment(
    when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Above all at the last one: a new directory would begin all over again."""
    collect.run(small(), SCREEN, out=Path("whole"))
    full = OSError(28, "No space left on device")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing(os.replace, full, when))
        with pytest.raises(StorageError, match="No space left") as caught:
            collect.run(small(), SCREEN)
    if when == LOG:  # nothing is there that could be resumed
        assert caught.value.hint == "free some disk space, then run the same command again"
        made = Path(collect.run(small(), SCREEN)["dataset"])
    else:
        assert caught.value.hint == "free some disk space, then hjepa resume data/desktop-0001"
        made = Path(resume.run(Path("data/desktop-0001"), SCREEN)["dataset"])
    assert contents(made) == contents(Path("whole"))


def test_ctrl_c_at_the_last_moment_goes_on_too(monkeypatch: pytest.MonkeyPatch) -> None:
    collect.run(small(), SCREEN, out=Path("whole"))
    with monkeypatch.context() as patch:
        late = failing(os.replace, KeyboardInterrupt(), datasets.MANIFEST)
        patch.setattr(os, "replace", late)
        with pytest.raises(Interrupted) as caught:
            collect.run(small(), SCREEN)
    assert caught.value.hint == "hjepa resume data/desktop-0001"
    with monkeypatch.context() as patch:  # all shards are there: only the manifest is made
        patch.setattr(collect, "make_shard", lambda *_: pytest.fail("made again"))
        resume.run(Path("data/desktop-0001"), SCREEN)
    assert contents(Path("data/desktop-0001")) == contents(Path("whole"))


@pytest.mark.parametrize(
    "go_on",
    [
        lambda: collect.run(small(), SCREEN, out=Path("data")),
        lambda: resume.run(Path("data"), SCREEN),
    ],
)
def test_a_log_left_beside_a_finished_dataset_goes(
    go_on: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A kill between writing the one and removing the other."""
    with monkeypatch.context() as patch:
        patch.setattr(collect, "remove_log", lambda _: None)
        collect.run(small(), SCREEN, out=Path("data"))
    assert Path("data", LOG).exists()
    assert go_on()["trajectories"] == 5
    assert not Path("data", LOG).exists()


def test_room_is_needed_only_for_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr(files, "check_free_space", lambda _, size_bytes: asked.append(size_bytes))
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", failing(os.replace, KeyboardInterrupt(), datasets.MANIFEST))
        with pytest.raises(Interrupted):
            collect.run(small(), SCREEN, out=Path("data"))
    collect.run(small(), SCREEN, out=Path("data"))
    whole, rest = asked
    assert whole == collect.size_bytes(small()) and rest <= 0


def test_more_than_a_manifest_can_list_is_refused_at_once() -> None:
    with pytest.raises(UsageError, match=r"one dataset holds at most 50000$"):
        collect.run(small(trajectories=50_000), SCREEN, out=Path("data"))
    assert not Path("data").exists()


def interrupted_collection(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the log of a collection says that was stopped before its last shard."""
    with monkeypatch.context() as patch:
        late = failing(os.replace, KeyboardInterrupt(), "shard-00006.safetensors")
        patch.setattr(os, "replace", late)
        with pytest.raises(Interrupted):
            collect.run(small(), SCREEN, out=Path("data"))
    first, *_ = Path("data", LOG).read_text().split("\n")
    task: dict[str, Any] = json.loads(first)
    return task


def rewrite_task(task: dict[str, Any]) -> None:
    """Replace the first line of the log by another, its seal right if it has one."""
    task = seals.sealed(task) if seals.SEAL in task else task
    _, *lines = Path("data", LOG).read_text().split("\n")
    Path("data", LOG).write_text("\n".join([json.dumps(task), *lines]))


def test_a_collection_of_an_older_version_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that had no schema yet, and not all of our settings."""
    task = interrupted_collection(monkeypatch)
    assert task.pop("schema") == shards.SCHEMA
    del task["radio"], task["collect"]["exploration_n"], task[seals.SEAL]
    rewrite_task(task)
    with pytest.warns(Unsealed, match="has no seal"):
        resume.run(Path("data"), SCREEN)
    collect.run(small(), SCREEN, out=Path("whole"))
    assert contents(Path("data")) == contents(Path("whole"))


@pytest.mark.parametrize(
    ("change", "match", "hint"),
    [
        ({"schema": 3}, "has schema 3; this hjepa reads up to 2", "--upgrade"),
        ({"schema": "1"}, "has schema '1'", None),
        ({"strange": 1}, "unknown setting 'strange'", "delete data"),
        ({"collect": {"trajectories": "x"}}, "collect.trajectories = 'x'", "delete data"),
        ({"preset": 3}, "preset 3", None),
    ],
)
def test_a_collection_of_another_version_says_so(
    change: dict[str, Any], match: str, hint: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rewrite_task(interrupted_collection(monkeypatch) | change)
    with pytest.raises(DataError, match=match) as caught:
        collect.run(small(), SCREEN, out=Path("data"))
    assert (hint or "") in (caught.value.hint or "")
    with pytest.raises(HjepaError, match=match):
        resume.run(Path("data"), SCREEN)


def test_a_log_that_describes_other_shards_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Right names and right digests, of another division into shards."""
    interrupted_collection(monkeypatch)
    text = Path("data", LOG).read_text()
    lying = text.replace('"split":"train"', '"split":"test"', 1)
    assert lying != text
    Path("data", LOG).write_text(lying)
    collect.run(small(), SCREEN, out=Path("data"))
    collect.run(small(), SCREEN, out=Path("whole"))
    assert contents(Path("data")) == contents(Path("whole"))


def test_a_simulation_that_diverges_is_a_numerical_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    generate = collect.generate

    def diverge(settings: Settings, split: str, rows: range = range(1)) -> Any:
        made = generate(settings, split, rows)
        if (split, rows.start) == ("train", 3):
            made.states[0, 4:] = np.nan
        return made

    monkeypatch.setattr(collect, "generate", diverge)
    match = "trajectory 3 of split 'train': 'states' is not finite from index 4 on"
    with pytest.raises(NumericalError, match=match) as caught:
        collect.run(small(), SCREEN, out=Path("data"))
    assert caught.value.exit_code == 70
    assert not Path("data", "shard-00003.safetensors").exists()
    assert not Path("data", datasets.MANIFEST).exists()


def test_memory_does_not_grow_with_the_dataset(monkeypatch: pytest.MonkeyPatch) -> None:
    """Six times the trajectories, and hardly more than their lines in the manifest."""
    monkeypatch.setattr(datasets, "SHARD_TRAJECTORIES", 10)
    peaks = []
    for count in (20, 120):
        settings = small(trajectories=count, steps=60)
        with placed(0):
            tracemalloc.start()
            collect.run(settings, SCREEN, out=Path(f"data-{count}"))
            peaks.append(tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
    a_shard_bytes = 10 * (61 * 16 + 60 * 8)
    assert 100 * (61 * 16 + 60 * 8) > 5 * a_shard_bytes  # what holding all would add
    assert peaks[1] - peaks[0] < 2 * a_shard_bytes, peaks


def test_equal_settings_are_the_same_however_they_were_given() -> None:
    """A preset's name is no setting."""
    settings = small()
    Path("data").mkdir()
    ShardLog(Path("data"), settings.as_dict())
    collect.check_same(Path("data"), dataclasses.replace(settings, preset="smoke"))
    with pytest.raises(UsageError, match="seed = 0, not 1"):
        collect.check_same(Path("data"), dataclasses.replace(settings, seed=1))
    with pytest.raises(DataError, match="is damaged"):
        Path("data", LOG).write_bytes(b"\xff\n")
        collect.check_same(Path("data"), settings)
