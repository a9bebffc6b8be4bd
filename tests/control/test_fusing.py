"""A filter in latent space: against plain replacement, and against a textbook Kalman filter."""

import numpy as np
import pytest
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.control.controllers import FusingController, StrideController
from hjepa_cli.core.control.link import InFlight
from hjepa_cli.core.control.loop import gap_schedule
from hjepa_cli.core.control.planners import corrected
from hjepa_cli.core.networks.model import build_modules

A = torch.tensor([[1.0, 0.1], [0.02, 1.01]])
B = torch.tensor([0.005, 0.1])
K = torch.tensor([1.5, 2.0])


class Linear:
    """A planner of a linear system z' = A z + B u, with u = −K z held for a stride of two."""

    stride = 2

    def plan(self, z: Tensor) -> tuple[Tensor, Tensor]:
        u = -z @ K
        after = z
        for _ in range(self.stride):
            after = after @ A.T + u[:, None] * B
        return u[:, None].expand(-1, self.stride), after

    def follow(self, z: Tensor, forces_n: Tensor, ages: Integers) -> Tensor:
        z = z.clone()
        for step in range(forces_n.shape[1]):
            on = torch.from_numpy(ages > step)
            z[on] = z[on] @ A.T + forces_n[on, step, None] * B
        return z


def packets_of(random: np.random.Generator, steps: int, devices: int) -> Tensor:
    return torch.from_numpy(random.normal(size=(steps, devices, 2))).float()


def drive(controller: StrideController, packets: Tensor, gap: float, delay: int) -> np.ndarray:
    steps, devices, _ = packets.shape
    sent, flight, played = gap_schedule(gap, steps, devices), InFlight(delay, None), []
    for k in range(steps):
        out = packets[k][torch.from_numpy(sent[k])] if sent[k].any() else None
        played.append(controller.act(*flight.pass_on(sent[k], out)))
    return np.stack(played)


@pytest.mark.parametrize("gap", [1.0, 3.0, 7.5])
@pytest.mark.parametrize("delay", [0, 5])
def test_a_filter_that_believes_packets_alone_replaces(gap: float, delay: int) -> None:
    packets = packets_of(np.random.default_rng(0), 50, 4)
    replaced = drive(StrideController(Linear(), 4), packets, gap, delay)
    fusing = FusingController(Linear(), 4, correct=lambda predicted, told: told)
    assert (drive(fusing, packets, gap, delay) == replaced).all()


@pytest.mark.parametrize("delay", [0, 3])
def test_with_a_kalman_gain_it_is_a_kalman_filter(delay: int) -> None:
    """Step by step in numpy: predict under the forces that were played, correct, move on."""
    gain = np.array([[0.3, 0.1], [0.05, 0.6]])
    steps, gap = 40, 4
    packets = packets_of(np.random.default_rng(1), steps, 1)

    def correct(predicted: Tensor, told: Tensor) -> Tensor:
        return predicted + (told - predicted) @ torch.from_numpy(gain.T).float()

    fusing = FusingController(Linear(), 1, correct=correct)
    found = drive(fusing, packets, gap, delay)[:, 0]

    a, b, k_ = A.double().numpy(), B.double().numpy(), K.double().numpy()
    states: dict[int, np.ndarray] = {}  # what is believed of a step, corrected or predicted
    expected: list[float] = []
    plan: list[float] = []
    for k in range(steps):
        captured = k - delay
        if captured >= 0 and captured % gap == 0:
            told = packets[captured, 0].double().numpy()
            before = states.get(captured, told)
            states[captured] = before + gain @ (told - before)
            for step in range(captured, k):
                states[step + 1] = a @ states[step] + b * expected[step]
            plan = []
        if k in states:
            if not plan:
                plan = [float(-k_ @ states[k])] * 2
            expected.append(plan.pop(0))
            states[k + 1] = a @ states[k] + b * expected[k]
        else:
            expected.append(0.0)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_an_untrained_posterior_takes_the_packet() -> None:
    architecture = {
        "kind": "hierarchy", "embedding": 16, "hidden": 16, "frame_input": "difference",
        "centre": True, "mirror": "exact", "stride_actions": "all", "residual": True,
        "h": 4, "m": 2, "l": 1, "actor_hidden": 16, "actor_dropout": 0.0,
    }  # fmt: skip
    assert "posterior" not in build_modules(architecture)
    posterior = build_modules(architecture | {"fusion": True})["posterior"]
    predicted, packets = (torch.nn.functional.normalize(torch.randn(5, 16)) * 4 for _ in range(2))
    torch.testing.assert_close(corrected(posterior, predicted, packets), packets)
