"""Health measures against closed forms, scipy and hand counts."""

import numpy as np
import pytest
import torch
from scipy.linalg import lstsq

from hjepa_cli.core.networks import health

NAMES = ("x", "x_dot", "theta", "theta_dot")


def test_probe_of_a_linear_code_is_perfect_and_of_noise_is_zero() -> None:
    torch.manual_seed(0)
    states = torch.randn(3000, 4)
    code = states @ torch.randn(4, 32) + 5.0
    r2 = health.probe_r2(code[:2000], states[:2000], code[2000:], states[2000:], NAMES)
    assert tuple(r2) == NAMES
    assert all(value > 1.0 - 1e-6 for value in r2.values())
    noise = torch.randn(3000, 32)
    blind = health.probe_r2(noise[:2000], states[:2000], noise[2000:], states[2000:], NAMES)
    assert all(-0.1 < value < 0.02 for value in blind.values())


def test_probe_against_scipy_least_squares() -> None:
    rng = np.random.default_rng(1)
    z, states = rng.normal(size=(600, 6)), rng.normal(size=(600, 4))
    states[:, 0] += z[:, 2]
    design = np.c_[z[:400], np.ones(400)]
    weights = lstsq(design, states[:400])[0]
    residual = states[400:] - np.c_[z[400:], np.ones(200)] @ weights
    expected = 1 - (residual**2).sum(0) / ((states[400:] - states[400:].mean(0)) ** 2).sum(0)
    tensors = [torch.from_numpy(a) for a in (z[:400], states[:400], z[400:], states[400:])]
    measured = health.probe_r2(*tensors, NAMES)
    np.testing.assert_allclose(list(measured.values()), expected, atol=1e-5)


def test_collapsed_embeddings_are_survived_and_score_nothing() -> None:
    states = torch.randn(200, 4)
    constant = torch.ones(200, 16)
    r2 = health.probe_r2(constant, states, constant, states, NAMES)
    assert all(abs(value) < 0.05 for value in r2.values())


@pytest.mark.parametrize("rank", [1, 3, 7])
def test_effective_rank_of_equal_directions_is_their_number(rank: int) -> None:
    corners = torch.eye(16)[:rank]
    z = torch.cat([corners, -corners])
    assert health.effective_rank(z) == pytest.approx(rank, rel=1e-6)


def test_effective_rank_of_two_unequal_directions() -> None:
    z = torch.tensor([[2.0, 0.0], [-2.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    p = np.array([0.8, 0.2])  # squared singular values 8 and 2
    assert health.effective_rank(z) == pytest.approx(np.exp(-(p * np.log(p)).sum()), rel=1e-6)


def test_action_sensitivity_of_a_linear_predictor() -> None:
    z = torch.zeros(10, 3)
    z_next = z + torch.tensor([0.0, 4.0, 0.0])
    sensitivity = health.action_sensitivity(
        lambda state, actions: state + actions.sum(1, keepdim=True), z, z_next, steps=2
    )
    # ±2 on each of three axes: ‖(4, 4, 4)‖ ÷ 4
    assert sensitivity == pytest.approx(3**0.5)


def test_action_sensitivity_is_the_mean_over_the_forces() -> None:
    z, z_next = torch.zeros(10, 2), torch.tensor([0.0, 4.0]).expand(10, 2)

    def predict(state: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        return state + actions.sum(1) * torch.tensor([1.0, 3.0])  # each force moves its own axis

    sensitivity = health.action_sensitivity(predict, z, z_next, steps=2, action_shape=(2,))
    assert sensitivity == pytest.approx((4 + 12) / 2 / 4)


def test_nrmse() -> None:
    truth = torch.tensor([3.0, -4.0])
    assert health.nrmse(truth, truth) == 0.0
    assert health.nrmse(torch.zeros(2), truth) == pytest.approx(1.0)
    assert health.nrmse(2 * truth, truth) == pytest.approx(1.0)
