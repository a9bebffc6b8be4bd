"""Schedules, divergence, device choice and the actor's fit."""

import dataclasses

import numpy as np
import pytest
import torch
from torch import nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.training.optimiser import Optimiser, fit_actor, learning_rate_factor
from hjepa_cli.errors import NumericalError, UsageError


def test_one_cycle_rises_to_one_and_falls_to_almost_zero() -> None:
    factors = [learning_rate_factor(step, 1000, "one-cycle") for step in range(1000)]
    assert factors[0] == pytest.approx(0.04)
    assert max(factors) == pytest.approx(1.0, abs=1e-3)
    assert np.argmax(factors) == pytest.approx(300, abs=1)
    assert 0.0 < factors[-1] < 1e-3
    assert (np.diff(factors[:300]) > 0).all() and (np.diff(factors[301:]) < 0).all()
    assert {learning_rate_factor(step, 10, "constant") for step in range(10)} == {1.0}


def optimiser(parameter: nn.Parameter, **changes: object) -> Optimiser:
    options = {
        "name": "sgd",
        "schedule": "constant",
        "steps": 10,
        "learning_rate": 0.1,
        "weight_decay": 0.0,
        "gradient_clip": 1.0,
    }
    return Optimiser([parameter], **(options | changes))


def test_gradients_are_clipped_by_norm() -> None:
    parameter = nn.Parameter(torch.zeros(2))
    optimiser(parameter).step((parameter * torch.tensor([30.0, 40.0])).sum(), 0)
    torch.testing.assert_close(parameter.detach(), torch.tensor([-0.06, -0.08]))


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_divergence_stops_before_the_weights_are_touched(bad: float) -> None:
    parameter = nn.Parameter(torch.ones(2))
    with pytest.raises(NumericalError, match="step 7"):
        optimiser(parameter).step((parameter * bad).sum(), 7)
    assert torch.equal(parameter.detach(), torch.ones(2))


def test_a_long_batch_is_named_by_its_beginning() -> None:
    z = torch.full((60, 4), float("nan"))
    options = dataclasses.replace(load_settings().actor, batch=50, hidden=8)
    with pytest.raises(NumericalError, match=r"step 0 .*batch: embeddings \d+,.* and 30 more\)$"):
        fit_actor(z, torch.zeros(60), options, seed=0)


def test_cuda_is_refused_where_there_is_none() -> None:
    assert resolve_device("cpu").type == "cpu"
    if not torch.cuda.is_available():
        assert resolve_device("auto").type == "cpu"
        with pytest.raises(UsageError, match="auto or cpu"):
            resolve_device("cuda")


def test_actor_learns_a_linear_policy_and_the_seed_decides_everything() -> None:
    torch.manual_seed(0)
    z = torch.randn(2000, 16)
    actions = torch.tanh(z[:, 0] - 0.5 * z[:, 1])
    options = load_settings().actor
    actor = fit_actor(z, actions, options, seed=3, epochs=20)
    with torch.no_grad():
        error = (actor(z) - actions).square().mean().sqrt() / actions.std()
    assert error < 0.2
    again = fit_actor(z, actions, options, seed=3, epochs=20)
    for a, b in zip(actor.parameters(), again.parameters(), strict=True):
        assert torch.equal(a, b)
