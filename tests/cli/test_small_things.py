"""What people trip over: marks, notebooks' variables, units, misspelt names, overwritten files."""

import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from command_line import ENVIRONMENT, Shell, assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import planner_of
from hjepa_cli.core.evaluation.load_simulator import hall_coverage
from hjepa_cli.core.networks.model import Model
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.stages import report
from hjepa_cli.storage import tensors
from hjepa_cli.storage.checkpoints import load_checkpoint, save_checkpoint
from hjepa_cli.storage.runs import Run, read_config
from hjepa_cli.storage.zoo import resolve_model


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


def test_settings_may_begin_with_a_byte_order_mark(hjepa) -> None:
    Path("c.toml").write_bytes("\ufeffseed = 7\n".encode())
    shown = hjepa("config", "show", "seed", "--config", "c.toml", "--json").document
    assert shown["values"]["seed"]["value"] == 7
    with Run.create("eval", Path("run"), load_settings().as_dict()) as run:
        pass
    text = run.path("config.toml").read_bytes()
    run.path("config.toml").write_bytes("\ufeff".encode() + text)
    assert read_config(Path("run"))["seed"] == 0


@pytest.mark.parametrize("backend", ["module://matplotlib_inline.backend_inline", "nonsense"])
def test_a_notebook_s_backend_does_not_matter(tmp_path, backend) -> None:
    pytest.importorskip("matplotlib")
    code = (
        "import os, sys; from hjepa_cli.output import figures\n"
        "figures.save(figures.Figure(), __import__('pathlib').Path('a.png'))\n"
        "assert os.environ['MPLBACKEND'] == sys.argv[1]\n"
    )
    env = ENVIRONMENT | {"MPLBACKEND": backend}
    subprocess.run([sys.executable, "-c", code, backend], cwd=tmp_path, env=env, check=True)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_tests_do_not_hide_that_variable() -> None:
    text = (Path(__file__).parents[1] / "conftest.py").read_text()
    assert "MPLBACKEND" not in text


def test_figures_of_two_runs_of_a_stage_have_two_names(hjepa) -> None:
    places = [Path("runs/eval/0001"), Path("runs/eval/0002"), Path("other/0001")]
    for place in (*places, Path("runs/scale/0001")):
        stage = "scale" if "scale" in str(place) else "eval"
        with Run.create(stage, place, load_settings().as_dict()) as run:
            run.finish({})
    assert report.figure_names([*places, Path("runs/scale/0001")]) == {
        places[0]: "eval-0001",
        places[1]: "eval-0002",
        places[2]: "eval-0001-2",
        Path("runs/scale/0001"): "scale",
    }
    assert report.figure_names(places[:1]) == {places[0]: "eval"}


def test_a_large_foreign_file_is_not_read_beyond_its_header(tmp_path) -> None:
    path = tmp_path / "video.mp4"
    with open(path, "wb") as file:
        file.write(b"\0\0\0\x20ftypisom")
        file.truncate(3 * 2**30)  # sparse
    tracemalloc.start()
    with pytest.raises(DataError, match="damaged or not a safetensors file"):
        load_checkpoint(path)
    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_a_file_longer_than_its_tensors_is_not_read(tmp_path, monkeypatch) -> None:
    save_checkpoint(tmp_path / "a", {"x": np.zeros(3, np.float32)}, {})
    with open(tmp_path / "a", "ab") as file:
        file.write(b"\0" * 100)
    monkeypatch.setattr(
        "hjepa_cli.storage.checkpoints.read_bytes", lambda *_, **__: pytest.fail("read whole")
    )
    with pytest.raises(DataError, match="do not fill it"):
        load_checkpoint(tmp_path / "a")
    assert tensors.METADATA_KEY == "hjepa"


@pytest.mark.parametrize(
    ("command", "suggestion"),
    [
        ("config show protocol.step", "did you mean 'protocol.steps'?"),
        ("config show protocl", "did you mean 'protocol'?"),
        ("eval --methods hjpea", "did you mean 'hjepa'?"),
        ("scale --scheduler max-aio --law scheduled", "did you mean 'max-aoi'?"),
        ("view --methods holdd", "did you mean 'hold'?"),
        ("compare --methods hjpea runs", "did you mean 'hjepa'?"),
        ("scale --bandwidth-mhz 20e6", "did you mean 20?"),
    ],
)
def test_the_nearest_is_suggested(hjepa, command, suggestion) -> None:
    assert_one_line_error(hjepa(*command.split()), 2, suggestion)


def test_the_nearest_planner_is_suggested() -> None:
    model = Model.load(resolve_model("desktop-h4m2l1"), "cpu")
    with pytest.raises(UsageError, match="did you mean 'hjepa'"):
        planner_of(model, "hjpea")


def test_a_number_that_fits_no_unit_has_no_suggestion(hjepa) -> None:
    failed = hjepa("scale", "--bandwidth-mhz", "1e30")
    assert failed.code == 2 and "did you mean" not in failed.err


def test_a_hall_that_covers_few_says_so(hjepa) -> None:
    """Devices whose power does not suffice are why there are none."""
    Path("c.toml").write_text("[radio]\npower_dbm = -40.0\n[protocol]\nsteps = 40\n")
    hall = {"radio.topology": "hall", "radio.law": "scheduled"}
    share = hall_coverage(load_settings(config="c.toml", flags=hall).radio, 20.0, 0, 64, 20e6)
    assert share < 0.2 < hall_coverage(load_settings(flags=hall).radio, 20.0, 0, 64, 20e6)
    words = ["--law", "scheduled", "--topology", "hall", "--scheduler", "round-robin"]
    words += ["--methods", "hold-true", "--preset", "smoke", "--config", "c.toml", "--snr", "20"]
    result = hjepa("scale", *words, "--json").document
    (row,) = result["rows"]
    assert row["coverage"] == share
    if row["devices"] == 0:
        assert f"{share:.0%} of the hall's devices reach 20 dB" in row["reason"]
    shown = hjepa("resume", result["csv"].rpartition("/")[0])
    assert f"power suffices at mean fading: {share:.0%} at 20 dB" in shown.out


def test_sizes_of_conditions_are_those_of_things() -> None:
    for values, wrong in (
        ({"conditions.pole_length": 1e300}, "pole_length"),
        ({"conditions.pole_length": 1e-300}, "pole_length"),
        ({"conditions.light": 1e300}, "light"),
        ({"conditions.camera_noise": 1e300}, "camera_noise"),
        ({"encoder.camera_noise": 1e300}, "camera_noise"),
    ):
        with pytest.raises(UsageError, match=wrong):
            load_settings(flags=values)


@pytest.mark.parametrize(
    ("command", "fragment"),
    [
        ("view --devices 300", "300 devices: a GIF of 1920 × 1440 has room for 24"),
        ("view --out a.txt", "no animation format '.txt'"),
        ("view --fps 90", "a GIF holds at most 50"),
        ("view --live", "--live needs a terminal"),
        ("data export data --split train --out a.x", "no export format"),
    ],
)
def test_a_dry_run_refuses_what_the_command_would(hjepa, command, fragment) -> None:
    with hjepa.untouched():
        for flags in ([], ["--dry-run"]):
            assert_one_line_error(hjepa(*command.split(), *flags), 2, fragment)
