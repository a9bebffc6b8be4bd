"""Terms against collapse, held against closed forms."""

import math

import numpy as np
import pytest
import torch

from hjepa_cli.core.regularisers import REGULARISERS, sigreg, vicreg


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
    assert sigreg(torch.zeros(10, 4)).item() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("name", REGULARISERS)
def test_following_the_gradient_spreads_a_collapsed_batch(name: str) -> None:
    torch.manual_seed(0)
    z = (0.01 * torch.randn(64, 4)).requires_grad_()
    optimiser = torch.optim.Adam([z], lr=0.05)
    before = REGULARISERS[name](z).item()
    for _ in range(60):
        optimiser.zero_grad()
        REGULARISERS[name](z).backward()
        optimiser.step()
    assert REGULARISERS[name](z).item() < 0.5 * before
    assert z.std(0).min() > 0.2


@pytest.mark.parametrize("name", REGULARISERS)
def test_they_stay_in_float32_under_autocast(name: str) -> None:
    z = torch.randn(32, 8, generator=torch.Generator().manual_seed(0))
    torch.manual_seed(0)
    exact = REGULARISERS[name](z)
    torch.manual_seed(0)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert REGULARISERS[name](z) == exact
