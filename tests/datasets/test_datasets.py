"""Datasets: complete or absent, equal bytes for equal inputs, every kind of damage refused."""

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_dataset import write_dataset

from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.core.datasets.dataset import (
    MANIFEST,
    Trajectories,
    find_newest_dataset,
    load_dataset,
    open_directory,
)
from hjepa_cli.errors import (
    DataError,
    HjepaError,
    LockedError,
    MissingInputError,
    NumericalError,
    StorageError,
    UsageError,
)
from hjepa_cli.storage import files, seals
from hjepa_cli.storage import tensors as arrays

SETTINGS = {"seed": 3, "collect": {"trajectories": 7, "exploration_n": 4.0}}
CAMERA = {"version": 1, "window_m": [0.6, 0.3]}


def trajectories(count: int, steps: int, *, frames: bool = False, seed: int = 0) -> Trajectories:
    generator = np.random.default_rng(seed)

    def normal(*shape: int) -> np.ndarray:
        return generator.normal(size=shape).astype(np.float32)

    images = generator.integers(0, 256, (count, steps + 1, 64, 128, 3), np.uint8)
    return Trajectories(
        states=normal(count, steps + 1, 4),
        applied_n=normal(count, steps),
        teacher_n=normal(count, steps),
        frames=images if frames else None,
    )


def splits(*, frames: bool = False) -> dict[str, Trajectories]:
    sizes = {"train": (7, 5), "test": (2, 5), "clean": (3, 6)}
    return {
        name: trajectories(count, steps, frames=frames, seed=count)
        for name, (count, steps) in sizes.items()
    }


def write(directory: Path, *, plant: str = "desktop", frames: bool = False) -> datasets.Dataset:
    directory.mkdir(parents=True, exist_ok=True)
    return write_dataset(
        directory,
        settings=SETTINGS,
        splits=splits(frames=frames),
        plant_name=plant,
        camera_manifest=CAMERA,
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "dataset").path


