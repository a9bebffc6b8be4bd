"""Which model drives which method: the named one, the newest run's, the zoo's; all of them said."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_evaluate import NO_LAW, Output, checkpoint, elsewhere, quick_encoder, small, untrained

from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.networks.model import build_modules, tensors_of
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, Interrupted, UsageError
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import evaluate, resume, scale
from hjepa_cli.stages.model_set import how_to_train, open_model_set
from hjepa_cli.stages.train_encoder import describe_architecture
from hjepa_cli.storage import zoo
from hjepa_cli.storage.checkpoints import save_checkpoint
from hjepa_cli.storage.runs import Run

FITTED = [*(name for name in METHODS if METHODS[name].fitted), "local"]

__all__ = ["checkpoint", "elsewhere", "quick_encoder"]  # fixtures


def saved(path: Path, settings: Settings, **architecture: Any) -> Path:
    """A checkpoint of random networks that ``settings`` describe."""
    actor = {"actor_hidden": 16, "actor_dropout": 0.0}
    described = describe_architecture(settings) | actor | architecture
    torch.manual_seed(0)
    metadata = {
        "architecture": described,
        "plant": settings.plant,
        "settings": settings.as_dict(),
        "seed": settings.seed,
        "health": {},
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = plant(settings.plant)
    networks = build_modules(described, kind.action_shape, kind.force_signs)
    save_checkpoint(path, tensors_of(networks), metadata)
    return path


def of_method(method: str, frames: int = 2, **flags: Any) -> Settings:
    given = {"encoder.method": method, "encoder.frames": frames, "encoder.hidden": 16}
    given |= NO_LAW | {key.replace("__", "."): v for key, v in flags.items()}
    return load_settings(flags=given)


def trained(stage: str, settings: Settings, **architecture: Any) -> Path:
    """A finished run below runs/."""
    with Run.create(stage, None, settings.as_dict()) as record:
        path = saved(record.path("model.safetensors"), settings, **architecture)
        record.finish({"checkpoint": path})
    return path


def flat(h: int) -> Path:
    settings = of_method("jepa", hierarchy__h=h, hierarchy__m=h, hierarchy__l=h)
    return trained("train-hierarchy", settings, kind="flat", h=h, m=h, l=h)


def test_every_method_finds_its_model(tmp_path: Path, quick_encoder: None) -> None:
    shipped = untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    old = trained("train-encoder", of_method("supervised"))
    newer = trained("train-encoder", of_method("supervised"))
    deeper = flat(5)
    saved(tmp_path / "zoo" / "raw" / "model.safetensors", of_method("supervised", 4))
    other = of_method("supervised", plant="gym")
    trained("train-encoder", dataclasses.replace(other, plant="gym"))
    (newer.parent / "note").write_text("runs may hold more")
    names = ("hjepa", "supervised-2", "ts-jepa-5", "supervised-4", "oracle", "autoencoder-2")
    output = Output()
    result = evaluate.run(small(methods=names, steps=6), output.screen, checkpoint="hierarchy")
    raw = tmp_path / "zoo" / "raw" / "model.safetensors"
    assert result["checkpoints"] == {
        "hjepa": str(shipped),
        "supervised-2": str(newer),
        "ts-jepa-5": str(deeper),
        "supervised-4": str(raw),
    }
    assert list(result["skipped"]) == ["autoencoder-2"]
    assert f"supervised-2 is of model {newer}" in output.text.replace("\n", "")
    # Each under the digest of its own model, beside it where that may be written.
    for path, name in ((newer, "supervised-2"), (deeper, "ts-jepa-5")):
        kept = json.loads((path.parent / "curves.json").read_text())
        assert list(kept["methods"]) == [name]
    assert not (old.parent / "curves.json").exists() and not (raw.parent / "curves.json").exists()
    bits = {name: entry["bits_per_transmission"] for name, entry in result["methods"].items()}
    assert bits == {
        **{name: 2064 for name in ("hjepa", "ts-jepa-5", "oracle")},
        **{f"supervised-{kappa}": kappa * 64 * 128 * 24 for kappa in (2, 4)},
    }


def test_a_figure_shows_models_of_one_training_seed(quick_encoder: None) -> None:
    pytest.importorskip("matplotlib")
    trained(
        "train-hierarchy", load_settings(flags={"encoder.hidden": 16, **NO_LAW}), kind="hierarchy"
    )
    other = trained("train-encoder", of_method("supervised", seed=3))
    options = small(methods=("zero", "supervised-2", "oracle"), steps=6)
    result = evaluate.run(options, Output().screen)  # a table says which model is whose
    assert result["training_seeds"] == {"zero": 0, "supervised-2": 3}
    result = evaluate.run(options, Output().screen, figure=True)  # what nobody named is left out
    assert list(result["methods"]) == ["zero", "oracle"]
    assert "train-encoder --method supervised" in result["skipped"]["supervised-2"]
    with pytest.raises(DataError, match="zero: 0, supervised-2: 3"):
        evaluate.run(options, Output().screen, figure=True, further=[other])


def test_all_cached_curves_are_found_again(
    tmp_path: Path, quick_encoder: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    saved(tmp_path / "zoo" / "raw" / "model.safetensors", of_method("supervised"))
    options = small(methods=("zero", "supervised-2"), steps=6)
    first = evaluate.run(options, Output().screen)
    monkeypatch.setattr(Bench, "entry", None)  # would fail if anything were measured
    assert evaluate.run(options, Output().screen)["methods"] == first["methods"]


def test_one_level_comes_after_a_hierarchy_and_before_the_zoo(tmp_path: Path) -> None:
    shipped = untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    options, screen = small(methods=("zero",)), Output().screen
    assert open_model_set(options, screen, None, None).path == shipped
    lonely = flat(2)
    assert open_model_set(options, screen, None, None).path == lonely
    settings = load_settings(flags={"encoder.hidden": 16, **NO_LAW})
    several = trained("train-hierarchy", settings, kind="hierarchy", h=4, m=2, l=1)
    flat(3)
    assert open_model_set(options, screen, None, None).path == several


def test_a_resumed_run_keeps_its_models(
    tmp_path: Path, quick_encoder: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    first = trained("train-encoder", of_method("supervised"))
    options, out = small(methods=("supervised-2", "zero-true"), steps=6), tmp_path / "here"

    def interrupted(bench: Bench, method: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Bench, "entry", interrupted)
        with pytest.raises(Interrupted):
            evaluate.run(options, Output().screen, out=out)
    trained("train-encoder", of_method("supervised", seed=1))
    result = resume.run(out, Output().screen)
    assert result["checkpoints"]["supervised-2"] == str(first.absolute())


@pytest.mark.parametrize("law", ["duty", "equal", "scheduled"])
def test_scale_drives_raw_frames_as_late_as_they_are(
    law: str, tmp_path: Path, quick_encoder: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    trained("train-encoder", of_method("supervised"))
    driven = []
    entry = Bench.entry

    def spy(bench: Bench, method: Any) -> dict[str, Any]:
        driven.append(method.name)
        return entry(bench, method)

    monkeypatch.setattr(Bench, "entry", spy)
    options = small(methods=("supervised-2", "local"), steps=8)
    radio = dataclasses.replace(options.radio, snr_db="20:30:10", law=law)
    options = dataclasses.replace(options, radio=radio)
    if law == "scheduled":
        with pytest.raises(UsageError, match="law scheduled fits packets into slots; supervised-2"):
            scale.run(options, Output().screen)
        return
    result = scale.run(options, Output().screen)
    expected = ["supervised-2+3", "supervised-2+2"] if law == "duty" else ["supervised-2"]
    assert [name for name in driven if name != "local"] == expected
    rows = {(row["method"], row["snr_db"]): row for row in result["rows"]}
    assert rows["local", 20.0]["devices"] is None
    assert "sends nothing" in rows["local", 20.0]["reason"]
    if law == "equal":  # a slot never carries a whole picture
        assert rows["supervised-2", 30.0]["devices"] == 0


def test_local_needs_no_link(checkpoint: Path, quick_encoder: None) -> None:
    result = evaluate.run(
        small(methods=("local", "hold"), acceptable_score=0.01),
        Output().screen,
        checkpoint=str(checkpoint),
    )
    local = result["methods"]["local"]
    scores = {point["score"] for point in local["gap_curve"] + local["delivery_curve"]}
    assert scores == {local["score"]} and local["bits_per_transmission"] == 0
    assert (local["tolerance_gap_steps"], local["tolerance_gap_censored"]) == (8.0, True)
    assert (local["tolerance_p"], local["tolerance_p_ci95"]) == (1 / 8, [1 / 8, 1 / 8])
    # Of the same actor with every packet, but for the rounding of what is sent.
    assert local["score"] == pytest.approx(result["methods"]["hold"]["score"], abs=0.2)
    hopeless = evaluate.run(
        small(methods=("local",), acceptable_score=50.0),
        Output().screen,
        checkpoint=str(checkpoint),
    )["methods"]["local"]
    assert (hopeless["tolerance_gap_steps"], hopeless["tolerance_p"]) == (0.0, 1.0)


def test_closed_forms_drive_plants_of_any_number_of_states(tmp_path: Path) -> None:
    """Only what sends four states needs four; the others were refused for the quadrotor, too."""
    settings = load_settings("quadrotor", flags={"encoder.hidden": 16})
    path = saved(tmp_path / "model.safetensors", settings, kind="hierarchy")
    tiny = small(methods=("linear", "state-kf", "state-48", "local"), steps=6, horizon=6)
    options = dataclasses.replace(
        settings,
        methods=tiny.methods,
        protocol=dataclasses.replace(
            tiny.protocol, start=settings.protocol.start, noise=settings.protocol.noise
        ),
        collect=dataclasses.replace(
            settings.collect,
            trajectories=8,
            test_trajectories=2,
            steps=12,
            clean_trajectories=2,
            clean_steps=8,
        ),
    )
    result = evaluate.run(options, Output().screen, checkpoint=str(path))
    bits = {name: entry["bits_per_transmission"] for name, entry in result["methods"].items()}
    assert bits == {"linear": 2064, "state-kf": 2064, "local": 0}
    assert all(np.isfinite(entry["nmae"]).all() for entry in result["methods"].values())
    assert result["skipped"] == {"state-48": "state-48 is for plants of four states"}
    for name in bits:
        assert how_to_train(name, options) == "hjepa train-hierarchy --preset quadrotor"


def test_closed_forms_are_measured_like_any_method(checkpoint: Path, quick_encoder: None) -> None:
    options = small(methods=(*FITTED, "hold"), steps=10)
    collected = dataclasses.replace(options.collect, trajectories=4, test_trajectories=2, steps=12)
    result = evaluate.run(
        dataclasses.replace(options, collect=collected), Output().screen, checkpoint=str(checkpoint)
    )
    entries = result["methods"]
    bits = {name: entry["bits_per_transmission"] for name, entry in entries.items()}
    assert bits == {"linear": 2064, "state-kf": 2064, "state-48": 48, "local": 0, "hold": 2064}
    assert entries["linear"]["gap_curve"][0] == entries["hold"]["gap_curve"][0]
    for name in FITTED:
        assert np.isfinite(entries[name]["nmae"]).all() and len(entries[name]["nmae"]) == 25


@pytest.mark.parametrize(
    ("method", "flags", "command"),
    [
        ("supervised-2", {}, "hjepa train-encoder --method supervised --frames 2"),
        ("supervised-4", {}, "hjepa train-encoder --method supervised --frames 4"),
        ("autoencoder-2", {}, "hjepa train-encoder --method autoencoder --frames 2"),
        ("ts-jepa-3", {}, "hjepa train-hierarchy --h 3"),
        ("ts-jepa-1", {}, "hjepa train-hierarchy"),
        ("linear", {}, "hjepa train-hierarchy"),
        ("ts-jepa-2", {"plant": "gym"}, "hjepa train-hierarchy --preset gym --h 2"),
    ],
)
def test_the_command_that_trains_a_method(method: str, flags: dict[str, Any], command: str) -> None:
    assert how_to_train(method, load_settings(flags=flags)) == command


def test_baselines_in_the_zoo_are_no_default_model(tmp_path: Path) -> None:
    saved(tmp_path / "zoo" / "a-baseline" / "model.safetensors", of_method("autoencoder"))
    assert zoo.find_model("desktop") is None
    shipped = untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    assert zoo.find_model("desktop") == shipped


def test_curves_of_a_baseline_are_complete_with_its_own_method(
    tmp_path: Path, quick_encoder: None
) -> None:
    from hjepa_cli.core.evaluation import curves
    from hjepa_cli.stages.models import missing_curves

    path = saved(tmp_path / "zoo" / "raw" / "model.safetensors", of_method("supervised"))
    assert missing_curves(zoo.verify_model("raw")) == ["supervised-2"]
    measured = evaluate.run(small(methods=("supervised-2",), steps=6), Output().screen)
    subject = open_model_set(
        load_settings(flags={"methods": ["supervised-2"]}), Output().screen, str(path), None
    )
    curves.write(path.with_name("curves.json"), subject.digest, measured["methods"])
    assert missing_curves(zoo.verify_model("raw")) == []


def test_a_model_of_another_preset_is_said_to_be_one(tmp_path: Path, quick_encoder: None) -> None:
    """Its recipe and law count, whatever the preset's are: results are not the preset's."""
    shipped = untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    for preset, said in (("paper", True), (None, False)):
        output = Output()
        options = load_settings(preset, flags={"methods": ["hjepa"]})
        open_model_set(options, output.screen, str(shipped), None)
        assert ("trained by preset default" in output.stderr.getvalue()) is said


def test_a_model_on_another_encoder_is_said_to_be_one(tmp_path: Path, quick_encoder: None) -> None:
    shipped = untrained(tmp_path / "zoo" / "hierarchy" / "model.safetensors")
    deeper, said = flat(5), "is on another encoder than"
    settings, output = small(methods=("hjepa", "ts-jepa-5")), Output()
    ours, theirs = zoo.load_checkpoint(shipped), zoo.load_checkpoint(deeper)
    encoder = {name: of for name, of in ours.tensors.items() if name.startswith("encoder.")}
    save_checkpoint(deeper, theirs.tensors | encoder, theirs.metadata)
    open_model_set(settings, output.screen, str(shipped), None)
    assert said not in output.stderr.getvalue()
    changed = {name: (of * 1.5).astype(of.dtype) for name, of in encoder.items()}
    save_checkpoint(deeper, theirs.tensors | changed, theirs.metadata)
    open_model_set(settings, output.screen, str(shipped), None)
    assert f"{deeper} {said} {shipped}" in output.stderr.getvalue()
    assert "hjepa train-hierarchy --preset smoke --h 5" in output.stderr.getvalue()
