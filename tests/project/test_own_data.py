"""The page about recordings is run: its recording, its commands, its Python."""

import json
import re

import numpy as np
import pytest
from command_line import ROOT, assert_one_line_error, open_shell

from hjepa_cli.storage import seals

PAGE = (ROOT / "docs/tutorials/own_data.md").read_text(encoding="utf-8")
TRAINED = ("train-encoder", "train-hierarchy", "eval")  # small here, to see that they run


@pytest.mark.slow
def test_the_page_runs_as_it_is_written(tmp_path, monkeypatch, capsys):
    pytest.importorskip("PIL")
    shell = open_shell(tmp_path, monkeypatch, capsys)
    recording, python = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(recording, "own_data.md", "exec"), {})
    lines = re.findall(r"^    hjepa (.+)$", PAGE, re.MULTILINE)
    assert len(lines) == 7
    documents = {}
    for line in lines:
        words = line.split()
        small = ["--preset", "smoke"] if words[0] in TRAINED else []
        outcome = shell(*words, *small, "--json")
        assert outcome.code == 0, (line, outcome)
        documents[" ".join(words[:2] if words[0] == "data" else words[:1])] = outcome.document
    imported = documents["data import"]
    assert imported["limits"] == [2.0, 2.0] and imported["step_s"] == 0.02
    assert imported["frame_shape"] == [32, 64, 3] and not imported["states"]
    assert (tmp_path / "robot.png").read_bytes().startswith(b"\x89PNG")
    health = documents["train-encoder"]["health"]
    assert health["probe_r2"] == {} and health["action_r2"] is not None
    assert not [name for name in documents["train-encoder"]["gates"] if "probe" in name]
    assert documents["eval"]["offline"] and {"hjepa", "hold"} <= documents["eval"]["methods"].keys()
    counts = [row["devices"] for row in documents["scale"]["rows"]]
    assert counts == sorted(counts) and counts[0] > 0
    assert documents["scale"]["slot_s"] == 0.02
    exec(compile(python, "own_data.md", "exec"), {})
    assert "recorded-0001 (" in capsys.readouterr().out
    assert shell("report", "runs/robot-encoder", "runs/eval/0001", "--quiet").code == 0

    exported = shell("data", "export", "--out", "robot.npz", "--pixels", "--quiet")
    assert exported.code == 0, exported
    with np.load(tmp_path / "robot.npz") as columns:  # of a plant without states
        assert "state" not in columns
        assert columns["pixels"].shape == (len(columns["action"]), 32, 64, 3)

    stressed = (
        *("eval", "--preset", "smoke"),
        *("--dataset", "data/robot", "--checkpoint", "runs/robot"),
    )
    outcome = shell(*stressed, "--stress", "light=0.2+noise=40,audit", "--json")
    (first, *others), nominal = outcome.document["conditions"], outcome.document["methods"]
    assert first["condition"] == "light=0.2+noise=40" and len(others) == 22, "pictures alone"
    assert first["methods"].keys() == nominal.keys()
    assert first["methods"]["hold"]["nmae"] != nominal["hold"]["nmae"]
    assert shell("report", "runs/eval/0002", "--quiet").code == 0
    for row, why in (("mass", "recordings have none"), ("lihgt", "did you mean 'light'")):
        assert_one_line_error(shell(*stressed, "--stress", row), 2, why)
    assert_one_line_error(shell(*stressed, "--false-alarm", "0.1"), 2, "simulated pictures")
    late = (*stressed, "--delay-steps", "10", "--dry-run")
    assert_one_line_error(shell(*late), 2, "--delay-steps is about closed loops")

    refused = shell("export", "runs/robot", "--to", "bundle")
    assert_one_line_error(refused, 2, "learned from recordings")
    assert "exporting" not in refused.err
    assert not (tmp_path / "bundle").exists()

    newest = tmp_path / "data" / "recorded-0001" / "dataset.json"  # the one from Python
    (tmp_path / "data" / "recorded-0001").rename(newest.parent.with_name("another robot"))
    outcome = shell(*stressed[:3], "--checkpoint", "runs/robot", "--dataset", "data/another robot")
    words = ("than dataset data/another robot has", "--dataset 'data/another robot', or pass")
    assert_one_line_error(outcome, 65, *words)

    path = tmp_path / "runs" / "eval" / "0001" / "result.json"
    result = json.loads(path.read_text())
    del result["methods"]["hold"]["steps_within"]
    path.write_text(json.dumps(seals.sealed(result)))
    assert_one_line_error(shell("report", "runs/eval/0001"), 65, "steps_within")


def test_the_import_of_the_page_is_without_a_warning(tmp_path, monkeypatch, capsys):
    """Its action k leads from picture k to k + 1: nothing says otherwise."""
    shell = open_shell(tmp_path, monkeypatch, capsys)
    exec(compile(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0], "own_data.md", "exec"), {})
    (line,) = re.findall(r"^    hjepa (data import .+)$", PAGE, re.MULTILINE)
    outcome = shell(*line.split())
    assert outcome.code == 0 and "warning" not in outcome.err
    assert "alignment: no offset fits the pictures clearly better than 0" in outcome.err
    with np.load(tmp_path / "recording.npz") as recorded:
        largest = ", ".join(f"{most:.4g}" for most in np.abs(recorded["actions"]).max(axis=(0, 1)))
    words = f"50 pictures/s (from --fps), limits 2, 2; largest recorded {largest}\n"
    assert words in outcome.err


@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=["run", "plan"])
@pytest.mark.parametrize("command", ["train-reflex", "train-fusion", "tune-law", "survive", "view"])
def test_what_needs_equations_is_refused(tmp_path, monkeypatch, capsys, command, dry):
    shell = open_shell(tmp_path, monkeypatch, capsys)
    with shell.untouched():
        outcome = shell(command, "--plant", "recorded", *dry)
    assert_one_line_error(outcome, 2, "a recorded plant has no equations")
