"""Fading over many slots: distributions, correlation, bursts."""

import itertools
import math
import time

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.core.radio import channel
from hjepa_cli.core.radio.fading import (
    block_fading,
    gilbert_elliott,
    rician_power_gains,
)
from hjepa_cli.errors import UsageError


def slots(count, *args, **kwargs):
    return np.stack(list(itertools.islice(block_fading(*args, **kwargs), count)))


@pytest.mark.parametrize("k_db", [-math.inf, 0.0, 7.0, 15.0])
def test_rician_gains_have_their_distribution(k_db):
    gains = rician_power_gains(np.random.default_rng(0), (200_000,), k_db)
    k = 10 ** (k_db / 10)
    # |H|² 2(K+1) is a noncentral chi-square with 2 degrees of freedom and noncentrality 2K.
    law = stats.ncx2(2, 2 * k) if k else stats.chi2(2)
    assert stats.kstest(2 * (k + 1) * gains, law.cdf).pvalue > 1e-3
    # Mean 1; variance (2K + 1)/(K + 1)²: within 4 standard errors.
    assert abs(gains.mean() - 1) < 4 * math.sqrt((2 * k + 1) / (k + 1) ** 2 / len(gains))


def test_outage_over_independent_block_fading_is_the_closed_form():
    gains = slots(1000, 3, 1000)
    outage = channel.outage_probability(2.0, 1.0, 10.0)
    failed = np.log2(1 + 10 * gains) < 2.0
    assert abs(failed.mean() - outage) < 4 * math.sqrt(outage * (1 - outage) / failed.size)
    # Independent over slots and links: neighbours fail together as often as chance has it.
    for both in (failed[1:] & failed[:-1], failed[:, 1:] & failed[:, :-1]):
        assert abs(both.mean() - outage**2) < 4 * math.sqrt(outage**2 / both.size)


def test_a_million_gains_take_well_under_a_second():
    started = time.perf_counter()
    total = sum(gains.sum() for gains in itertools.islice(block_fading(0, 1000), 1000))
    assert time.perf_counter() - started < 1.0
    assert total == pytest.approx(1e6, rel=4e-3)  # 4 standard errors


def test_links_and_slots_do_not_depend_on_how_many_there_are():
    few, many = slots(300, 5, 3, coherence_slots=4.0), slots(520, 5, 7, coherence_slots=4.0)
    assert np.array_equal(few, many[:300, :3])
    assert not np.array_equal(few, slots(300, 6, 3, coherence_slots=4.0))


@pytest.mark.parametrize("coherence", [1.0, 3.0, 20.0])
def test_coherence_is_the_mean_length_of_a_gain(coherence):
    gains = slots(4000, 1, 100, coherence_slots=coherence)
    changes = (gains[1:] != gains[:-1]).mean()
    share = 1 / coherence
    assert abs(changes - share) < 4 * math.sqrt(max(share * (1 - share), 1e-12) / 399_900) + 1e-12
    # The marginal law stays exponential, whatever the coherence.
    assert stats.kstest(gains[:: int(8 * coherence)].ravel(), "expon").pvalue > 1e-3


def test_bursts_of_correlated_fading():
    threshold, coherence = 0.5, 6.0
    blocked = slots(20_000, 2, 50, coherence_slots=coherence) < threshold
    starts = blocked[1:] & ~blocked[:-1]
    runs = blocked[1:].sum() / starts.sum()
    expected = coherence / math.exp(-threshold)
    assert runs == pytest.approx(expected, rel=0.02)  # 50,000 runs, each about as long as its sd


@pytest.mark.parametrize(("p", "burst"), [(0.9, 1.2), (0.5, 2.0), (0.5, 10.0), (0.05, 40.0)])
def test_gilbert_elliott_has_its_share_and_its_bursts(p, burst):
    uniforms = np.random.default_rng(0).random((20_000, 60))
    good = gilbert_elliott(uniforms, p, burst)
    assert good.shape == uniforms.shape and good.dtype == bool
    lost_runs = (~good[1:] & good[:-1]).sum()
    # Variance of a Markov chain's mean: p (1 − p) (1 + λ)/(1 − λ), λ the second eigenvalue.
    second = 1 - 1 / burst - (1 - p) / (p * burst)
    error = math.sqrt(p * (1 - p) * (1 + second) / (1 - second) / good.size)
    assert abs(good.mean() - p) < 4 * error
    assert (~good[1:]).sum() / lost_runs == pytest.approx(burst, rel=4 / math.sqrt(lost_runs))


def test_the_shortest_bursts_are_independent_losses():
    uniforms = np.random.default_rng(1).random((60_000, 1))
    good = gilbert_elliott(uniforms, 0.3, 1 / 0.3)[:, 0]
    both = (good[1:] & good[:-1]).mean()
    assert abs(both - 0.09) < 4 * math.sqrt(0.09 / len(good))


@pytest.mark.parametrize(
    ("p", "burst"), [(0.0, 5.0), (1.1, 5.0), (0.5, 0.9), (0.1, 8.9), (0.5, math.inf)]
)
def test_impossible_channels_are_refused(p, burst):
    with pytest.raises(UsageError):
        gilbert_elliott(np.full((2, 1), 0.5), p, burst)


@pytest.mark.parametrize("coherence", [0.0, 0.99, math.nan, math.inf])
def test_impossible_coherence_is_refused(coherence):
    with pytest.raises(UsageError, match="coherence"):
        next(block_fading(0, 2, coherence_slots=coherence))
