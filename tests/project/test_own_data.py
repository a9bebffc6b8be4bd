"""The page about recordings is run: its recording, its commands, its Python."""

import re

import pytest
from command_line import ROOT, open_shell

PAGE = (ROOT / "docs" / "own_data.md").read_text(encoding="utf-8")
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
