"""Metrics against closed forms, scipy and plain loops."""

import numpy as np
import pytest
import scipy.stats
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.control.force_error import WINDOWS, control_error, window_means
from hjepa_cli.core.plants.cost import stage_cost
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.statistics import (
    bootstrap_weights,
    first_crossing,
    interval,
    mean_interval,
    ratio,
)
from hjepa_cli.errors import NumericalError


def test_score_band_includes_its_edges_and_ignores_velocities() -> None:
    states = np.array(
        [
            [0.05, 9.0, -0.05, 9.0],
            [0.0501, 0.0, 0.0, 0.0],
            [0.0, 0.0, -0.0501, 0.0],
            [-0.05, 0.0, 2 * np.pi, 0.0],  # unwrapped: a full turn is not upright
        ]
    )
    assert plant("desktop").in_band(states).tolist() == [True, False, False, False]


def test_stage_cost_is_the_quadratic_form_and_is_capped() -> None:
    q, r = (20.0, 0.5, 20.0, 0.05), 0.05
    state, force = np.array([0.1, -0.2, 0.3, -0.4]), 2.0
    by_hand = 20 * 0.01 + 0.5 * 0.04 + 20 * 0.09 + 0.05 * 0.16 + 0.05 * 4
    assert stage_cost(state, np.array(force), q, r) == pytest.approx(by_hand)
    both = stage_cost(state, np.array([force, 3.0]), q, (r, 2.0))
    assert both == pytest.approx(by_hand + 2.0 * 9)
    assert stage_cost(np.full((2, 3, 4), 50.0), np.zeros((2, 3)), q, r).tolist() == [[50.0] * 3] * 2


def test_bootstrap_weights_draw_with_replacement() -> None:
    weights = bootstrap_weights(40, 3000, seed=1)
    counts = weights * 40
    assert np.allclose(weights.sum(axis=1), 1)
    assert np.allclose(counts, counts.round())
    # Each count is binomial(40, 1/40).
    assert counts.mean() == pytest.approx(1)
    assert counts.var() == pytest.approx(1 - 1 / 40, rel=0.02)
    assert np.array_equal(weights, bootstrap_weights(40, 3000, seed=1))
    assert not np.array_equal(weights, bootstrap_weights(40, 3000, seed=2))


def test_mean_interval_agrees_with_scipy() -> None:
    values = np.random.default_rng(0).exponential(size=(60, 2))
    ours = mean_interval(values, bootstrap_weights(60, 4000, seed=0))
    for column in range(2):
        theirs = scipy.stats.bootstrap(
            (values[:, column],), np.mean, n_resamples=4000, method="percentile", rng=1
        ).confidence_interval
        assert ours[:, column] == pytest.approx([theirs.low, theirs.high], abs=0.03)


def test_ratio_interval_is_paired_and_agrees_with_scipy() -> None:
    random = np.random.default_rng(0)
    reference = random.uniform(0.2, 1.0, 80)
    method = 0.8 * reference + random.normal(0, 0.02, 80)
    ours = interval(ratio(method, reference, bootstrap_weights(80, 4000, seed=3)))
    theirs = scipy.stats.bootstrap(
        (method, reference),
        lambda a, b: a.mean() / b.mean(),
        n_resamples=4000,
        paired=True,
        vectorized=False,
        method="percentile",
        rng=1,
    ).confidence_interval
    assert ours == pytest.approx([theirs.low, theirs.high], abs=1e-3)
    # What both share cancels: unpaired, the interval would be many times as wide.
    alone = mean_interval(method, bootstrap_weights(80, 4000, seed=3)) / reference.mean()
    assert np.diff(ours) < 0.3 * np.diff(alone)


def test_ratio_has_one_value_per_point_and_replicate() -> None:
    values, reference = np.arange(12.0).reshape(3, 4), np.array([1.0, 2.0, 3.0, 4.0])
    weights = bootstrap_weights(4, 5, seed=0)
    plain = ratio(values, reference)
    assert plain.tolist() == [row.mean() / 2.5 for row in values]
    replicates = ratio(values, reference, weights)
    assert replicates.shape == (5, 3)
    for b in range(5):
        for p in range(3):
            expected = (weights[b] * values[p]).sum() / (weights[b] * reference).sum()
            assert replicates[b, p] == pytest.approx(expected)


def test_a_reference_of_zero_normalises_nothing() -> None:
    values, nothing = np.arange(12.0).reshape(3, 4), np.zeros(4)
    for weights in (None, bootstrap_weights(4, 5, seed=0)):
        with pytest.raises(NumericalError, match="never inside the band with any of 4 devices"):
            ratio(values, nothing, weights)
    # One device counts: the replicates that did not draw it are undefined and left out.
    one, weights = np.array([0.5, 0, 0, 0]), bootstrap_weights(4, 400, seed=0)
    replicates = ratio(values, one, weights)
    undefined = weights[:, 0] == 0
    assert 0.2 < undefined.mean() < 0.45  # (3/4)^4 = 0.32
    assert (np.isnan(replicates) == undefined[:, None]).all()
    assert (interval(replicates) == interval(replicates[~undefined])).all()


