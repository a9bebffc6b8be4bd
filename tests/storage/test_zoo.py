"""The zoo: shipped models found by name, in a checkout and in an installed wheel."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.models import missing_curves, verify
from hjepa_cli.storage import seals, zoo
from hjepa_cli.storage.checkpoints import MODEL_FILE, save_checkpoint


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A zoo of two models, one with curves, beside things that are no models."""
    root = tmp_path / "zoo"
    monkeypatch.setattr(zoo, "zoo_directory", lambda: root)
    for name in ("desktop-h4m2l1", "gym-h4m2l1", "Capital", "-dash", "n" * 65):
        (root / name).mkdir(parents=True)
        digest = save_checkpoint(
            root / name / MODEL_FILE, {"w": np.zeros(3, np.float32)}, {"plant": name}
        )
    (root / "empty").mkdir()
    (root / "README.md").write_text("")
    write_curves(root / "gym-h4m2l1", digest_of(root / "gym-h4m2l1"))
    assert digest
    monkeypatch.chdir(tmp_path)
    return root


def test_the_model_with_the_wanted_strides_is_found_before_the_first(models: Path) -> None:
    for name, strides in (("desktop-h16m4l1", (16, 4, 1)), ("desktop-h4m2l1", (4, 2, 1))):
        architecture = dict(zip("hml", strides, strict=True))
        (models / name).mkdir(exist_ok=True)
        save_checkpoint(
            models / name / MODEL_FILE,
            {"w": np.zeros(3, np.float32)},
            {"plant": "desktop", "architecture": architecture},
        )
    found = [zoo.find_model("desktop", strides) for strides in ((4, 2, 1), (16, 4, 1), (8, 2, 1))]
    assert [path.parent.name for path in found if path] == [
        "desktop-h4m2l1", "desktop-h16m4l1", "desktop-h16m4l1",
    ]  # fmt: skip
    assert zoo.find_model("unknown", (4, 2, 1)) is None


def digest_of(model: Path) -> str:
    return zoo.load_checkpoint(model / MODEL_FILE).digest


def write_curves(model: Path, digest: str) -> None:
    document = {"schema": 2, "digest": {"checkpoint": digest}, "methods": {}}
    (model / zoo.CURVES_FILE).write_text(json.dumps(seals.sealed(document)))


def test_only_valid_names_with_a_model_are_listed(models: Path) -> None:
    assert zoo.list_models() == ["desktop-h4m2l1", "gym-h4m2l1"]


def test_an_absent_zoo_is_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zoo, "zoo_directory", lambda: tmp_path / "gone")
    assert zoo.list_models() == []
    with pytest.raises(MissingInputError, match="no model 'x'"):
        zoo.resolve_model("x")


def test_names_files_and_run_directories_resolve(models: Path, tmp_path: Path) -> None:
    expected = models / "desktop-h4m2l1" / MODEL_FILE
    assert zoo.resolve_model("desktop-h4m2l1") == expected
    assert zoo.resolve_model(str(expected)) == expected
    assert zoo.resolve_model(expected.parent) == expected
    os.symlink(expected, tmp_path / "mine.safetensors")
    assert zoo.resolve_model("mine.safetensors") == Path("mine.safetensors")


def test_a_zoo_name_wins_over_a_local_file(models: Path, tmp_path: Path) -> None:
    (tmp_path / "gym-h4m2l1").write_text("not a model")
    assert zoo.resolve_model("gym-h4m2l1") == models / "gym-h4m2l1" / MODEL_FILE
    assert zoo.resolve_model("./gym-h4m2l1") == Path("gym-h4m2l1")


def test_unknown_names_show_the_choices(models: Path) -> None:
    with pytest.raises(MissingInputError, match="did you mean 'desktop-h4m2l1'") as caught:
        zoo.resolve_model("desktop-h4m2")
    assert caught.value.hint == "hjepa models list"
    with pytest.raises(MissingInputError, match="the zoo has desktop-h4m2l1, gym-h4m2l1"):
        zoo.resolve_model("zzz")


