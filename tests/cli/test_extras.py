"""Without an extra: what needs it names the pip line that installs it, the rest works."""

import importlib
import sys

import pytest
from command_line import assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.storage.runs import Run
from hjepa_cli.storage.zoo import list_models

TINY = ["--preset", "smoke", "--trajectories", "2", "--test-trajectories", "1", "--steps", "5"]
COMMANDS = [
    ("h5py", "data export --format hdf5", 66, "hdf5"),
    ("PIL", "data preview", 66, "plot"),
    ("PIL", "view", 66, "plot"),
    ("imageio_ffmpeg", "view --out film.mp4", 66, "video"),
    ("distributed", "collect --cluster local", 2, "cluster"),
]


@pytest.fixture
def shell(tmp_path, monkeypatch, capsys):
    return open_shell(tmp_path, monkeypatch, capsys)


def uninstall(monkeypatch, package):
    """Make a package impossible to import, and forget our modules that have imported it."""
    for name in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    drawing = ("animation", "figures", "live", "pictures")
    for name in ("gym", *(f"output.{name}" for name in drawing)):
        monkeypatch.delitem(sys.modules, f"hjepa_cli.{name}", raising=False)
        monkeypatch.delattr(f"hjepa_cli.{name}", raising=False)


@pytest.mark.parametrize(("package", "command", "code", "extra"), COMMANDS)
def test_a_command_without_its_extra_names_the_line_that_installs_it(
    shell, monkeypatch, package, command, code, extra
):
    if command.startswith("view") and not list_models():
        pytest.skip("no model to look at")
    shell("collect", *TINY, "--quiet")
    uninstall(monkeypatch, package)
    with shell.untouched():
        outcome = shell(*command.split(), "--quiet")
    assert_one_line_error(outcome, code, f'pip install "hjepa[{extra}]"')


def test_the_environments_name_it_too(monkeypatch):
    uninstall(monkeypatch, "gymnasium")
    with pytest.raises(ModuleNotFoundError, match=r'pip install "hjepa\[gym\]"'):
        importlib.import_module("hjepa_cli.gym")


def test_a_report_without_figures_is_a_report(shell, monkeypatch):
    document = {"checkpoint": "c", "seconds": 1.0, "gates": {}}
    with Run.create("train-encoder", None, load_settings().as_dict()) as record:
        record.metric({"step": 1, "loss": 0.5})
        record.finish(document)
    uninstall(monkeypatch, "matplotlib")
    outcome = shell("report", "--figures", "f")
    assert outcome.code == 0 and 'pip install "hjepa[plot]"' in outcome.err
    assert "<img" not in (shell.directory / "report.html").read_text()
