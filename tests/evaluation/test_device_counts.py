"""What a loop needs and how many fit: hand-made method entries, numbers worked out by hand."""

import math

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.core.evaluation.device_ratios import gain, ratio_interval, ratio_of
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.laws.requirement import LinkRequirement
from hjepa_cli.plugins import LAWS

LIMIT_BITS_PER_S = 9.169826295 / math.log(2)


def entry(gap=100.0, p=0.02, bits=2064, censored=False, spread=0.1):
    """The part of an ``eval --json`` method entry that the cell reads."""
    around = [1 - spread, 1 + spread]
    return {
        "bits_per_transmission": bits,
        "warmup_steps": 1000,
        "scored_steps": 3000,
        "tolerance_gap_steps": gap,
        "tolerance_gap_ci95": None if gap is None else [gap * share for share in around],
        "tolerance_gap_censored": censored,
        "tolerance_p": p,
        "tolerance_p_ci95": None if p is None else [min(p * share, 1.0) for share in around],
        "tolerance_p_censored": censored,
    }


def row(law, method_entry, snr_db=20.0, method="m", noise="fixed", bandwidth_hz=20e6):
    cell = Cell(bandwidth_hz, 1e-3, LIMIT_BITS_PER_S, noise)
    need = LinkRequirement.measured(LAWS[law].axis, method, method_entry)
    return LAWS[law].row(need, cell, snr_db)


def test_duty_row_by_hand():
    found = row("duty", entry(gap=100.0))
    c = 20e6 * 1e-3 * math.log2(101) / 2064  # 64.5 packets per slot
    assert found["devices"] == math.floor(100 * c) == 6451
    assert found["load_per_block"] == pytest.approx(6451 / c)  # D*, but for the floor
    assert found["devices_ci95"] == [math.floor(90 * c), math.floor(110 * c)]
    assert found["bits_per_s"] == pytest.approx(2064 / 0.1)
    assert found["ratio_to_limit"] == pytest.approx(20640 / 13.229262922)
    assert found["reason"] is None and found["at_least"] is False


def test_bits_of_packets_that_take_several_slots_are_those_of_the_period_that_was_counted():
    found = row("duty", entry(gap=100.0), bandwidth_hz=1e4)
    late = 2064 / (1e4 * 1e-3 * math.log2(101))  # 31 slots
    assert found["devices"] == math.floor((100 - late) / late)
    assert found["bits_per_s"] == pytest.approx(2064 / ((100 - late) * 1e-3))
    never = row("duty", entry(gap=20.0), bandwidth_hz=1e4)
    assert never["devices"] == 0 and never["bits_per_s"] is never["ratio_to_limit"] is None


def test_duty_charges_the_packet_that_everybody_sends_at_the_start():
    """Scored from the start, a loop with D* = 180.9 sends 6.53 packets in 1,000 steps, not 5.53."""
    scored_from_the_start = entry(gap=180.9) | {"warmup_steps": 0, "scored_steps": 1000}
    c = 20e6 * 1e-3 / 2064 * math.log2(101)
    counted = {
        name: row("duty", measured)["devices"]
        for name, measured in (("steady", entry(gap=180.9)), ("start", scored_from_the_start))
    }
    assert counted == {
        "steady": math.floor(c * 180.9),
        "start": math.floor(c * 1000 / (1000 / 180.9 + 1 - 1 / 180.9)),
    }


def test_equal_row_by_hand():
    found = row("equal", entry(p=0.02))

    def devices(p):
        return math.floor(20_000 / 2064 * math.log2(1 - 100 * math.log(p)))

    assert found["devices"] == devices(0.02) == 83
    assert found["load_per_block"] == pytest.approx(83 * 2064 / (20_000 * math.log2(101)))
    assert found["devices_ci95"] == [devices(0.022), devices(0.018)]  # less needed: more devices
    assert found["tolerance_ci95"] == pytest.approx([0.018, 0.022])
    assert found["bits_per_s"] == pytest.approx(0.02 * 2064 / 1e-3)


def test_scaled_noise_reaches_the_count():
    assert row("equal", entry(), noise="scaled")["devices"] > row("equal", entry())["devices"]
    assert row("duty", entry(), noise="scaled")["devices"] == row("duty", entry())["devices"]


def test_intervals_hold_the_count():
    for law in ("duty", "equal"):
        for snr_db in np.linspace(-5, 35, 9):
            found = row(law, entry(), snr_db=snr_db)
            low, high = found["devices_ci95"]
            assert low <= found["devices"] <= high


def test_a_method_without_a_link_has_no_count():
    for law in ("duty", "equal"):
        found = row(law, entry(gap=None, p=None, bits=None))
        assert found["devices"] is found["devices_ci95"] is found["bits_per_s"] is None
        assert found["load_per_block"] is None
        assert "sees every state" in found["reason"]


