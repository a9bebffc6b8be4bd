"""Data in which nothing moves are refused at the start; what is undefined is null, not NaN."""

import json
from pathlib import Path

import pytest
import torch
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.networks import health
from hjepa_cli.output.tables import measured
from hjepa_cli.stages.train_encoder import judge

STILL = """
[collect]
trajectories = 6
test_trajectories = 4
clean_trajectories = 2
steps = 40
x_m = 0.0
x_dot_m_s = 0.0
theta_rad = 0.0
theta_dot_rad_s = 0.0
exploration_n = {exploration_n}
[encoder]
steps = 2
batch_trajectories = 2
batch_frames = 4
gate = false
[actor]
epochs = 1
"""


@pytest.fixture
def hjepa(tmp_path, monkeypatch, capsys) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("frames", ["rendered", "stored"])
@pytest.mark.parametrize("stage", ["train-encoder", "train-hierarchy", "train-reflex"])
def test_data_in_which_nothing_moves_are_refused_at_the_start(hjepa, stage, frames) -> None:
    Path("c.toml").write_text(STILL.format(exploration_n=0.0))
    assert hjepa("collect", "--config", "c.toml", "--frames", frames, "--out", "data").code == 0
    with hjepa.untouched():
        failed = hjepa(stage, "--config", "c.toml", "--dataset", "data", "--quiet")
    assert_one_line_error(failed, 65, "all states of split 'train' are equal")


def test_movements_that_no_camera_sees_are_refused_before_training(hjepa) -> None:
    Path("c.toml").write_text(STILL.format(exploration_n=1e-9))
    assert hjepa("collect", "--config", "c.toml", "--out", "data").code == 0
    failed = hjepa("train-encoder", "--config", "c.toml", "--dataset", "data", "--quiet")
    assert_one_line_error(failed, 65, "all frames of split 'train' are equal")


def test_what_is_undefined_is_none() -> None:
    chance = torch.Generator().manual_seed(0)
    z, states = torch.randn(2, 50, 8, generator=chance), torch.randn(2, 50, 2, generator=chance)
    states[1, :, 1] = 0.5  # held out, a state that is the same everywhere
    r2 = health.probe_r2(z[0], states[0], z[1], states[1], ("moves", "rests"))
    assert r2["rests"] is None and isinstance(r2["moves"], float)
    assert health.nrmse(torch.ones(3), torch.zeros(3)) is None
    assert health.nrmse(torch.ones(3), torch.ones(3)) == 0.0
    assert measured(None) == "undefined"


def test_a_gate_of_what_is_undefined_is_missed() -> None:
    settings = load_settings("smoke")
    report = {
        "probe_r2": {"x": None, "x_dot": 0.99, "theta": 0.99, "theta_dot": 0.99},
        "effective_rank": 9.0,
        "action_sensitivity": 1.0,
        "actor_nrmse": None,
    }
    gates = judge(report, settings)
    assert {name for name, gate in gates.items() if not gate["passed"]} == {
        *("probe_r2_x", "actor_nrmse"),
    }


def test_an_encoder_with_an_undefined_measure_is_saved(hjepa, monkeypatch) -> None:
    """Health goes into the checkpoint, into metrics.csv and on the screen."""
    Path("c.toml").write_text(STILL.format(exploration_n=9.0))
    assert hjepa("collect", "--config", "c.toml", "--out", "data").code == 0
    monkeypatch.setattr(health, "nrmse", lambda *_: None)
    done = hjepa("train-encoder", "--config", "c.toml", "--dataset", "data", "--out", "run")
    assert done.code == 0 and "undefined" in done.out, done
    gates = json.loads(Path("run/result.json").read_text())["gates"]
    assert gates["actor_nrmse"]["value"] is None and gates["actor_nrmse"]["passed"] is False
    assert hjepa("models", "info", "run").code == 0
    assert hjepa("report", "run").code == 0 and hjepa("resume", "run").code == 0
