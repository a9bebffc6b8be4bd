"""Losses against closed forms and loops."""

import math

import pytest
import torch

from hjepa_cli.core.training.losses import InverseDynamics, cosine_loss


def test_cosine_loss_against_angles() -> None:
    for degrees in (0.0, 30.0, 90.0, 180.0):
        angle = math.radians(degrees)
        a = torch.tensor([[1.0, 0.0]])
        b = 3.0 * torch.tensor([[math.cos(angle), math.sin(angle)]])
        assert cosine_loss(a, b).item() == pytest.approx(1.0 - math.cos(angle), abs=1e-6)


def test_cosine_loss_is_a_mean_over_all_leading_axes() -> None:
    torch.manual_seed(0)
    a, b = torch.randn(3, 5, 8), torch.randn(3, 5, 8)
    loop = [
        1.0 - float(x @ y) / math.sqrt(float(x @ x) * float(y @ y))
        for x, y in zip(a.reshape(-1, 8), b.reshape(-1, 8), strict=True)
    ]
    assert cosine_loss(a, b).item() == pytest.approx(sum(loop) / len(loop), abs=1e-5)


def test_targets_get_no_gradient() -> None:
    a, b = torch.randn(4, 8, requires_grad=True), torch.randn(4, 8, requires_grad=True)
    cosine_loss(a, b).backward()
    assert a.grad is not None and b.grad is None


def test_inverse_dynamics_loss_is_mse_in_units_of_ten_newton() -> None:
    head = InverseDynamics(4)
    with torch.no_grad():
        for parameter in head.parameters():
            parameter.zero_()
    action = torch.tensor([0.5, -1.0])  # 10 N and −20 N of a 20 N limit
    loss = head.loss(torch.randn(2, 4), torch.randn(2, 4), action)
    assert loss.item() == pytest.approx((1.0**2 + 2.0**2) / 2)


def test_inverse_dynamics_learns_a_visible_action() -> None:
    torch.manual_seed(0)
    head = InverseDynamics(4)
    z, action = torch.randn(512, 4), torch.rand(512) * 2 - 1
    z_next = z.clone()
    z_next[:, 0] += action
    optimiser = torch.optim.Adam(head.parameters(), 1e-2)
    first = head.loss(z, z_next, action).item()
    for _ in range(200):
        optimiser.zero_grad()
        head.loss(z, z_next, action).backward()
        optimiser.step()
    assert head.loss(z, z_next, action).item() < 0.05 * first