@pytest.mark.parametrize("name", ["../zoo/gym-h4m2l1x", "..", "Capital", "", "gym-h4m2l1/../x"])
def test_names_never_lead_out_of_the_zoo(models: Path, name: str) -> None:
    """They are looked up among the listed names only; as paths they are the user's own."""
    (models.parent / "work").mkdir()
    os.chdir(models.parent / "work")
    with pytest.raises(MissingInputError):
        zoo.resolve_model(name)


def test_a_directory_without_a_model_says_so(models: Path) -> None:
    with pytest.raises(MissingInputError, match=f"holds no {MODEL_FILE}"):
        zoo.resolve_model(models / "empty")


def test_verify_reports_and_notices_damage(models: Path) -> None:
    found = zoo.verify_model("gym-h4m2l1")
    assert found.name == "gym-h4m2l1" and found.metadata == {"plant": "gym-h4m2l1"}
    assert found.digest == digest_of(models / "gym-h4m2l1") and found.has_curves
    assert found.size_bytes == os.path.getsize(models / "gym-h4m2l1" / MODEL_FILE)
    assert not zoo.verify_model("desktop-h4m2l1").has_curves
    data = bytearray((models / "gym-h4m2l1" / MODEL_FILE).read_bytes())
    data[-1] ^= 1
    (models / "gym-h4m2l1" / MODEL_FILE).write_bytes(data)
    with pytest.raises(DataError, match="changed after it was written"):
        zoo.verify_model("gym-h4m2l1")


@pytest.mark.parametrize("curves", ['{"digest": {"checkpoint": "0"}}', '{"digest": 3}', "{}"])
def test_curves_of_another_checkpoint_are_refused(models: Path, curves: str) -> None:
    (models / "gym-h4m2l1" / zoo.CURVES_FILE).write_text(curves)
    with pytest.raises(DataError, match="measured on another checkpoint"):
        zoo.verify_model("gym-h4m2l1")


def test_shipped_models_are_whole() -> None:
    """Every folder of the real zoo has a valid name, a verified model, curves and a card."""
    root = zoo.zoo_directory()
    folders = sorted(entry.name for entry in root.iterdir() if entry.is_dir())
    assert folders == zoo.list_models()
    for name in folders:
        assert zoo.verify_model(name).has_curves
        model = zoo.verify_model(name)
        assert missing_curves(model) == [], "hjepa eval --remeasure"
        methods = set(json.loads((root / name / zoo.CURVES_FILE).read_text())["methods"])
        if model.metadata["architecture"]["kind"] == "hierarchy":
            assert methods >= {"hjepa", "ts-jepa-1", "hold", "oracle"}
        card = (root / name / "README.md").read_text(encoding="utf-8")
        assert card.startswith("---\n"), "a card begins with YAML front matter"


def test_verify_says_which_curves_are_not_those_of_the_defaults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shipped = zoo.zoo_directory() / "desktop-h4m2l1"
    model = Path(shutil.copytree(shipped, tmp_path / "model"))
    curves = json.loads((model / zoo.CURVES_FILE).read_text())
    methods = [name for name in load_settings().methods if not METHODS[name].reflex]
    for change, missing in (
        ({}, []),
        ({"methods": {k: v for k, v in curves["methods"].items() if k != "hold"}}, ["hold"]),
        ({"digest": curves["digest"] | {"protocol": "0" * 64}}, methods),
        ({"digest": curves["digest"] | {"loop_version": 0}}, methods),
    ):
        (model / zoo.CURVES_FILE).write_text(json.dumps(seals.sealed(curves | change)))
        (verified,) = verify(Screen(), [str(model)])["verified"]
        assert verified["missing_curves"] == missing
        said = capsys.readouterr().out
        assert (", ".join(missing) or "those of the default protocol and methods") in said
    (model / zoo.CURVES_FILE).unlink()
    (verified,) = verify(Screen(), [str(model)])["verified"]
    assert verified["missing_curves"] is None and "default" not in capsys.readouterr().out
