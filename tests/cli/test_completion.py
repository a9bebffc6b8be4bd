"""The shell completes what README says: models, runs, datasets, methods, schedulers, payloads."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ENVIRONMENT

from hjepa_cli.cli import completion
from hjepa_cli.plugins import CODECS, METHODS, SCHEDULERS


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for path in (
        *("data/desktop-0001/dataset.json", "data/desktop-0002/collecting.jsonl"),
        *("runs/eval/0001/config.toml", "runs/eval/0001/result.json"),
        *("runs/eval/0002/config.toml", "runs/train-encoder/0001/config.toml"),
    ):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).touch()


def completed(*words: str) -> list[str]:
    """What bash is offered for the last of some words."""
    env = ENVIRONMENT | {
        "_HJEPA_COMPLETE": "complete_bash",
        "COMP_WORDS": " ".join(["hjepa", *words]),
        "COMP_CWORD": str(len(words)),
    }
    code = "from hjepa_cli.cli.app import main; import sys; sys.argv[0] = 'hjepa'; main()"
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, cwd=os.getcwd(), capture_output=True, text=True
    )
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (["train-encoder", "--dataset", "da"], ["data/desktop-0001"]),
        (["resume", "runs/e"], ["runs/eval/0002"]),
        (["eval", "--methods", "hjepa,oracle-"], ["hjepa,oracle-teacher"]),
        (["scale", "--scheduler", "max-aoi,whi"], ["max-aoi,whittle"]),
        (["scale", "--payload", "int1"], [f"int{n}" for n in range(10, 17)]),
        (["report", "runs/eval/"], ["runs/eval/0001"]),
    ],
)
def test_the_shell_is_offered(words, offered) -> None:
    assert completed(*words) == offered


def test_lists_are_completed_name_by_name_each_once() -> None:
    complete = completion.several(lambda: METHODS)
    assert complete("hjepa,h") == [
        f"hjepa,{name}" for name in METHODS if name.startswith("h") and name != "hjepa"
    ]
    assert set(completion.several(lambda: SCHEDULERS)("")) == set(SCHEDULERS)


def test_payloads_are_names_of_codecs() -> None:
    found = completion.payloads("")
    assert {"float32", "float16", "int2", "int8", "int16"} <= set(found)
    assert all(name in CODECS or name.endswith("-") for name in found), found
    assert completion.payloads("pc") == ["pca-"]


def test_unfinished_runs_and_collections_are_resumable() -> None:
    assert completion.resumable("") == [
        *("runs/eval/0002", "runs/train-encoder/0001", "data/desktop-0002"),
    ]
    assert completion.resumable("data/desktop-0001") == ["data/desktop-0001/"]
