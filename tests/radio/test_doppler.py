"""Fading with a Doppler: Jakes' autocorrelation, Sionna's delay lines, selectivity, its limits."""

import itertools

import numpy as np
import pytest
from scipy.special import j0

from hjepa_cli.core.radio.doppler import (
    Motion,
    Taps,
    check_speed,
    doppler_hz,
    moving_fading,
    power_correlation,
    tapped_delay_line,
)
from hjepa_cli.errors import UsageError

LINKS = 1500


def gains(slots, links=LINKS, seed=3, k_factor_db=-np.inf, **motion):
    values = {"doppler_hz": 25.0, "slot_s": 1e-3} | motion
    made = moving_fading(seed, links, Motion(**values), k_factor_db=k_factor_db)
    return np.stack(list(itertools.islice(made, slots)))


def test_doppler_of_a_machine():
    assert doppler_hz(2.0, 3.75) == pytest.approx(25.017, abs=1e-3)


def test_powers_are_exponential_and_correlated_as_jakes_says():
    """Over 1,500 links: mean 1, tail e^-x, power correlation J0² at lags of 5, 10 and 20 ms."""
    found = gains(21)
    # 4 standard errors of a mean of 1,500 unit exponentials are 0.10; of shares at most 0.05.
    assert found[0].mean() == pytest.approx(1.0, abs=0.1)
    for threshold in (0.1, 0.5, 2.0):
        assert (found > threshold).mean() == pytest.approx(np.exp(-threshold), abs=0.05)
    for lag in (5, 10, 20):
        measured = np.corrcoef(found[0], found[lag])[0, 1]
        expected = j0(2 * np.pi * 25.0 * lag * 1e-3) ** 2
        assert expected == pytest.approx(power_correlation(25.0, lag * 1e-3))
        assert measured == pytest.approx(expected, abs=0.1), lag


def test_a_strong_line_of_sight_hardly_fades():
    assert gains(50, links=20, k_factor_db=30.0).std() < 0.12
    assert gains(50, links=20, k_factor_db=30.0).mean() == pytest.approx(1.0, abs=0.05)


def test_the_first_links_do_not_depend_on_how_many_there_are():
    assert np.array_equal(gains(3, links=4), gains(3, links=9)[:, :4])


def test_a_wide_band_averages_over_a_frequency_selective_channel():
    """Two equal taps 1 µs apart: over 20 MHz the gain has half the variance."""
    two = Taps(np.array([0.0, 1e-6]), np.array([0.5, 0.5]))
    wide, narrow = (
        gains(1, taps=two, bandwidth_hz=20e6, allocation_hz=width)[0] for width in (20e6, 360e3)
    )
    # The variance of a variance of 1,500 exponentials: 4 standard errors are 0.3 and 0.12.
    assert narrow.var() == pytest.approx(1.0, abs=0.3)
    assert wide.var() == pytest.approx(0.5, abs=0.12)
    assert wide.mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("profile", "abcde")
def test_delay_lines_are_sionnas(profile):
    pytest.importorskip("sionna")
    taps = tapped_delay_line(profile, 50e-9, 3.75)
    spread = np.sqrt(taps.power @ taps.delay_s**2 - (taps.power @ taps.delay_s) ** 2)
    assert taps.power.sum() == pytest.approx(1.0)
    assert spread == pytest.approx(50e-9, rel=0.06)
    assert (taps.sight > 0) == (profile in "de")
    if profile in "de":  # K of TR 38.901, Tables 7.7.2-4 and -5
        k_factor_db = 10 * np.log10(taps.sight / (taps.power[0] - taps.sight))
        assert k_factor_db == pytest.approx({"d": 13.3, "e": 22.0}[profile], abs=0.2)


def test_speeds_beyond_the_model_name_the_fastest():
    with pytest.raises(UsageError, match=r"--speed-m-s 40: .* expected at most 33.8 m/s"):
        check_speed(40.0, 3.75, 1e-3)
    check_speed(33.0, 3.75, 1e-3)
    with pytest.raises(UsageError, match="less than a slot"):
        Motion(500.0, 1e-3)