def reseal(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change the manifest and give it the right digest again: a lie, not an accident."""
    manifest = json.loads((path / MANIFEST).read_text())
    change(manifest)
    (path / MANIFEST).write_text(json.dumps(seals.sealed(manifest)))


def read_all(path: Path) -> None:
    dataset = load_dataset(path, "desktop")
    for name in dataset.splits:
        dataset.split(name)


@pytest.mark.parametrize("frames", [False, True])
def test_round_trip(tmp_path: Path, frames: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also across shards: 7 trajectories in shards of 3."""
    monkeypatch.setattr(datasets, "SHARD_TRAJECTORIES", 3)
    monkeypatch.setattr(datasets, "SHARD_TRAJECTORIES_WITH_FRAMES", 3)
    written = write(tmp_path / "d", frames=frames)
    loaded = load_dataset(tmp_path / "d", "desktop")
    assert loaded == written
    assert loaded.plant == "desktop" and loaded.settings == SETTINGS and loaded.camera == CAMERA
    assert loaded.frames == ("stored" if frames else "rendered")
    assert len(loaded.splits["train"]["shards"]) == 3
    for name, expected in splits(frames=frames).items():
        found = loaded.split(name)
        assert (len(found), found.steps) == (len(expected), expected.steps)
        assert found.tensors().keys() == expected.tensors().keys()
        for key, array in expected.tensors().items():
            assert found.tensors()[key].dtype == array.dtype
            assert found.tensors()[key].flags.writeable  # torch warns about arrays that are not
            np.testing.assert_array_equal(found.tensors()[key], array)


def test_slicing_takes_trajectories() -> None:
    whole = trajectories(5, 4, frames=True)
    part = whole[1:3]
    assert len(part) == 2 and part.steps == 4
    np.testing.assert_array_equal(part.states, whole.states[1:3])
    np.testing.assert_array_equal(part.frames, whole.frames[1:3])


def test_equal_inputs_give_equal_directories(tmp_path: Path) -> None:
    """Nothing of time, place or memory layout gets in."""
    write(tmp_path / "a")
    mixed = {
        name: Trajectories(np.asfortranarray(t.states), t.applied_n, t.teacher_n)
        for name, t in splits().items()
    }
    os.utime(tmp_path / "a" / MANIFEST, (0, 0))
    (tmp_path / "elsewhere").mkdir()
    write_dataset(
        tmp_path / "elsewhere",
        settings=dict(reversed(SETTINGS.items())),
        splits=mixed,
        plant_name="desktop",
        camera_manifest=CAMERA,
    )
    assert os.listdir(tmp_path / "a") and sorted(os.listdir(tmp_path / "a")) == sorted(
        os.listdir(tmp_path / "elsewhere")
    )
    for name in os.listdir(tmp_path / "a"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "elsewhere" / name).read_bytes()
    text = (tmp_path / "a" / MANIFEST).read_text()
    assert str(tmp_path) not in text and "time" not in text


def test_manifest_lists_the_sha256_of_every_shard(path: Path) -> None:
    manifest = json.loads((path / MANIFEST).read_text())
    listed = {
        shard["name"]: shard["sha256"]
        for split in manifest["splits"].values()
        for shard in split["shards"]
    }
    on_disk = {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in path.glob("shard-*.safetensors")
    }
    assert listed == on_disk and len(listed) == 3
    assert manifest["schema"] == 1 and manifest["seed"] == 3 and manifest["config"] == SETTINGS


def test_the_manifest_is_written_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    write_bytes = files.write_bytes

    def traced(target: Path, data: bytes) -> None:
        written.append(target.name)
        write_bytes(target, data)

    monkeypatch.setattr(files, "write_bytes", traced)
    write(tmp_path / "d")
    assert written == [*(f"shard-{n:05d}.safetensors" for n in range(3)), MANIFEST]


def test_an_interrupted_collection_is_no_dataset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise StorageError("disk full")

    monkeypatch.setattr(files, "write_json", refuse)
    with open_directory(tmp_path / "d", "desktop"), pytest.raises(StorageError):
        write(tmp_path / "d")
    assert len(list((tmp_path / "d").glob("shard-*"))) == 3
    with pytest.raises(DataError, match=f"is not an hjepa dataset: no {MANIFEST}"):
        load_dataset(tmp_path / "d")
    with open_directory(tmp_path / "d", "desktop"):
        pass  # is taken up, not refused


def test_a_finished_dataset_is_kept(path: Path) -> None:
    with open_directory(path, "desktop") as directory:
        assert (directory / MANIFEST).exists()
    read_all(path)


def test_foreign_directories_are_refused(tmp_path: Path, path: Path) -> None:
    with pytest.raises(MissingInputError, match="does not exist") as caught:
        load_dataset(tmp_path / "gone")
    assert caught.value.hint == "hjepa collect"
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty is not an hjepa dataset: no dataset\.json") as said:
        load_dataset(tmp_path / "empty")
    assert f"hjepa data import {tmp_path / 'empty'}" in str(said.value.hint)  # if it is a recording
    with pytest.raises(DataError, match="is not an hjepa dataset"):
        load_dataset(path / MANIFEST)
    (tmp_path / "empty" / MANIFEST).write_text('{"format": "other", "schema": 1}')
    with pytest.raises(DataError, match="of another program"):
        load_dataset(tmp_path / "empty")
    with pytest.raises(DataError, match="belongs to plant desktop, not gym"):
        load_dataset(path, "gym")


def test_every_flipped_byte_is_noticed(path: Path) -> None:
    for file in sorted(path.iterdir()):
        good = file.read_bytes()
        for position in range(0, len(good), 41):
            bad = bytearray(good)
            bad[position] ^= 1 << (position % 8)
            file.write_bytes(bad)
            with pytest.raises(DataError, match=r"changed|not valid JSON|not an hjepa|schema"):
                read_all(path)
        file.write_bytes(good)
    read_all(path)


def test_truncated_and_missing_shards_are_refused(path: Path) -> None:
    shard = path / "shard-00001.safetensors"
    good = shard.read_bytes()
    for length in range(0, len(good), 97):
        shard.write_bytes(good[:length])
        with pytest.raises(DataError, match="changed or truncated"):
            read_all(path)
    shard.unlink()
    with pytest.raises(MissingInputError, match=shard.name):
        read_all(path)


def test_exchanged_shards_are_refused(path: Path) -> None:
    shutil.copy(path / "shard-00000.safetensors", path / "shard-00001.safetensors")
    with pytest.raises(DataError, match=r"shard-00001.*sha256 does not match"):
        read_all(path)


def set_first_shard(**changes: Any) -> Callable[[dict[str, Any]], None]:
    return lambda manifest: manifest["splits"]["train"]["shards"][0].update(changes)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda m: m.update(schema=2), "schema 2; this hjepa reads up to 1"),
        (lambda m: m.update(schema=True), "schema True"),
        (lambda m: m.pop("plant"), "lacks fields"),
        (lambda m: m.update(frames="both"), "lacks fields"),
        (lambda m: m.update(splits=[]), "lacks fields"),
        (lambda m: m.update(splits={}), "lacks fields"),
        (lambda m: m["splits"].update(other=m["splits"]["test"]), "lacks fields"),
        (lambda m: m["splits"]["test"].update(shards=[]), "lacks fields"),
        (lambda m: m["splits"]["test"].update(steps=4), "expected float32"),
        (lambda m: m["splits"]["test"].update(steps="5"), "lacks fields"),
        (lambda m: m.update(frames="stored"), "tensor 'frames' is missing"),
        (set_first_shard(trajectories=8), "lacks fields"),
        (lambda m: m["splits"]["train"].update(trajectories=8), "lacks fields"),
        (lambda m: m["splits"]["train"].update(trajectories="7"), "lacks fields"),
        (lambda m: m.update(plant="moon"), "moon"),
        (lambda m: m["config"].update(collect=3), "lacks fields"),
        (set_first_shard(name="../shard-00000.safetensors"), "malformed"),
        (set_first_shard(name="/etc/passwd"), "malformed"),
        (set_first_shard(name="shard-00000.safetensors\n"), "malformed"),
        (set_first_shard(name=3), "malformed"),
        (set_first_shard(sha256=None), "malformed"),
    ],
)
def test_a_manifest_that_lies_is_refused(
    path: Path, change: Callable[[dict[str, Any]], None], match: str
) -> None:
    reseal(path, change)
    with pytest.raises(DataError, match=match):
        read_all(path)


