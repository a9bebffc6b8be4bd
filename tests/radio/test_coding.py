"""Short packets and retransmissions against published values and Monte Carlo."""

import math

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.core.radio import channel
from hjepa_cli.core.radio.coding import (
    normal_approximation_error,
    packet_uses,
    round_errors,
)
from hjepa_cli.errors import UsageError


@pytest.mark.parametrize(
    ("bits", "snr_db", "error", "back_off"),
    [
        (2048, 20.0, 1e-3, 0.036),
        (2048, 20.0, 1e-5, 0.049),
        (2048, 5.0, 1e-3, 0.062),
        (2048, 5.0, 1e-5, 0.086),
        (8192, 20.0, 1e-3, 0.018),
        (8192, 5.0, 1e-5, 0.044),
    ],
)
def test_back_off_from_capacity(bits, snr_db, error, back_off):
    uses = packet_uses(bits, snr_db, error)
    capacity = packet_uses(bits, snr_db)
    assert 1 - capacity / uses == pytest.approx(back_off, abs=6e-4)  # published to 0.1 %
    assert normal_approximation_error(bits, uses, snr_db) == pytest.approx(error, rel=1e-6)


def test_at_capacity_half_of_the_packets_fail():
    uses = packet_uses(1e6, 10.0)
    assert normal_approximation_error(1e6, uses, 10.0) == pytest.approx(0.5, abs=0.01)


def test_outage_agrees_with_the_normal_approximation_in_fading():
    # 20 devices on 20 MHz and 1 ms at a mean of 20 dB: 1,000 uses for 2,048 bits.
    gains = (np.arange(200_000) + 0.5) / 200_000  # quantiles of Exp(1), not draws
    snr_db = 20.0 + 10 * np.log10(-np.log1p(-gains))
    mean = normal_approximation_error(2048, 1000, snr_db).mean()
    outage = channel.outage_probability(2.048e6, 1e6, 20.0)
    assert outage == pytest.approx(0.030867, abs=1e-6)
    assert mean == pytest.approx(0.030749, abs=2e-5)


@pytest.mark.parametrize("error", [-0.1, 0.6, math.nan])
def test_impossible_block_errors_are_refused(error):
    with pytest.raises(UsageError):
        packet_uses(100, 10.0, error)


def test_copies_of_a_packet_add_their_snrs():
    bits, snr_db, error = 48, 5.0, 0.3
    uses, snr = packet_uses(bits, snr_db, error), 10**0.5
    left = 1.0
    for copies, conditional in enumerate(round_errors(bits, snr_db, error, 3), start=1):
        left *= conditional
        capacity = math.log2(1 + copies * snr)
        dispersion = (1 - (1 + copies * snr) ** -2) * math.log2(math.e) ** 2
        bits_left = uses * capacity - bits + 0.5 * math.log2(uses)
        expected = stats.norm.sf(bits_left / math.sqrt(uses * dispersion))
        assert left == pytest.approx(expected, rel=1e-6)
    assert round_errors(bits, snr_db, error, 1) == (error,)
    assert round_errors(2064, 100.0, 0.1, 16)[1] < 0.01  # also where SNRs end
    assert round_errors(2064, 20.0, 0.0, 4) == (0.0,)
    assert round_errors(2064, 20.0, 0.1, 3) == pytest.approx((0.1, 0.0, 0.0), abs=1e-12)
