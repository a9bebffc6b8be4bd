"""Files of every schema that was ever written are read for good; newer ones are refused.

``tests/fixtures`` holds one file per format and version, never to be changed.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.core.evaluation import curves
from hjepa_cli.errors import DataError, Unsealed
from hjepa_cli.storage import checkpoints, runs

FIXTURES = Path(__file__).parents[1] / "fixtures"


def test_a_fixture_for_every_version() -> None:
    for pattern, newest in (
        ("checkpoint-{}.safetensors", checkpoints.SCHEMA),
        ("dataset-{}", datasets.SCHEMA),
        ("curves-{}.json", curves.SCHEMA),
    ):
        for version in range(1, newest + 1):
            assert (FIXTURES / pattern.format(version)).exists(), (pattern, version)
    for version in range(1, runs.SCHEMA):  # the newest is what every test of runs writes
        assert (FIXTURES / f"run-{version}").exists()


def test_checkpoint_1() -> None:
    found = checkpoints.load_checkpoint(FIXTURES / "checkpoint-1.safetensors")
    assert found.metadata == {"note": "written by schema 1"}
    np.testing.assert_array_equal(found.tensors["a"], np.arange(6.0).reshape(2, 3))
    assert found.tensors["b"] == 7


def test_dataset_1() -> None:
    found = datasets.load_dataset(FIXTURES / "dataset-1", "desktop")
    assert {name: len(found.split(name)) for name in found.splits} == {
        "train": 1,
        "test": 1,
        "clean": 1,
    }
    np.testing.assert_array_equal(found.split("train").states.ravel(), np.arange(24.0))


def test_curves_1() -> None:
    path = FIXTURES / "curves-1.json"
    digest = curves.Digest(**json.loads(path.read_text())["digest"])
    with pytest.warns(Unsealed, match="has no seal"):
        assert curves.read(path, digest) == {}  # no cache
    entry = curves.read(path, digest, named=True)["hjepa"]
    assert entry["tolerance_gap_steps"] == 12.5


def test_curves_2() -> None:
    path = FIXTURES / "curves-2.json"
    digest = curves.Digest(**json.loads(path.read_text())["digest"])
    assert curves.read(path, digest)["hjepa"]["tolerance_gap_steps"] == 12.5


def test_run_1_had_no_inputs() -> None:
    found = runs.read_environment(FIXTURES / "run-1")
    assert found["schema"] == 1 and found["inputs"] == {}
    assert (found["stage"], found["preset"]) == ("train-encoder", "smoke")


def test_run_2_had_no_settings() -> None:
    found = runs.read_environment(FIXTURES / "run-2")
    assert found["schema"] == 2 and found["inputs"]["dataset"]["path"] == "/data/desktop-0001"


def test_newer_files_are_refused_with_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "curves.json"
    document = json.loads((FIXTURES / "curves-1.json").read_text())
    path.write_text(json.dumps(document | {"schema": curves.SCHEMA + 1}))
    shutil.copytree(FIXTURES / "dataset-1", tmp_path / "data")
    manifest = tmp_path / "data" / datasets.MANIFEST
    newer = json.loads(manifest.read_text()) | {"schema": datasets.SCHEMA + 1}
    manifest.write_text(json.dumps(newer))
    run = tmp_path / runs.ENVIRONMENT
    run.write_text(json.dumps({"schema": runs.SCHEMA + 1, "stage": "eval", "inputs": {}}))
    for read in (
        lambda: curves.read(path, curves.Digest(None, "")),
        lambda: datasets.load_dataset(tmp_path / "data"),
        lambda: runs.read_environment(tmp_path),
    ):
        with pytest.raises(DataError, match=r"has schema \d; this hjepa reads up to \d") as caught:
            read()
        assert caught.value.hint == "pip install --upgrade hjepa"
