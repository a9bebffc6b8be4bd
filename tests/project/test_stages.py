"""Stages are registered objects: light to list, called by the inputs that they declare."""

import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, block, open_shell

from hjepa_cli import plugins
from hjepa_cli.cli.commands import LOOKS
from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import Interrupted
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import STAGES

PLUGIN = block("plugins.md", "Stage(")


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.fixture
def square(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The plugin's stage, for one test."""
    monkeypatch.setattr(STAGES, "_added", {})
    monkeypatch.setattr(plugins, "_sources", list(plugins._sources))
    Path("square.py").write_text(PLUGIN)
    yield plugins.load_file(Path("square.py"))
    for name in [name for name in sys.modules if name.startswith("hjepa_plugin_square")]:
        del sys.modules[name]


def test_listing_stages_imports_nothing_heavy():
    code = (
        "import sys; from hjepa_cli.plugins import STAGES;"
        "print(*STAGES); assert all(STAGES[name].help for name in STAGES);"
        "assert not {'torch', 'numpy', 'scipy', 'pymunk'} & set(sys.modules), sys.modules"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    pipeline = (
        "tune-law collect train-encoder train-hierarchy train-reflex train-fusion eval scale "
        "survive reproduce bench-link"
    )
    assert (done.returncode, done.stdout) == (0, f"{pipeline}\n"), done.stderr


@pytest.mark.parametrize("name", plugins.BUILT_IN["stage"])
def test_a_stage_runs_and_plans_with_the_inputs_that_it_declares(name):
    """All are optional keywords of both functions, which are where a call would look for them."""
    stage = STAGES[name]
    assert stage.name == name
    for function in (stage.run, stage.plan):
        signature = inspect.signature(function.function)
        keywords = {
            key: parameter
            for key, parameter in signature.parameters.items()
            if parameter.kind is parameter.KEYWORD_ONLY
        }
        assert keywords.keys() - {*LOOKS} == {"out", *stage.inputs}
        assert all(parameter.default is not parameter.empty for parameter in keywords.values())


def test_a_stage_of_a_plugin_is_resumed_with_what_it_was_given(square, shell):
    """A file by its place, a flag as it was, the settings of the run."""
    Path("three").write_text("3")
    Path("stop").touch()
    settings = load_settings("smoke", flags={"seed": 7})
    with pytest.raises(Interrupted) as caught:
        STAGES["square"].run(
            settings, Screen(quiet=True), out=Path("r"), number=Path("three"), negative=True
        )
    assert caught.value.hint == "hjepa resume r --plugin square.py"
    with shell.untouched():
        plan = shell("resume", "r", "--dry-run", "--json").document["plan"]
    assert plan["work"][1:] == ["square, negative = True"] and plan["reads"][0].endswith("three")
    Path("stop").unlink()
    assert shell("resume", "r", "--json").document == {"square": -9, "seed": 7}


def test_a_run_of_a_stage_that_is_not_there_is_named(square, shell, monkeypatch):
    """What is missing is its plugin, as long as that may be; then the stage."""
    Path("stop").touch()
    Path("three").write_text("3")
    with pytest.raises(Interrupted):
        STAGES["square"].run(
            load_settings("smoke"), Screen(quiet=True), out=Path("r"), number=Path("three")
        )
    monkeypatch.setattr(STAGES, "_added", {})
    assert_one_line_error(shell("resume", "r"), 65, "'square'")
    monkeypatch.setattr(plugins, "_sources", [])
    assert_one_line_error(shell("resume", "r"), 2, "hint: hjepa resume r --plugin square.py")
