"""NaN and infinities are refused where they come in, and leave nothing behind."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.plants.conditions import Disturbed
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.core.plants.named import Camera, CartPole, plant
from hjepa_cli.core.plants.stress import parse
from hjepa_cli.core.plants.system import Simulation, System
from hjepa_cli.errors import NumericalError

BAD = [np.nan, np.inf, -np.inf]
NAMES = ["desktop", "gym", "quadrotor"]
each_plant = pytest.mark.parametrize("name", NAMES)
each_value = pytest.mark.parametrize("bad", BAD)


def refused(what: str, value: float, action: Callable[[], Any]) -> None:
    message = f"{what} is {value}; expected finite numbers"
    with pytest.raises(NumericalError, match=f"^{re.escape(message)}$"):
        action()


def states_of(system: System, devices: int = 3) -> NDArray[np.float64]:
    size = devices, len(system.state_names)
    return np.random.default_rng(1).uniform(-0.05, 0.05, size)


def spoiled(values: NDArray[Any], bad: float) -> NDArray[Any]:
    """Return ``values`` with something else in the last place of the second row."""
    copy = values.copy()
    copy.reshape(len(values), -1)[1, -1] = bad
    return copy


def place_of(values: NDArray[Any]) -> str:
    return str([1, *(size - 1 for size in values.shape[1:])])


@each_plant
@each_value
def test_a_camera_draws_no_garbage(name: str, bad: float) -> None:
    system = plant(name)
    states = states_of(system)
    wrong = spoiled(states, bad)
    for camera in (system.camera(), Disturbed(system.camera(), parse("light=0.8+noise=2"), seed=0)):
        before = camera.render(states)
        refused(f"states{place_of(states)}", bad, lambda camera=camera: camera.render(wrong))
        refused(f"state{[states.shape[1] - 1]}", bad, lambda c=camera: c.sketch_px(wrong[1]))
        refused(f"states{place_of(states)}", bad, lambda camera=camera: frames_of(camera, wrong))
        assert (camera.render(states) == before).all()


@each_value
def test_the_public_camera_draws_no_garbage(bad: float) -> None:
    refused("states[0, 0]", bad, lambda: Camera("desktop").render([[bad, 0, 0, 0]]))


@each_plant
@each_value
def test_a_simulation_goes_on_as_if_nothing_had_been_asked(name: str, bad: float) -> None:
    system = plant(name)
    states, forces_n = states_of(system), np.ones((3, *system.action_shape))
    ours, untouched = system.simulation(3), system.simulation(3)

    def ask(simulation: Simulation) -> None:
        def place() -> None:
            simulation.states = spoiled(states, bad)

        refused(f"states{place_of(states)}", bad, place)
        wrong_n = spoiled(forces_n, bad)
        refused(f"forces_n{place_of(forces_n)}", bad, lambda: simulation.step(wrong_n))

    for simulation in (ours, untouched):
        simulation.states = states
    for _ in range(3):
        ask(ours)
        for simulation in (ours, untouched):
            simulation.step(forces_n)
        assert (ours.states == untouched.states).all()


@each_plant
@each_value
def test_equations_and_teachers_answer_no_garbage(name: str, bad: float) -> None:
    system = plant(name)
    states, forces_n = states_of(system), np.ones((3, *system.action_shape))
    wrong, wrong_n = spoiled(states, bad), spoiled(forces_n, bad)
    refused(f"states{place_of(states)}", bad, lambda: system.advance(wrong, forces_n))
    refused(f"forces_n{place_of(forces_n)}", bad, lambda: system.advance(states, wrong_n))
    refused(f"states{place_of(states)}", bad, lambda: system.teacher()(wrong))


@each_value
def test_one_cart_pole_stays_as_it_was(bad: float) -> None:
    ours, untouched = CartPole("desktop", seed=3), CartPole("desktop", seed=3)

    def place() -> None:
        ours.state = [0.0, bad, 0.0, 0.0]

    refused("states[0, 1]", bad, place)
    refused("forces_n[0]", bad, lambda: ours.step(bad))
    refused("noise[2]", bad, lambda: ours.step(1.0, noise=[0, 0, bad, 0]))
    refused("noise", bad, lambda: ours.step(1.0, noise=bad))
    assert (ours.state == untouched.state).all()
    assert (ours.step(1.0) == untouched.step(1.0)).all()


@each_value
@torch.inference_mode()
def test_a_model_answers_no_garbage(bad: float) -> None:
    architecture = {
        "kind": "reflex", "embedding": 8, "frame_input": "difference", "centre": True,
        "mirror": "exact", "actor_hidden": 8, "actor_dropout": 0.0, "longest_age": 3,
        "forces_at_once": 1,
    }  # fmt: skip
    decay = {"gain": 1.0, "tau_steps": 2.0}
    metadata = {
        "architecture": architecture,
        "plant": "desktop",
        "settings": {"encoder": {"precision": "fp32"}},
        "reflex": decay | {"law": decay | {"gains_n": [[1.0] * 4]}},
    }
    model = Model(build_modules(architecture), metadata, "", "cpu")
    frames = np.random.default_rng(0).integers(0, 256, (2, 2, 64, 128, 3), np.uint8)
    z = model.encode(frames)
    wrong = torch.from_numpy(spoiled(z.numpy(), bad))
    for answer in (model.act, model.actor, model.law):
        before = answer(z)
        refused("z[1, 7]", bad, lambda answer=answer: answer(wrong))
        assert torch.equal(answer(z), before)
    pictures: Any = spoiled(frames.astype(np.float32), bad)
    refused("frames[1, 1, 63, 127, 2]", bad, lambda: model.encode(pictures))
    assert torch.equal(model.encode(frames), z)
