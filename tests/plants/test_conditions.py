"""Devices that differ from those of the training data."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from hjepa_cli.api import drive, load_model
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.evaluation.curves import Digest
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Block, Simulator
from hjepa_cli.core.plants.conditions import Disturbed, actual_camera, actual_plant, vary
from hjepa_cli.core.plants.control_law import control_of
from hjepa_cli.core.plants.frames import Camera
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import collect
from hjepa_cli.stages.inputs import render
from hjepa_cli.stages.view import film, make_link
from hjepa_cli.storage.zoo import zoo_directory

STATES = np.array([[0.01, 0.2, 0.1, -0.3], [-0.02, 0.0, -0.2, 1.0]])


def settings(preset: str = "default", seed: int = 0, **conditions: float) -> Settings:
    changes = {f"conditions.{name}": value for name, value in conditions.items()}
    return load_settings(preset, flags={"seed": seed, "control.gains_n": [], **changes})


def devices(options: Settings) -> System:
    return actual_plant(options.plant, options.conditions)


def camera(options: Settings) -> Camera:
    return actual_camera(options)


def test_nominal_conditions_change_nothing() -> None:
    assert devices(settings()) is plant("desktop")
    assert not isinstance(camera(settings()), Disturbed)


def test_light_scales_what_the_camera_sees() -> None:
    nominal = plant("desktop").camera().render(STATES).astype(float)
    for light in (0.5, 1.3):
        seen = camera(settings(light=light)).render(STATES)
        assert np.abs(seen - np.clip(light * nominal, 0, 255)).max() <= 0.501


def test_noise_is_as_wide_as_it_says_and_the_same_for_the_same_states() -> None:
    noisy = camera(settings(light=0.5, camera_noise=4.0))
    nominal = 0.5 * plant("desktop").camera().render(STATES).astype(float)
    seen = noisy.render(STATES)
    errors = (seen - nominal)[nominal > 30]
    # Rounding adds 1/12; a standard deviation from n values is good to σ / √(2n).
    width = np.sqrt(4.0**2 + 1 / 12)
    assert abs(errors.std() - width) < 4 * width / np.sqrt(2 * errors.size)
    assert abs(errors.mean()) < 4 * width / np.sqrt(errors.size)
    assert (camera(settings(light=0.5, camera_noise=4.0)).render(STATES) == seen).all()
    assert (noisy.render(STATES + 1e-9) != seen).any()
    other = camera(settings(seed=1, light=0.5, camera_noise=4.0))
    assert (other.render(STATES) != seen).any()


def test_longer_poles_fall_slower_and_look_longer() -> None:
    longer, lean = devices(settings(pole_length=1.2)), 1e-4
    for kind in (plant("desktop"), longer):
        rate = kind.unstable_rate_rad_s
        simulation = kind.simulation(1)
        # The growing mode of the linearised pole without force: θ̇ = λ θ.
        simulation.states = np.array([[0.0, 0.0, lean, rate * lean]])
        for _ in range(50):
            simulation.step(np.zeros(1))
        assert simulation.states[0, 2] / lean == pytest.approx(
            np.exp(rate * 50 * kind.step_s), rel=2e-3
        )
    ratio = longer.unstable_rate_rad_s / plant("desktop").unstable_rate_rad_s
    assert ratio == pytest.approx(1.2**-0.5)
    seen, nominal = (camera(settings(pole_length=length)).render(STATES) for length in (1.2, 1.0))
    changed = (seen != nominal).any(-1)
    assert 0 < changed.sum() < 0.02 * changed.size  # the ends of the poles, and nothing else


def test_longer_poles_of_what_has_none_are_refused() -> None:
    with pytest.raises(UsageError, match="quadrotor"):
        devices(settings("quadrotor", pole_length=1.2))


def test_a_controller_that_does_not_know_does_worse() -> None:
    """The oracle predicts with the nominal equations: exact at 1.0 only."""

    def score(**conditions: float) -> float:
        simulator = Simulator(settings(**conditions), None)
        block = Block("oracle", (Point("gap", 120.0),), 0, 16)
        return float(block.compute(simulator, lambda steps: None).score.mean())

    assert score(pole_length=0.7) < score() - 0.1


def test_digests_are_those_of_before_unless_conditions_changed() -> None:
    shipped = json.loads((zoo_directory() / "desktop-h4m2l1" / "curves.json").read_text())["digest"]
    law = control_of(load_model("desktop-h4m2l1").metadata["settings"], "the zoo")
    under_its_law = dataclasses.replace(load_settings(), control=law)
    assert Digest.of(shipped["checkpoint"], under_its_law).protocol == shipped["protocol"]
    digests = {
        Digest.of(None, settings(**conditions)).protocol
        for conditions in ({}, {"light": 0.8}, {"camera_noise": 1.0}, {"pole_length": 0.9})
    }
    assert len(digests) == 4


def test_rollouts_to_predict_are_of_the_devices_and_training_is_nominal() -> None:
    nominal, longer = settings(), settings(pole_length=1.5)
    rows = range(6)
    for split in ("train", "test"):
        same = [generate(options, split, rows).states for options in (nominal, longer)]
        np.testing.assert_array_equal(*same)
    one, other = (generate(options, "clean", rows) for options in (nominal, longer))
    np.testing.assert_array_equal(one.states[:, 0], other.states[:, 0])
    assert abs(one.states[:, 20] - other.states[:, 20]).max() > 0.01
    now, moved = other.states[:, 1].astype(float), devices(longer).simulation(6)
    moved.states = now
    moved.step(plant("desktop").teacher()(now))  # which does not know of the longer poles
    np.testing.assert_allclose(moved.states, other.states[:, 2], atol=1e-5)


def test_every_training_trajectory_has_a_light_and_a_noise_of_its_own() -> None:
    frames = np.full((300, 2, 16, 16, 3), 100, dtype=np.uint8)

    def varied(split: str = "train", seed: int = 0, **spreads: float) -> np.ndarray:
        changes = {f"encoder.{name}": value for name, value in spreads.items()}
        options = load_settings(flags={"seed": seed, **changes})
        return vary(frames, options.encoder, options.seed, split)

    assert varied() is frames
    lights = varied(light_spread=0.3).astype(float) / 100
    assert (lights == lights[:, :1, :1, :1, :1]).all()  # one light for a trajectory
    light = lights[:, 0, 0, 0, 0]
    # Uniform in 0.7 … 1.3: the standard deviation is 0.6 / √12.
    assert light.min() >= 0.7 and light.max() <= 1.3
    assert abs(light.mean() - 1) < 4 * 0.6 / np.sqrt(12 * 300)
    assert light.min() < 0.73 and light.max() > 1.27
    noisy = varied(camera_noise=8.0).astype(float)
    widths = noisy.std(axis=(1, 2, 3, 4))
    assert widths.max() < 9 and widths.max() > 7 and widths.min() < 1
    assert abs(widths.mean() - 4) < 4 * 8 / np.sqrt(12 * 300) + 0.05  # rounding adds a little
    assert (noisy[:, 0] != noisy[:, 1]).any(), "noise is drawn anew for every picture"
    again = varied(light_spread=0.3, camera_noise=8.0)
    np.testing.assert_array_equal(again, varied(light_spread=0.3, camera_noise=8.0))
    for other in ({"split": "test"}, {"seed": 1}):
        assert (again != varied(light_spread=0.3, camera_noise=8.0, **other)).any()
    np.testing.assert_array_equal(frames, 100)


def test_both_training_stages_see_the_same_varied_pictures() -> None:
    options = load_settings(flags={"encoder.light_spread": 0.3, "encoder.camera_noise": 4.0})
    recorded = generate(settings(), "train", range(3))
    for split in ("train", "test"):
        pictures = plant("desktop").camera().render(recorded.states.reshape(-1, 4))
        whole = pictures.reshape(*recorded.states.shape[:2], *pictures.shape[1:])
        expected = vary(whole, options.encoder, options.seed, split)
        seen = render(recorded, options, Screen(quiet=True), split)
        np.testing.assert_array_equal(seen.frames.numpy(), expected)


def test_curves_know_of_which_devices_a_dataset_s_clean_rollouts_are(tmp_path) -> None:
    """A dataset of longer poles answers for a nominal evaluation under a digest of its own."""

    def digest(options: Settings, dataset: str | None) -> str:
        recorded = load_dataset(tmp_path / dataset).settings if dataset else None
        return Digest.of(None, options, recorded).protocol

    smoke, longer = settings("smoke"), settings("smoke", pole_length=1.5)
    for name, options in (("nominal", smoke), ("longer", longer)):
        collect.run(options, Screen(quiet=True), out=tmp_path / name)
    assert digest(smoke, "nominal") == digest(smoke, None)
    assert digest(longer, "longer") == digest(longer, None)
    assert len({digest(one, of) for one in (smoke, longer) for of in ("nominal", "longer")}) == 4


def test_a_film_is_of_the_devices_that_are_driven() -> None:
    changes = {"conditions.pole_length": 1.5, "protocol": "paper", "protocol.steps": 40}
    options, model = load_settings(flags=changes), load_model("desktop-h4m2l1")
    link = make_link(options, model, 2, 20.0, 0.05, 4.0)
    probe = torch.zeros(257, 4, dtype=torch.float64)
    shot = film("hold", options, model, link, probe, Screen(quiet=True))
    driven = drive("hold", model=model, gap_steps=4.0, devices=2, settings=changes)
    np.testing.assert_array_equal(shot.states, driven["states"])
    nominal = drive(
        "hold",
        model=model,
        gap_steps=4.0,
        devices=2,
        settings={"protocol": "paper", "protocol.steps": 40},
    )
    assert abs(nominal["states"] - shot.states).max() > 0.01