def test_reseal_keeps_a_manifest_valid(path: Path) -> None:
    """Else the tests above would see the wrong digest instead of the lie."""
    reseal(path, lambda manifest: manifest["camera"].update(note="mine"))
    read_all(path)
    assert load_dataset(path).camera["note"] == "mine"


@pytest.mark.parametrize("field", ["states", "applied_n", "teacher_n"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_what_is_not_finite_is_neither_written_nor_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, field: str, value: float
) -> None:
    bad = splits()
    bad["test"].tensors()[field].flat[-1] = value
    (tmp_path / "d").mkdir()

    def attempt() -> None:
        write_dataset(
            tmp_path / "d",
            settings=SETTINGS,
            splits=bad,
            plant_name="desktop",
            camera_manifest=CAMERA,
        )

    last = 5 if field == "states" else 4
    where = f"trajectory 1 of split 'test': '{field}' is not finite from index {last} on"
    with pytest.raises(NumericalError, match=where) as caught:
        attempt()
    assert caught.value.exit_code == 70
    assert not (tmp_path / "d" / MANIFEST).exists()
    with monkeypatch.context() as patch:
        patch.setattr(arrays, "non_finite", lambda _: None)
        attempt()
    with pytest.raises(DataError, match=f"'{field}' holds NaN or an infinity"):
        read_all(tmp_path / "d")


@pytest.mark.parametrize(
    "change",
    [
        {"states": np.zeros((4, 5, 4), np.float32)},
        {"states": np.zeros((4, 6, 4), np.float64)},
        {"applied_n": np.zeros((4, 5, 1), np.float32)},
        {"teacher_n": np.zeros((3, 5), np.float32)},
        {"frames": np.zeros((4, 6, 64, 64, 3), np.uint8)},
        {"frames": np.zeros((4, 6, 64, 128, 3), np.float32)},
    ],
)
def test_misshapen_trajectories_are_not_written(
    tmp_path: Path, change: dict[str, np.ndarray]
) -> None:
    train = dataclasses.replace(trajectories(4, 5), **change)
    with pytest.raises(DataError, match=f"'{next(iter(change))}' is .*; expected"):
        write_dataset(
            tmp_path,
            settings=SETTINGS,
            splits={"train": train},
            plant_name="desktop",
            camera_manifest=CAMERA,
        )
    assert os.listdir(tmp_path) == []


def test_absent_split_lists_the_present_ones(path: Path) -> None:
    with pytest.raises(DataError, match="no split 'validation'; it has clean, test, train"):
        load_dataset(path).split("validation")


def test_open_directory_counts_on_and_locks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with open_directory(None, "gym") as first, open_directory(None, "gym") as second:
        assert (first.name, second.name) == ("gym-0001", "gym-0002")
        with pytest.raises(LockedError), open_directory(first, "gym"):
            pass
    with open_directory(first, "gym"):
        pass


def test_open_directory_refuses_what_is_not_ours(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("precious")
    with (
        pytest.raises(UsageError, match=r"not an hjepa dataset: it holds 'thesis\.tex'"),
        open_directory(tmp_path, "gym"),
    ):
        pass
    assert os.listdir(tmp_path) == ["thesis.tex"]
    with (
        pytest.raises(StorageError, match="cannot write"),
        open_directory(tmp_path / "thesis.tex" / "d", "gym"),
    ):
        pass
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / MANIFEST).write_text("{}")
    with (
        pytest.raises(DataError, match="of another program"),
        open_directory(tmp_path / "d", "gym"),
    ):
        pass


def test_the_newest_of_numbered_datasets_has_the_highest_number(tmp_path: Path) -> None:
    for number in (1, 2, 10000):
        write(tmp_path / f"desktop-{number:04d}")
        os.utime(tmp_path / f"desktop-{number:04d}" / MANIFEST, (900 - number % 10, 900))
    os.utime(tmp_path / "desktop-0001" / MANIFEST, (2000, 2000))  # copied, or touched
    assert find_newest_dataset(tmp_path) == tmp_path / "desktop-10000"


def test_newest_dataset_of_a_plant(tmp_path: Path) -> None:
    assert find_newest_dataset(tmp_path / "data", "desktop") is None
    for age, (name, plant) in enumerate(
        [("desktop-0001", "desktop"), ("mine", "desktop"), ("gym-0001", "gym"), ("bad", "desktop")]
    ):
        write(tmp_path / "data" / name, plant=plant)
        os.utime(tmp_path / "data" / name / MANIFEST, (age, age))
    (tmp_path / "data" / "bad" / MANIFEST).write_text("{")
    (tmp_path / "data" / "desktop-0009").mkdir()
    (tmp_path / "data" / "note.txt").write_text("")
    assert find_newest_dataset(tmp_path / "data", "desktop") == tmp_path / "data" / "mine"
    assert find_newest_dataset(tmp_path / "data", "gym") == tmp_path / "data" / "gym-0001"


def test_errors_are_single_lines(path: Path) -> None:
    (path / MANIFEST).write_text('{"a":\n\nNaN}')
    with pytest.raises(HjepaError) as caught:
        load_dataset(path)
    assert "\n" not in caught.value.message


def test_a_shard_larger_than_its_tensors_is_not_even_read(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = load_dataset(path)
    with open(path / "shard-00000.safetensors", "r+b") as file:
        file.truncate(2**31)  # sparse: it takes no room on the disk
    monkeypatch.setattr(Path, "read_bytes", lambda _: pytest.fail("it was read"))
    with pytest.raises(DataError, match=r"too large: 2147483648 bytes, at most 1049536 are"):
        data.split("train")
