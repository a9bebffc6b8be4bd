"""Benchmarks start, and fail loudly; how fast things are is for a quiet machine to say."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((REPOSITORY / "benchmarks").glob("*.py"))


def load(name: str) -> ModuleType:
    """A benchmark as a module."""
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "benchmarks" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def helps() -> dict[str, tuple[int, str, str]]:
    """Exit code and output of every ``--help``, all started at once."""
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    running = {
        script.name: subprocess.Popen(
            [sys.executable, str(script), "--help"],
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        for script in SCRIPTS
    }
    outputs = {name: process.communicate(timeout=120) for name, process in running.items()}
    return {name: (running[name].returncode, *output) for name, output in outputs.items()}


@pytest.mark.parametrize("name", [script.name for script in SCRIPTS])
def test_help_describes_the_benchmark(name: str, helps: dict[str, tuple[int, str, str]]) -> None:
    code, shown, errors = helps[name]
    missing = re.search(r"No module named '(?!hjepa_cli)(\w+)", errors)
    if missing:
        pytest.skip(f"needs {missing[1]}")
    assert code == 0, errors
    assert "usage:" in shown and name in shown and not errors


def test_there_are_benchmarks() -> None:
    assert {"closed_loop.py", "commands.py", "train_step.py"} <= {path.name for path in SCRIPTS}


def test_a_failing_command_ends_the_benchmark_with_its_code_and_words(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    commands = load("commands")
    monkeypatch.setattr(commands, "SUITES", {"broken": ("collect --plant nonsense", "eval")})
    monkeypatch.setattr(sys, "argv", ["commands.py", "broken"])
    with pytest.raises(SystemExit) as ended:
        commands.main()
    assert ended.value.code == 2
    shown = capfd.readouterr()
    assert "hjepa collect --plant nonsense" in shown.err and "desktop" in shown.err
    assert "in all" not in shown.out


def test_the_training_step_is_measured_against_its_promises() -> None:
    shortfalls = load("train_step").shortfalls
    assert shortfalls({"hjepa": 1.0, "bare": 0.9, "shared": 0.1, "plain": 5.0}) == []
    (slow,) = shortfalls({"bare": 0.95, "plain": 4.99})
    assert "plain" in slow and "4.99" in slow
    (slow,) = shortfalls({"bare": 0.89, "plain": 12.0})
    assert "bare" in slow
