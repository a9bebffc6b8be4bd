"""What users install: the wheel is complete by itself, and the set-up script says what it needs."""

import os
import subprocess
import sys
import textwrap
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from hjepa_cli import __version__
from hjepa_cli.storage.zoo import list_models

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory holding only what the wheel puts into site-packages."""
    built = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(built)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(built / "site")
    return built / "site"


def test_the_wheel_holds_the_package_and_nothing_else(site: Path) -> None:
    information = f"hjepa-{__version__}.dist-info"
    assert sorted(entry.name for entry in site.iterdir()) == [information, "hjepa_cli"]
    assert (site / "hjepa_cli" / "py.typed").is_file()
    assert (site / information / "licenses" / "LICENSE").is_file()
    assert "hjepa = hjepa_cli.cli.app:main" in (site / information / "entry_points.txt").read_text()
    metadata = Parser().parsestr((site / information / "METADATA").read_text(encoding="utf-8"))
    assert metadata["License-Expression"] == "Apache-2.0"
    assert metadata["Requires-Python"] == ">=3.11"


def test_the_wheel_works_without_the_repository(site: Path) -> None:
    """Presets and zoo are found in the installed package, from any directory."""
    code = """
        import hjepa_cli
        from hjepa_cli.config.settings import PRESETS, load_settings
        from hjepa_cli.storage import zoo
        print(hjepa_cli.__file__, zoo.zoo_directory(), sep="\\n")
        for preset in PRESETS:
            load_settings(preset)
        for model in zoo.list_models():
            print(zoo.verify_model(model).name)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        cwd="/",
        env=os.environ | {"PYTHONPATH": str(site)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    package = site / "hjepa_cli"
    assert done.stdout.split() == [
        str(package / "__init__.py"),
        str(package / "zoo"),
        *list_models(),
    ]


def test_extras_build_on_each_other() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    everything = set(extras) - {"all", "test", "lint", "docs"}
    (in_all,) = extras["all"]
    assert set(in_all.removeprefix("hjepa[").removesuffix("]").split(",")) == everything
    assert extras["test"][0].startswith("hjepa[plot")


@pytest.mark.parametrize(
    ("script", "message"),
    [
        ('[ "$1" = -V ] && echo Python 3.9.1; exit 1', "Python 3.11 or newer is needed"),
        (
            f'case "$2" in venv | pip) exit 1 ;; esac; exec "{sys.executable}" "$@"',
            "has neither venv nor pip",
        ),
        (None, "not found; install Python 3.11 or newer"),
    ],
    ids=["old Python", "no venv, no pip", "no Python"],
)
def test_set_up_names_what_is_missing(tmp_path: Path, script: str | None, message: str) -> None:
    """One line, before anything is installed; run on a copy, so that .venv stays as it is."""
    (tmp_path / "scripts").mkdir()
    for name in ("scripts/venv", "pyproject.toml"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    python = tmp_path / "python"
    if script is not None:
        python.write_text(f"#!/bin/sh\n{script}\n")
        python.chmod(0o755)
    done = subprocess.run(
        ["sh", "scripts/venv", "test"],
        cwd=tmp_path,
        env=os.environ | {"PYTHON": str(python)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert message in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / ".venv").exists()
