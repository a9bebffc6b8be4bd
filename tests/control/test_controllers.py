"""Controllers: strides by integer-valued embeddings, the oracle, and that nobody sees the plant."""

import dataclasses
import gc
import types
from collections.abc import Callable
from typing import Any

import numpy as np
import pymunk
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.config.checks import without_model
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import LastForce, Oracle, StrideController
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.control.loop import Controller, Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.control.methods.true_state import true_state_driver
from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.named import CartPole, plant, teacher
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.train_encoder import describe_architecture

DESKTOP = plant("desktop")


class Counting:
    """A planner on embeddings [packet, strides so far]: forces spell out where they come from."""

    def __init__(self, stride: int) -> None:
        self.stride = stride

    def plan(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        offsets = torch.arange(self.stride)
        steps = z[:, 1:] * self.stride + offsets
        return 1000 * z[:, :1] + steps, z + torch.tensor([0.0, 1.0])


class Linear:
    """A tiny planner on a 4-d "embedding": the linearised closed loop itself."""

    def __init__(self, stride: int) -> None:
        self.stride = stride
        self.gain = torch.tensor([-20.0, -11.8, -34.9, -3.4])

    def plan(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        forces = (-z @ self.gain).unsqueeze(1).expand(-1, self.stride)
        return forces, z * 0.98**self.stride


@given(
    st.integers(1, 6),
    st.integers(1, 4),
    st.lists(st.lists(st.booleans(), min_size=4, max_size=4), min_size=1, max_size=25),
)
def test_forces_come_from_the_latest_packet_and_its_age(
    stride: int, devices: int, arrivals: list[list[bool]]
) -> None:
    controller = StrideController(Counting(stride), devices)
    packet, age = np.zeros(devices, dtype=int), np.zeros(devices, dtype=int)
    for k, row in enumerate([[True] * 4, *arrivals]):
        delivered = np.array(row[:devices])
        sent = np.arange(devices)[delivered] + 10 * k + 1  # a number no other packet has
        packets = torch.stack([torch.tensor(sent), torch.zeros(len(sent))], dim=1).float()
        forces = controller.act(delivered, packets if len(sent) else None)
        packet[delivered], age[delivered] = sent, 0
        assert forces.tolist() == (1000 * packet + age).tolist()
        age += 1


def test_a_stride_controller_leaves_packets_as_they_are() -> None:
    packets = torch.tensor([[3.0, 0.0], [4.0, 0.0]])
    controller = StrideController(Counting(2), 2)
    for k in range(5):
        controller.act(np.full(2, k == 0), packets if k == 0 else None)
    assert packets.tolist() == [[3.0, 0.0], [4.0, 0.0]]


def test_nothing_is_planned_for_devices_that_are_given_up() -> None:
    planned = []

    class Watched(Counting):
        def plan(self, z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            planned.append(z[:, 0].tolist())
            return super().plan(z)

    controller = StrideController(Watched(2), 3)
    everybody, nobody = np.ones(3, dtype=bool), np.zeros(3, dtype=bool)
    controller.act(everybody, torch.tensor([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]))
    controller.give_up(np.array([False, True, False]))
    forces = [controller.act(nobody, None) for _ in range(4)]
    assert [force[[0, 2]].tolist() for force in forces] == [
        [1000 + k, 3000 + k] for k in (1, 2, 3, 4)
    ]
    # A packet that was on its way is too late to help.
    controller.act(everybody, torch.tensor([[4.0, 0.0], [5.0, 0.0], [6.0, 0.0]]))
    controller.act(nobody, None)
    controller.act(nobody, None)
    assert planned == [[1, 2, 3], [1, 3], [1, 3], [4, 5, 6], [4, 6]]


def test_planners_of_any_stride_agree_where_forces_are_held_alike() -> None:
    packets = torch.randn(3, 4, generator=torch.Generator().manual_seed(0))
    arrives = np.ones(3, dtype=bool)

    def forces(stride: int) -> np.ndarray:
        controller = StrideController(Linear(stride), 3)
        played = [controller.act(arrives, packets)]
        played += [controller.act(~arrives, None) for _ in range(11)]
        return np.array(played)

    one = forces(1)
    for stride in (2, 3, 4):
        anchors = np.arange(12) // stride * stride
        assert forces(stride) == pytest.approx(one[anchors], rel=1e-5)


def test_last_force_holds_or_drops() -> None:
    for keep in (True, False):
        controller = LastForce(lambda packets: 2.0 * packets, 3, keep=keep)
        first = controller.act(np.array([True, True, True]), np.array([1.0, 2.0, 3.0]))
        second = controller.act(np.array([False, True, False]), np.array([5.0]))
        third = controller.act(np.array([False, False, False]), None)
        assert first.tolist() == [2.0, 4.0, 6.0]
        assert second.tolist() == ([2.0, 10.0, 6.0] if keep else [0.0, 10.0, 0.0])
        assert third.tolist() == (second.tolist() if keep else [0.0, 0.0, 0.0])
        assert first.tolist() == [2.0, 4.0, 6.0]  # earlier answers are not overwritten


def test_last_force_takes_tensors_of_an_actor() -> None:
    controller = LastForce(lambda z: z.sum(dim=1).bfloat16(), 2, keep=True)
    forces = controller.act(np.array([True, True]), torch.tensor([[1.0, 2.0], [3.0, 4.0]]))
    assert forces.dtype == np.float64
    assert forces.tolist() == [3.0, 7.0]


def test_the_oracle_predicts_an_undisturbed_plant() -> None:
    """Without noise it plays, after one packet, what the teacher plays on the true state."""
    quiet = dataclasses.replace(
        load_settings(flags={"protocol": "paper"}).protocol,
        steps=300,
        noise_x_dot_m_s=0.0,
        noise_theta_dot_rad_s=0.0,
    )
    draws = Draws.make(quiet, 5, seed=0)
    method = true_state_driver("oracle", DESKTOP, 0)
    once = gap_schedule(300, 300, 5)
    once[1:] = False
    costs = [
        simulate(DESKTOP, draws, schedule[None], method.controller(5), method.sensor).cost
        for schedule in (once, every_step(300, 5))
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-3)


def test_the_oracle_advances_only_its_own_estimate() -> None:
    calls = []

    def advance(states: np.ndarray, forces: np.ndarray) -> np.ndarray:
        calls.append((states.copy(), forces.copy()))
        return states + 1.0

    oracle = Oracle(lambda states: 100.0 * states[:, 0], advance, 20.0, 2)
    packets = np.array([[0.1, 0, 0, 0], [0.7, 0, 0, 0]])
    assert oracle.act(np.array([True, True]), packets).tolist() == [10.0, 20.0]  # clipped
    assert oracle.act(np.array([False, True]), packets[:1]).tolist() == [20.0, 10.0]
    assert calls[0][1].tolist() == [10.0, 20.0]  # with the force that the actuator applies
    assert calls[1][0][:, 0] == pytest.approx([1.1, 0.1])


def test_a_lost_oracle_stays_finite() -> None:
    oracle = Oracle(lambda states: states[:, 0], DESKTOP.advance, 20.0, 1)
    oracle.act(np.array([True]), np.array([[50.0, 50.0, 3.0, 50.0]]))
    for _ in range(2000):
        assert np.isfinite(oracle.act(np.array([False]), None)).all()


# --- No controller sees the plant ---------------------------------------------------------------


def reachable(root: object) -> list[object]:
    """Everything an object holds, through attributes, closures, partials and containers."""
    seen: dict[int, object] = {}
    queue = [root]
    while queue:
        item = queue.pop()
        if id(item) in seen or isinstance(item, types.ModuleType | type):
            continue
        seen[id(item)] = item
        if isinstance(item, types.FunctionType):  # not its globals: those are its module
            cells = [cell.cell_contents for cell in item.__closure__ or ()]
            queue += [*cells, item.__defaults__, item.__kwdefaults__, item.__dict__]
        else:
            queue += gc.get_referents(item)
    return list(seen.values())


def controllers() -> dict[str, Controller]:
    built: dict[str, Controller] = {
        name: true_state_driver(name, DESKTOP, 0).controller(2) for name in without_model()
    }
    return built | {"stride": StrideController(Linear(4), 2)}


def untrained_model() -> Model:
    settings = load_settings(flags={"encoder.hidden": 8})
    architecture = describe_architecture(settings) | {
        "kind": "hierarchy",
        "actor_hidden": 8,
        "actor_dropout": 0.0,
    }
    metadata = {
        "architecture": architecture,
        "plant": "desktop",
        "settings": settings.as_dict(),
    }
    return Model(build_modules(architecture), metadata, "", "cpu")


def embedding_controllers() -> dict[str, Controller]:
    model = untrained_model()
    few = {"collect.trajectories": 2, "collect.test_trajectories": 2, "collect.steps": 8}
    settings = load_settings(flags=few)
    built = {name: build_driver(name, settings, model).controller(2) for name in methods_of(model)}
    assert {name for name in METHODS if METHODS[name].fitted} < built.keys()
    return built


@pytest.mark.parametrize("build", [controllers, embedding_controllers])
def test_no_controller_holds_a_plant(build: Callable[[], dict[str, Controller]]) -> None:
    forbidden = (CartPoles, CartPole, pymunk.Space, pymunk.Body)
    for name, controller in build().items():
        held = reachable(controller)
        assert len(held) > 5
        assert not [item for item in held if isinstance(item, forbidden)], name
        # The walk would find one.
        poles = CartPoles(DESKTOP, 1)
        smuggled = types.SimpleNamespace(inner=controller, act=lambda poles=poles: poles.states)
        assert [item for item in reachable(smuggled) if isinstance(item, forbidden)], name


@pytest.mark.parametrize("name", [*without_model(), "stride"])
def test_forces_follow_from_packets_alone(name: str) -> None:
    """Gusts after the only packet change the plant and not one force."""
    options = dataclasses.replace(load_settings(flags={"protocol": "paper"}).protocol, steps=40)
    played = []
    for gusts in (0.0, 20.0):
        draws = Draws.make(options, 2, seed=0)
        draws = dataclasses.replace(draws, noise=gusts * draws.noise)
        spy = Spy(controllers()[name])
        once = np.zeros((1, 40, 2), dtype=bool)
        once[:, 0] = True
        outcome = simulate(DESKTOP, draws, once, spy, sensor_of(name))
        played.append((np.array(spy.forces), outcome.cost))
    assert np.array_equal(played[0][0], played[1][0])
    assert not np.array_equal(played[0][1], played[1][1])


class Spy:
    def __init__(self, inner: Controller) -> None:
        self.inner, self.forces = inner, []

    def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
        self.forces.append(self.inner.act(delivered, packets))
        return self.forces[-1]


def sensor_of(name: str) -> Any:
    if name == "stride":
        return lambda seen: torch.from_numpy(seen[:, -1]).float()
    return lambda seen: seen[:, -1]


def test_teacher_is_the_optimal_method() -> None:
    method = true_state_driver("optimal", DESKTOP, 2064)
    states = np.random.default_rng(0).normal(size=(5, 4)) * 0.1
    forces = method.controller(5).act(np.ones(5, dtype=bool), states)
    assert forces == pytest.approx(teacher("desktop")(states))
    assert not method.uses_link
