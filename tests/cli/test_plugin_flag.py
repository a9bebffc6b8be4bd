"""``--plugin FILE.py``: code runs because the user names it, and runs remember what it was."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import ENVIRONMENT

TWIN = """
import dataclasses
from hjepa_cli import register
from hjepa_cli.core.plants.cartpole.plant import DESKTOP

register(dataclasses.replace(DESKTOP, name="twin"))
"""
BEGIN = """
import sys
from pathlib import Path
from hjepa_cli.config.settings import load_settings
from hjepa_cli.plugins import load_file
from hjepa_cli.storage.runs import Run
load_file(Path("twin.py"))
with Run.create("eval", Path("out"), load_settings(flags={"plant": "twin"}).as_dict()) as run:
    print(run.continue_command)
"""


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("twin.py").write_text(TWIN)


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    """A process of its own: what a plugin registers stays for as long as the process lives."""
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, env=ENVIRONMENT, check=False
    )


def hjepa(line: str) -> subprocess.CompletedProcess[str]:
    return python("-m", "hjepa_cli", *line.split())


def test_a_plugin_is_loaded_before_anything_is_checked() -> None:
    unknown = hjepa("collect --plant twin --dry-run")
    assert unknown.returncode == 2 and "plant = 'twin'; choose one of desktop" in unknown.stderr
    alone = hjepa("collect --plant twin --plugin twin.py --dry-run")
    assert alone.returncode == 2 and 'hint: --config FILE.toml with plant = "twin"' in alone.stderr
    Path("c.toml").write_text('plant = "twin"\n')
    for plant in ("", "--plant twin"):
        planned = hjepa(f"collect {plant} --config c.toml --plugin twin.py --dry-run")
        assert planned.returncode == 0 and "of plant twin" in planned.stdout, planned.stderr
    shown = hjepa("config show plant --config c.toml --plugin twin.py --json")
    assert json.loads(shown.stdout)["values"]["plant"] == {"value": "twin", "from": "c.toml"}
    assert "desktop|gym|quadrotor|recorded|twin" in hjepa("collect --plugin twin.py --help").stdout


@pytest.mark.parametrize(
    ("text", "code", "message"),
    [
        (None, 66, "plugin gone.py does not exist"),
        ("import nothing_of_this_name", 2, "plugin bad.py:1: ModuleNotFoundError"),
        ("x = (", 2, "plugin bad.py:1: SyntaxError"),
        ("\n" + TWIN.replace("twin", "gym"), 2, "plugin bad.py:7: there is a plant called 'gym'"),
    ],
)
def test_a_plugin_that_is_none_is_one_line(text: str | None, code: int, message: str) -> None:
    name = "gone.py" if text is None else "bad.py"
    if text is not None:
        Path(name).write_text(text)
    outcome = hjepa(f"collect --plugin {name} --dry-run")
    assert (outcome.returncode, outcome.stdout) == (code, "")
    first, hint = outcome.stderr.splitlines()
    assert first.startswith(f"error: {message}") and hint.startswith("hint: ")


def test_a_run_is_taken_up_with_its_plugins_alone() -> None:
    begun = python("-c", BEGIN)
    command = "hjepa resume out --plugin twin.py"
    assert begun.stdout == f"{command}\n", begun.stderr
    recorded = json.loads(Path("out/environment.json").read_text())["plugins"]
    assert [(one["name"], len(one["sha256"])) for one in recorded] == [("twin.py", 64)]

    refused = hjepa("resume out --dry-run")
    assert refused.returncode == 2
    assert refused.stderr.splitlines() == [
        "error: out was begun with plugin twin.py, which is not in force",
        f"hint: {command}",
    ]
    assert "twin" not in hjepa("resume out --dry-run --plugin twin.py").stderr

    Path("twin.py").write_text(TWIN + "# another\n")
    changed = hjepa("resume out --dry-run --plugin twin.py")
    assert changed.returncode == 2 and "twin.py, which has changed since" in changed.stderr


@pytest.mark.parametrize("plugins", [1, [1], [{"name": "twin.py"}], [{"name": 1, "sha256": "a"}]])
def test_a_record_of_plugins_that_is_none_is_damaged(plugins: object) -> None:
    python("-c", BEGIN)
    path = Path("out/environment.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"plugins": plugins}))
    assert hjepa("resume out").returncode == 65