@pytest.mark.parametrize(("law", "changes"), [("duty", {"gap": 0.0}), ("equal", {"p": 1.0})])
def test_a_method_that_fails_with_every_packet_supports_nobody(law, changes):
    found = row(law, entry(**changes))
    assert found["devices"] == 0 and "even with a packet in every slot" in found["reason"]
    assert found["bits_per_s"] is found["ratio_to_limit"] is None


def test_a_crowded_cell_says_why():
    narrow = row("duty", entry(gap=2.0), snr_db=0.0, bandwidth_hz=180e3)
    assert narrow["devices"] == 0
    assert narrow["reason"] == "a packet takes 11.5 slots and serves for 2"
    narrow = row("equal", entry(p=0.9), snr_db=0.0, bandwidth_hz=180e3)
    assert narrow["devices"] == 0 and "one device alone delivers with p = " in narrow["reason"]
    assert narrow["bits_per_s"] is narrow["ratio_to_limit"] is None


def test_a_range_that_ends_at_every_packet_is_no_failure():
    """``protocol.gaps = [1]`` and an acceptable score: p* ≤ 1, and nobody looked further."""
    found = row("equal", entry(p=1.0, censored=True))
    assert found["devices"] == 0 and found["at_least"]
    assert found["reason"] == "one device alone delivers with p = 0.999; measured down to 1 only"


def test_a_raw_frame_pays_for_being_late():
    """c = 0.339 at 20 dB: a frame is 2.95 slots old on arrival, and D* shrinks by as much."""
    late = row("duty", entry(gap=30.0, bits=393_216))
    c = 20_000 * math.log2(101) / 393_216
    assert late["devices"] == math.floor((30 - 1 / c) * c) == 9
    assert math.floor(30 * c) == 10


def test_bounds_are_marked():
    assert row("duty", entry(censored=True))["at_least"] is True


def test_gain_under_duty_is_the_ratio_of_tolerances_at_every_snr():
    gaps = {"hjepa": 100.0, "hold": 70.0, "zero": 0.0}
    for snr_db in (0.0, 20.0):
        rows = [row("duty", entry(gap, bits=1), snr_db, name) for name, gap in gaps.items()]
        found = gain(rows, "hjepa", "hold", snr_db)
        assert found["ratio"] == pytest.approx(10 / 7, rel=1e-5)
        low, high = found["ratio_ci95"]
        # Two parts of ±10 %: about √2 times as wide.
        assert low == pytest.approx(10 / 7 * 0.866, rel=5e-3)
        assert high == pytest.approx(10 / 7 * 1.154, rel=5e-3)
        assert gain(rows, "hjepa", "zero", snr_db) is None
        assert gain(rows, "hjepa", "oracle", snr_db) is None
        assert gain(rows, "hjepa", "hold", snr_db + 1) is None


def test_ratio_interval_covers_the_true_ratio_19_times_in_20():
    """Two independent normal estimates with known spread, 20,000 repetitions."""
    rng = np.random.default_rng(95)
    a, b, sigma_a, sigma_b = 110.0, 80.0, 6.0, 5.0
    inside = 0
    for above, below in zip(
        rng.normal(a, sigma_a, 20_000), rng.normal(b, sigma_b, 20_000), strict=True
    ):
        low, high = ratio_interval(
            (above, above - 1.96 * sigma_a, above + 1.96 * sigma_a),
            (below, below - 1.96 * sigma_b, below + 1.96 * sigma_b),
        )
        inside += low <= a / b <= high
    assert inside / 20_000 == pytest.approx(0.95, abs=0.01)


def test_counts_of_the_same_seeds_are_compared_seed_by_seed():
    shared = np.array([0.8, 1.0, 1.3, 0.9, 1.1])  # hard and easy draws move both
    rows = [
        {"devices": 100, "devices_ci95": [70, 130], "devices_by_seed": list(size * shared * noise)}
        for size, noise in ((150, [1.01, 0.99, 1.0, 1.02, 0.98]), (100, np.ones(5)))
    ]
    low, high = ratio_of(*rows)["ratio_ci95"]
    logs = np.log([1.515, 1.485, 1.5, 1.53, 1.47])
    low_log, high_log = stats.t.interval(0.95, 4, logs.mean(), stats.sem(logs))
    assert (low, high) == pytest.approx((math.exp(low_log), math.exp(high_log)))
    # One seed, or another number of them: the intervals of the counts decide.
    wide = ratio_of(rows[0] | {"devices_by_seed": [100]}, rows[1] | {"devices_by_seed": [100]})
    assert wide["ratio_ci95"][1] - wide["ratio_ci95"][0] > 10 * (high - low)


def test_ratio_interval_limits():
    two, four = pytest.approx(2.0), pytest.approx(4.0)
    assert ratio_interval((10, 10, 10), (5, 5, 5)) == [two, two]
    assert ratio_interval((10, 0, 20), (5, 5, 5)) == [0.0, four]
    assert ratio_interval((10, 10, 10), (5, 0, 5)) == [two, None]
