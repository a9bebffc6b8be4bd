"""The EMA target against its closed form; EMA code in this field is often untested and broken."""

import pytest
import torch
from torch import nn

from hjepa_cli.core.training.jepa import EmaTarget


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 2))


def test_starts_equal_but_separate() -> None:
    online = network()
    target = EmaTarget(online, 0.99)
    for mean, value in zip(target.module.parameters(), online.parameters(), strict=True):
        assert torch.equal(mean, value)
        assert mean.data_ptr() != value.data_ptr()


@pytest.mark.parametrize("decay", [0.0, 0.5, 0.99, 1.0])
def test_constant_online_gives_one_minus_decay_to_the_k(decay: float) -> None:
    online = network()
    target = EmaTarget(online, decay)
    start = [p.clone() for p in target.module.parameters()]
    with torch.no_grad():
        for parameter in online.parameters():
            parameter.add_(1.0)
    updates = 7
    for _ in range(updates):
        target.update(online)
    moved = 1.0 - decay**updates
    for mean, before in zip(target.module.parameters(), start, strict=True):
        torch.testing.assert_close(mean, before + moved)


def test_no_gradient_reaches_the_target() -> None:
    online = network()
    target = EmaTarget(online, 0.9)
    assert not any(p.requires_grad for p in target.module.parameters())
    (online(torch.randn(5, 3)) - target.module(torch.randn(5, 3))).square().sum().backward()
    assert all(p.grad is None for p in target.module.parameters())
    assert all(p.grad is not None for p in online.parameters())


def test_buffers_follow() -> None:
    online = network()
    target = EmaTarget(online, 0.75)
    online(torch.randn(64, 3) * 10 + 5)
    before = target.module[1].running_mean.clone()
    target.update(online)
    expected = 0.75 * before + 0.25 * online[1].running_mean
    torch.testing.assert_close(target.module[1].running_mean, expected)
    assert target.module[1].num_batches_tracked == online[1].num_batches_tracked == 1


def test_survives_save_and_load() -> None:
    online = network()
    target = EmaTarget(online, 0.9)
    with torch.no_grad():
        online[0].weight.add_(1.0)
    target.update(online)
    copy = EmaTarget(network(), 0.9)
    copy.module.load_state_dict(target.module.state_dict())
    target.update(online)
    copy.update(online)
    for a, b in zip(copy.module.parameters(), target.module.parameters(), strict=True):
        assert torch.equal(a, b)
