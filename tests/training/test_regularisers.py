"""Terms against collapse, held against closed forms."""

import math

import numpy as np
import pytest
import torch

from hjepa_cli.core.training.regularisers import REGULARISERS, Sigreg, sigreg, vicreg


def test_vicreg_of_correlated_values() -> None:
    random = np.random.default_rng(0)
    mixing = random.normal(size=(6, 6)) * 0.4
    z = random.normal(size=(500, 6)) @ mixing + random.normal(size=6)
    covariance = np.cov(z, rowvar=False)
    hinge = np.maximum(0.0, 1.0 - np.sqrt(np.diag(covariance) + 1e-4)).mean()
    between = (covariance**2).sum() - (np.diag(covariance) ** 2).sum()
    assert vicreg(torch.from_numpy(z)).item() == pytest.approx(hinge + between / 6, rel=1e-5)


def test_sigreg_of_normal_samples_is_their_sampling_error() -> None:
    """E|φ_N − φ|² = (1 − exp(−t²)) ÷ N; its integral has a closed form."""
    samples, repeats = 400, 200
    generator = torch.Generator().manual_seed(0)
    directions = torch.eye(8)
    values = [
        sigreg(torch.randn(samples, 8, generator=generator), directions).item()
        for _ in range(repeats)
    ]
    expected = (math.sqrt(2 * math.pi) - math.sqrt(2 * math.pi / 3)) / samples
    error = np.std(values, ddof=1) / math.sqrt(repeats)
    assert abs(np.mean(values) - expected) < 4 * error < 0.1 * expected


def test_sigreg_of_a_collapsed_batch() -> None:
    """φ_N = 1: ∫ (1 − exp(−t²/2))² exp(−t²/2) dt."""
    expected = math.sqrt(2 * math.pi) * (1 - math.sqrt(2) + 1 / math.sqrt(3))
    assert sigreg(torch.zeros(10, 4), torch.eye(4)).item() == pytest.approx(expected, rel=1e-3)


def test_sigreg_never_looks_along_the_same_directions_again() -> None:
    """Not even when torch is seeded anew, as by the probe that watches every epoch."""
    z = torch.randn(64, 8, generator=torch.Generator().manual_seed(0))
    term, values = Sigreg(0), []
    before = torch.get_rng_state()
    for _ in range(3):
        values.append(term(z).item())
        torch.manual_seed(0)
    torch.set_rng_state(before)
    assert len(set(values)) == 3
    assert Sigreg(0)(z).item() == values[0] != Sigreg(1)(z).item()
    assert torch.equal(torch.get_rng_state(), before)  # it draws nothing from torch's stream


def test_sigreg_goes_on_where_its_state_was_saved() -> None:
    z = torch.randn(64, 8, generator=torch.Generator().manual_seed(0))
    term, resumed = Sigreg(0), Sigreg(0)
    term(z)
    resumed.load_state_dict(term.state_dict())
    assert resumed(z).item() == term(z).item()


@pytest.mark.parametrize("name", REGULARISERS)
def test_following_the_gradient_spreads_a_collapsed_batch(name: str) -> None:
    torch.manual_seed(0)
    z = (0.01 * torch.randn(64, 4)).requires_grad_()
    optimiser = torch.optim.Adam([z], lr=0.05)
    term = REGULARISERS[name](0)
    before = term(z).item()
    for _ in range(60):
        optimiser.zero_grad()
        term(z).backward()
        optimiser.step()
    assert term(z).item() < 0.5 * before
    assert z.std(0).min() > 0.2


@pytest.mark.parametrize("name", REGULARISERS)
def test_they_stay_in_float32_under_autocast(name: str) -> None:
    z = torch.randn(32, 8, generator=torch.Generator().manual_seed(0))
    exact = REGULARISERS[name](0)(z)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert REGULARISERS[name](0)(z) == exact