def test_interval_is_the_percentile_interval_and_keeps_infinities() -> None:
    replicates = np.arange(1000.0)
    low, high = interval(replicates)
    assert (low, high) == (24, 974)
    replicates[950:] = np.inf
    replicates[:10] = -np.inf
    assert interval(replicates).tolist() == [24, np.inf]


def test_crossing_of_known_curves() -> None:
    gaps = np.array([1.0, 2.0, 4.0, 8.0])
    curves = np.array(
        [
            [1.0, 0.9, 0.5, 0.1],  # between 2 and 4
            [0.5, 0.9, 0.9, 0.9],  # below at once, whatever comes later
            [1.0, 0.9, 0.8, 0.62],  # 0.62 itself is acceptable
            [1.0, 0.3, 0.9, 0.1],  # first fall counts
        ]
    )
    linear = first_crossing(gaps, curves, 0.62, log=False)
    assert linear == pytest.approx([2 + 2 * 0.28 / 0.4, -np.inf, np.inf, 1 + 0.38 / 0.7])
    log = first_crossing(gaps, curves, 0.62, log=True)
    assert log[0] == pytest.approx(2 * 2 ** (0.28 / 0.4))  # 2^(1 + share): linear in ln gap
    assert log[1:3].tolist() == [-np.inf, np.inf]
    assert first_crossing(gaps, curves[0], 0.62, log=False).shape == ()


def test_an_undefined_score_is_not_acceptable() -> None:
    gaps, undefined = np.array([1.0, 2.0, 4.0]), np.nan
    curves = np.array([[undefined] * 3, [1.0, 0.9, undefined], [1.0, undefined, 0.9]])
    for log in (False, True):
        crossing = first_crossing(gaps, curves, 0.62, log=log)
        assert crossing == pytest.approx([-np.inf, 2.0, 1.0])


@given(
    st.lists(st.floats(0.01, 1.0), min_size=2, max_size=12),
    st.floats(0.05, 0.95),
    st.booleans(),
)
def test_crossing_by_brute_force(scores: list[float], level: float, log: bool) -> None:
    gaps = np.arange(1.0, len(scores) + 1) ** 1.5
    found = float(first_crossing(gaps, np.array(scores), level, log=log))
    expected = np.inf
    for i, score in enumerate(scores):
        if score < level:
            if i == 0:
                expected = -np.inf
                break
            to, back = (np.log, np.exp) if log else (float, float)
            share = (scores[i - 1] - level) / (scores[i - 1] - score)
            expected = back(to(gaps[i - 1]) + share * (to(gaps[i]) - to(gaps[i - 1])))
            break
    assert found == pytest.approx(expected, rel=1e-9)


def test_interval_of_a_crossing_covers_the_truth() -> None:
    """Devices whose scores fall along lines of random height: the mean line's crossing is known."""
    gaps = np.linspace(60, 140, 9)
    truth = 100.0
    covered, widths = 0, []
    trials = 300
    for trial in range(trials):
        random = np.random.default_rng(trial)
        height = 0.62 + random.normal(0, 0.3, (1, 64))
        scores = height - 0.005 * (gaps[:, None] - truth) + random.normal(0, 0.05, (9, 64))
        weights = bootstrap_weights(64, 300, seed=trial)
        replicates = ratio(scores, np.ones(64), weights)
        low, high = interval(first_crossing(gaps, replicates, 0.62, log=False))
        covered += low <= truth <= high
        widths.append(high - low)
    assert 0.91 <= covered / trials <= 0.98
    # The crossing moves by height / slope: standard error 0.3 / 8 / 0.005 = 7.5.
    assert np.median(widths) == pytest.approx(2 * 1.96 * 7.5, rel=0.15)


def test_control_error_is_in_units_of_the_force_range() -> None:
    error = control_error(np.array([20.0, -20.0, 3.0]), np.array([-20.0, -20.0, 1.0]), 20.0)
    assert error == pytest.approx([1.0, 0.0, 2 / 40])


def test_windows_partition_the_horizon_after_the_packet() -> None:
    error = np.arange(101.0)
    means = window_means(error)
    assert {name: float(value) for name, value in means.items()} == {
        "1-20": 10.5,
        "21-40": 30.5,
        "41-80": 60.5,
        "81-100": 90.5,
    }
    covered = [j for first, last in WINDOWS for j in range(first, last + 1)]
    assert covered == list(range(1, 101))


def test_windows_beyond_a_short_horizon_are_left_out() -> None:
    means = window_means(np.ones((3, 31)))
    assert list(means) == ["1-20", "21-40"]
    assert means["21-40"].shape == (3,)
