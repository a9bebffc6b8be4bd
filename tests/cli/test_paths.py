"""Paths may have any bytes, and locales may have few characters."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, ROOT, Shell, open_shell

from hjepa_cli.errors import shell
from hjepa_cli.storage import files
from hjepa_cli.storage.runs import read_environment

LATIN = os.fsdecode(b"sc\xe9")  # not UTF-8
NAMES = [LATIN, "two\nlines", "it's [red] \\x41", "é θ̇", "\u202eabc"]


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("name", NAMES)
def test_any_bytes_are_a_path_wherever_one_is_written(hjepa, monkeypatch, name) -> None:
    """In records, results, logs, reports, messages and hints."""
    evaluation = ("eval", "--preset", "smoke", "--methods", "oracle", "--config", f"{name}.toml")
    (hjepa.directory / f"{name}.toml").write_text("[protocol]\nsteps = 40\nhorizon = 10\n")
    monkeypatch.setattr(sys, "argv", ["hjepa", *evaluation])
    collected = hjepa("collect", "--preset", "smoke", "--trajectories", "2", "--out", name)
    assert collected.code == 0, collected
    done = hjepa(*evaluation, "--dataset", name, "--out", f"e{name}", "--json")
    assert done.code == 0 and done.document["curves"] == f"e{name}/curves.json", done
    recorded = read_environment(hjepa.directory / f"e{name}")
    assert recorded["command"][-1] == f"{name}.toml"
    assert recorded["inputs"]["dataset"]["path"] == str(hjepa.directory / name)
    json.loads((hjepa.directory / f"e{name}" / "environment.json").read_text("utf-8"))
    for command in (
        ["resume", f"e{name}"],
        ["report", f"e{name}", "--out", f"{name}.html"],
        ["data", "verify", name],
        ["data", "info", name, "--json"],
        ["data", "preview", name],
        ["data", "export", name, "--no-pixels"],
    ):
        assert (again := hjepa(*command)).code == 0, again
    refused = hjepa(*evaluation, "--dataset", name, "--out", f"e{name}", "--seed", "1")
    hint = refused.err.splitlines()[-1].removeprefix("hint: ").partition(" shows it")[0]
    shown = hint.replace("hjepa", f"{sys.executable} -m hjepa_cli", 1)
    env = ENVIRONMENT | {"PYTHONPATH": str(ROOT)}
    subprocess.run(["bash", "-c", shown], check=True, capture_output=True, env=env)


def test_commands_in_hints_are_what_a_shell_takes_back() -> None:
    for word in [*NAMES, "", "-x", "a b", "\x00".replace("\x00", "\x01")]:
        printed = subprocess.run(
            ["bash", "-c", f"printf %s {shell([word])}"], capture_output=True, check=True
        ).stdout
        assert printed == os.fsencode(word) and shell([word]).isprintable()


@pytest.mark.parametrize("words", [["models", "info", "é"], ["eval", "--out", "é", "--quiet"]])
def test_a_locale_of_few_characters_is_enough(tmp_path: Path, words: list[str]) -> None:
    poor = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    small = ["--preset", "smoke", "--methods", "oracle"] if "eval" in words else []
    done = subprocess.run(
        [sys.executable, "-m", "hjepa_cli", *words, *small],
        cwd=tmp_path,
        env=ENVIRONMENT | poor,
        capture_output=True,
        check=False,
    )
    assert done.returncode == (66 if "info" in words else 0), done
    assert b"Traceback" not in done.stderr and b"unexpected" not in done.stderr
    if "eval" in words:  # whose result names its files
        assert (tmp_path / "é" / "result.json").exists()


def test_json_keeps_bytes_of_paths_and_no_other_broken_text(tmp_path: Path) -> None:
    files.write_json(tmp_path / "a.json", {"path": LATIN})
    assert files.read_json(tmp_path / "a.json") == {"path": LATIN}
    assert files.jsonable({"path": Path(LATIN), "x": float("nan")}) == {"path": LATIN, "x": None}
    (tmp_path / "b.json").write_text('{"path": "\\ud800"}')
    with pytest.raises(files.DataError):
        files.read_json(tmp_path / "b.json")
