"""Laws as data: what they play, who plays them, and what is no law."""

from pathlib import Path

import numpy as np
import pytest
from command_line import Shell, assert_one_line_error, open_shell

from hjepa_cli.config.schema import ControlSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.plants.control_law import ceiling_law, control_law, control_of
from hjepa_cli.core.plants.linear import gains_at_rest
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, UsageError

STIFF = (-126.9, -57.1, -157.9, -9.4)  # N per m, m/s, rad, rad/s of desktop


@pytest.fixture
def hjepa(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Shell:
    return open_shell(tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("name", ["desktop", "quadrotor"])
def test_a_law_is_minus_k_x_clipped(name: str) -> None:
    kind = plant(name)
    gains_n = 1.5 * gains_at_rest(kind.teacher(), len(kind.state_names))
    law = control_law(kind, ControlSettings(gains_n=tuple(gains_n.ravel().tolist())))
    states = 0.1 * np.random.default_rng(0).normal(size=(3, 5, len(kind.state_names)))
    expected = np.clip(-states @ gains_n.T, -kind.force_limit_n, kind.force_limit_n)
    found = law(states)
    assert found.shape == (3, 5, *kind.action_shape)
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=1e-12)
    assert (law(states[1, 2]) == found[1, 2]).all()  # whatever the batch
    assert np.abs(law(1e3 * states)).max() == kind.force_limit_n


def test_without_gains_it_is_the_teacher() -> None:
    kind = plant("gym")
    assert control_law(kind, ControlSettings()) is kind.teacher()
    with pytest.raises(UsageError, match="needs a law tuned for plant gym") as caught:
        ceiling_law(kind, ControlSettings())
    assert "tune-law --plant gym" in str(caught.value.hint)


def test_what_is_no_law_is_refused(hjepa: Shell) -> None:
    Path("c.toml").write_text("[control]\ngains_n = [1.0, 2.0]\n")
    refused = hjepa("collect", "--config", "c.toml", "--trajectories", "20")
    assert_one_line_error(refused, 2, "control.gains_n", "2 numbers", "needs 4", "tune-law")
    Path("c.toml").write_text("[control]\ngains_n = [0.0, 0.0, 0.0, 0.0]\n")
    refused = hjepa("collect", "--config", "c.toml", "--trajectories", "20")
    assert_one_line_error(refused, 2, "does not hold plant desktop", "a factor of 1.0", "tune-law")
    with pytest.raises(DataError, match="holds no valid control law"):
        control_of({"control": {"gains_n": "many"}}, "a.toml")


def test_labels_are_the_laws_and_the_teacher_drives_every_second_device() -> None:
    options = load_settings(flags={"control.gains_n": list(STIFF), "collect.exploration_n": 0.0})
    kind, drawn = plant("desktop"), generate(options, "train", range(6))
    law, now = control_law(kind, options.control), drawn.states[:, 1:]
    np.testing.assert_allclose(drawn.teacher_n, law(now), atol=1e-3)
    np.testing.assert_allclose(drawn.applied_n[1::2], kind.teacher()(now[1::2]), atol=1e-3)
    steps = drawn.applied_n.shape[1]
    wrong_n = np.abs(drawn.applied_n[::2] - law(now[::2]))  # what drives does not know the state
    assert (wrong_n[:, : steps // 5].max(axis=1) > 1.0).all()
    assert wrong_n[:, 4 * steps // 5 :].max() < 0.01  # until a packet comes
    assert (np.diff(wrong_n, axis=1).min(axis=1) < -0.5).all()
    widths = np.array(options.collect.half_widths)
    assert (np.abs(drawn.states[::2, 0]) <= 0.5 * widths + 1e-6).all()
    assert (np.abs(drawn.states[1::2, 0]) > 0.5 * widths).any()
    np.testing.assert_array_equal(generate(options, "train", range(3, 5)).states, drawn.states[3:5])
    clean = generate(options, "clean", range(2))
    np.testing.assert_allclose(clean.applied_n, clean.teacher_n, atol=1e-6)


def test_rivals_play_the_law_and_the_yardstick_the_teacher() -> None:
    options = load_settings(
        flags={"control.gains_n": list(STIFF), "control.ceiling_gains_n": [2 * k for k in STIFF]}
    )
    kind, states = plant("desktop"), np.array([[0.01, 0.0, 0.02, 0.1]])
    law, everyone = control_law(kind, options.control), np.ones(1, bool)
    expected = {
        "oracle": law(states),
        "hold-true": law(states),
        "ceiling": ceiling_law(kind, options.control)(states),
        "oracle-teacher": kind.teacher()(states),
        "optimal": kind.teacher()(states),
    }
    for name, force_n in expected.items():
        controller = build_driver(name, options, None).controller(1)
        np.testing.assert_allclose(controller.act(everyone, states), force_n, err_msg=name)
