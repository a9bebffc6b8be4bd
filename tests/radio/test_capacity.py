"""The device-count laws against 50-digit arithmetic, brute force and published check values."""

import math
from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.radio import capacity
from hjepa_cli.core.radio.cell import Cell
from hjepa_cli.core.radio.channel import outage_probability
from hjepa_cli.core.radio.laws import duty
from hjepa_cli.core.radio.laws.scheduled import ScheduledBand
from hjepa_cli.core.radio.phy import equal_parts as equal
from hjepa_cli.errors import UsageError

getcontext().prec = 50

CELL = {"bandwidth_hz": 20e6, "slot_s": 1e-3}


def exact_log2(x):
    return x.ln() / Decimal(2).ln()


def exact_ratio(snr_db):
    return Decimal(10) ** (Decimal(snr_db) / 10)


def test_a_packet_that_fills_its_slot_exactly_is_on_time():
    # b = k W τ_o at 2^k − 1: c is 1 whatever rounding makes of it.
    k = np.arange(1, 31)
    c = capacity.slot_capacity(1000.0 * k, 1e6, 1e-3, 10 * np.log10(2.0**k - 1))
    assert np.any(c < 1) and np.all(capacity.late_slots(c) == 0)
    band = ScheduledBand(Cell(1e6, 1e-3, 0.0), 0.62)
    for bits, snr_db in zip(1000 * k, 10 * np.log10(2.0**k - 1), strict=True):
        assert band.fits("max-aoi", int(bits), snr_db)
        assert not band.fits("max-aoi", int(bits) + 1, snr_db)


@pytest.mark.parametrize(
    ("payload_bits", "expected"),
    [
        (196_608, (0.209, 0.352, 0.677)),  # one raw 64 x 128 RGB frame
        (393_216, (0.105, 0.176, 0.339)),  # two of them
        (8_192, (5.02, 8.45, 16.26)),  # 256 float32
        (2_048, (20.09, 33.78, 65.02)),  # 256 int8
        (1_024, (40.2, 67.6, 130.0)),
        (48, (857, 1441, 2774)),  # four state numbers of 12 bits
    ],
)
def test_packets_per_slot_at_5_10_and_20_db(payload_bits, expected):
    c = capacity.slot_capacity(payload_bits, snr_db=[5.0, 10.0, 20.0], **CELL)
    assert c == pytest.approx(expected, rel=3e-3, abs=5.1e-4)
    assert capacity.slot_capacity(payload_bits, 20e6, 20e-3, 20.0) == pytest.approx(20 * c[2])


def test_one_transmission_per_slot_supports_16_float_and_65_int8_devices_at_20_db():
    c = capacity.slot_capacity([8192, 2048], snr_db=20.0, **CELL)
    assert list(duty.duty_devices(1.0, c)) == [16, 65]


@given(
    gap=st.floats(1, 400),
    bits=st.integers(1, 400_000),
    snr_db=st.integers(-10, 40),
)
def test_duty_is_the_exact_floor(gap, bits, snr_db):
    c = Decimal(20_000) / bits * exact_log2(1 + exact_ratio(snr_db))
    exact = Decimal(gap) * c
    n = duty.duty_devices(gap, capacity.slot_capacity(bits, snr_db=snr_db, **CELL))
    if abs(exact - round(exact)) > exact * Decimal("1e-11"):  # undecidable in double precision
        assert n == int(exact)


def test_whole_numbers_are_not_lost_to_rounding():
    """γ = 2^k − 1 and b = 2,000 make c = 10 k exactly; D 10 k devices, never one fewer."""
    k = np.arange(1, 21)[:, None]
    gap = np.arange(1, 401)
    c = capacity.slot_capacity(2000, snr_db=10 * np.log10(2.0**k - 1), **CELL)
    assert np.array_equal(duty.duty_devices(gap, c), gap * 10 * k)
    # The same for the equal law: −γ ln p = 2^k − 1 makes N = 10 k.
    p = np.exp(-(2.0 ** k[:10] - 1) / 100)
    assert np.array_equal(equal.equal_devices(p, 2000, snr_db=20.0, **CELL), 10 * k[:10])


def test_a_frame_larger_than_a_slot_arrives_late():
    c = capacity.slot_capacity([2048, 393_216], snr_db=20.0, **CELL)
    assert capacity.late_slots(c) == pytest.approx([0.0, 1 / 0.33866], rel=1e-4)
    assert capacity.late_slots(1.0) == 0.0
    assert duty.duty_devices(2.9, c[1]) == 0  # even alone, a loop would wait too long
    assert duty.duty_devices(3.0, c[1]) == 1


def test_equal_law_of_the_measured_delivery_tolerances():
    """Oracle, hold and zero on the true state: at most 20 % apart, whatever predicts."""
    n = equal.equal_devices([0.0101, 0.0369, 0.187], 2048, snr_db=20.0, **CELL)
    assert list(n) == [86, 81, 72]


@pytest.mark.parametrize(
    ("snr_db", "expected"),
    [
        (20.0, (9.80, 34.45, 45.50, 55.61, 64.98, 69.01)),
        (10.0, (1.35, 10.14, 17.35, 25.42, 33.74, 37.48)),
        (5.0, (0.44, 4.05, 8.02, 13.49, 20.06, 23.25)),
    ],
)
def test_equal_law_of_loops_that_die_after_k_losses(snr_db, expected):
    """One loss run of K = 1, 2, 3, 5, 10, 15 slots per 100: outage 0.01^(1/K)."""
    outage = 0.01 ** (1 / np.array([1, 2, 3, 5, 10, 15]))
    n = equal.equal_devices(1 - outage, 2048, snr_db=snr_db, **CELL)
    assert list(n) == [math.floor(value) for value in expected]


@given(
    p=st.floats(1e-6, 0.999),
    bits=st.integers(48, 400_000),
    snr_db=st.integers(-10, 40),
)
def test_equal_is_the_exact_floor(p, bits, snr_db):
    exact = Decimal(20_000) / bits * exact_log2(1 - exact_ratio(snr_db) * Decimal(p).ln())
    n = equal.equal_devices(p, bits, snr_db=snr_db, **CELL)
    if abs(exact - round(exact)) > exact * Decimal("1e-11"):
        assert n == int(exact)


@pytest.mark.parametrize("noise", ["fixed", "scaled"])
@pytest.mark.parametrize("p", [0.005, 0.037, 0.2, 0.9])
@pytest.mark.parametrize("snr_db", [-5.0, 5.0, 20.0])
@pytest.mark.parametrize("bits", [2064, 20_000, 393_216])
def test_equal_is_the_largest_number_that_still_gets_through(noise, p, snr_db, bits):
    """Brute force: count upwards with the probability written out from the definition."""
    gain = 10 ** (snr_db / 10)

    def delivered(n):
        mean_snr = gain * n if noise == "scaled" else gain
        return math.exp(-(2 ** min(bits * n / 20_000, 1000) - 1) / mean_snr)

    largest = max((n for n in range(1, 400) if delivered(n) >= p), default=0)
    assert largest < 399
    assert equal.equal_devices(p, bits, snr_db=snr_db, noise=noise, **CELL) == largest


def newton(packets_per_bit, weakest):
    """n = k log2(1 + n a) from above by Newton's steps: concave, so never past the root."""
    k, a = packets_per_bit / math.log(2), weakest
    n = k**2 * a  # since ln(1 + x) ≤ √x
    for _ in range(100):
        x = n * a
        n = k * (np.log1p(x) - x / (1 + x)) / (1 - k * a / (1 + x))  # nothing cancels far above
    return n


def test_lamberts_function_agrees_with_newtons_method_on_all_valid_inputs():
    """k = W τ/b of 1 Hz to 100 GHz, 1 to 20 ms, 1 bit to a raw pair of frames: 2.5e-9 to 2e9;
    a = −γ̄ ln p* up to 100 dB and p* = 1e-300: 7e12. Half of the draws lie towards s = 1, where the
    root vanishes and is known to about ε/(1 − s) only: s itself is known to ε. 8 ε of each."""
    random = np.random.default_rng(0)
    k = 10 ** random.uniform(math.log10(2.5e-9), math.log10(2e9), 40_000)
    s = np.concatenate(
        [10 ** random.uniform(-22, 0, 20_000), 1 - 10 ** random.uniform(-9, 0, 20_000)]
    )
    a = math.log(2) / (k * s)
    k, s, a = k[a < 7e12], s[a < 7e12], a[a < 7e12]
    expected = newton(k, a)
    error = np.abs(equal.scaled_noise_devices(k, a) - expected) / expected
    assert np.all(error < 8 * np.finfo(float).eps / (1 - s))
    assert np.all(error[s < 0.99] < 1e-12)  # far below the 1e-12 that a count may be rounded up by
    nobody = equal.scaled_noise_devices(k, 0.999 * math.log(2) / k)
    assert not nobody.any() and not equal.scaled_noise_devices(k, 0.0).any()


def test_scaled_noise_only_helps_and_agrees_for_one_device():
    bits = 20e6 * 1e-3 * math.log2(1 - 10 * math.log(0.5))  # of one device that has all
    for noise in ("scaled", "fixed"):
        assert equal.equal_devices(0.5, bits, snr_db=10.0, noise=noise, **CELL) == 1
    p = np.array([0.01, 0.1, 0.5])
    assert np.all(
        equal.equal_devices(p, 2064, snr_db=10.0, noise="scaled", **CELL)
        > equal.equal_devices(p, 2064, snr_db=10.0, **CELL)
    )


@pytest.mark.parametrize("noise", ["fixed", "scaled"])
def test_as_many_are_counted_as_the_outage_of_the_channel_lets_through(noise):
    p = np.array([0.01, 0.1, 0.5, 0.9])
    n = equal.equal_devices(p, 2064, snr_db=20.0, noise=noise, **CELL)
    arriving = [
        1 - outage_probability(2064 / 1e-3, 20e6 / n, 20.0 + louder_db)
        for n in (n, n + 1)
        for louder_db in [10 * np.log10(n) if noise == "scaled" else 0.0]
    ]
    assert np.all(n > 1) and np.all(arriving[0] >= p) and np.all(arriving[1] < p)


def test_the_gain_of_a_predictor_falls_with_snr_under_equal_and_not_under_duty():
    snr_db = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0])
    tiny = {"payload_bits": 1, "bandwidth_hz": 20e6, "slot_s": 1.0, "snr_db": snr_db}  # no floors
    strong, weak = (1 - 0.01 ** (1 / k) for k in (10, 3))
    gain = equal.equal_devices(strong, **tiny) / equal.equal_devices(weak, **tiny)
    assert gain == pytest.approx([3.18, 2.50, 1.94, 1.61, 1.43, 1.32, 1.26], abs=5e-3)
    c = capacity.slot_capacity(**tiny)
    assert duty.duty_devices(100.0, c) / duty.duty_devices(70.0, c) == pytest.approx(
        10 / 7, rel=1e-6
    )


def test_counts_grow_with_snr_bandwidth_and_tolerance_and_broadcast():
    snr_db = np.linspace(-10, 40, 51)
    c = capacity.slot_capacity(2064, snr_db=snr_db, **CELL)
    n = duty.duty_devices(np.array([[10.0], [100.0]]), c)
    assert n.shape == (2, 51) and n.dtype == np.int64
    assert np.all(np.diff(n, axis=0) >= 0) and np.all(np.diff(n, axis=1) >= 0)
    p = np.array([[0.5], [0.1], [0.01]])
    for noise in ("fixed", "scaled"):
        n = equal.equal_devices(p, 2064, snr_db=snr_db, noise=noise, **CELL)
        assert n.shape == (3, 51) and n.dtype == np.int64
        assert np.all(np.diff(n, axis=0) >= 0) and np.all(np.diff(n, axis=1) >= 0)


def test_a_loop_that_tolerates_nothing_supports_nobody():
    assert duty.duty_devices(0.0, 65.0) == 0
    for noise in ("fixed", "scaled"):
        assert equal.equal_devices(1.0, 2064, snr_db=20.0, noise=noise, **CELL) == 0


@pytest.mark.parametrize("gap", [-1.0, math.nan, math.inf])
def test_impossible_gap_tolerances_are_refused(gap):
    with pytest.raises(UsageError, match="gap tolerance"):
        duty.duty_devices(gap, 65.0)


@pytest.mark.parametrize("p", [0.0, -0.1, 1.1, math.nan])
def test_impossible_delivery_tolerances_are_refused(p):
    with pytest.raises(UsageError, match="delivery tolerance"):
        equal.equal_devices(p, 2064, snr_db=20.0, **CELL)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["payload_bits", "bandwidth_hz", "slot_s"])
def test_impossible_cells_are_refused(name, bad):
    cell = {"payload_bits": 2064, "bandwidth_hz": 20e6, "slot_s": 1e-3, "snr_db": 20.0}
    with pytest.raises(UsageError):
        capacity.slot_capacity(**cell | {name: bad})
    with pytest.raises(UsageError):
        equal.equal_devices(0.5, **cell | {name: bad})


def test_unknown_noise_is_refused():
    with pytest.raises(UsageError, match="fixed or scaled"):
        equal.equal_devices(0.5, 2064, snr_db=20.0, noise="pink", **CELL)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("10:30", [10, 15, 20, 25, 30]),
        ("10:30:10", [10, 20, 30]),
        ("10:30:7", [10, 17, 24]),
        ("20:20", [20]),
        ("20", [20]),
        ("-5:5", [-5, 0, 5]),
        ("0:1:0.25", [0, 0.25, 0.5, 0.75, 1]),
        ("10, 20,30", [10, 20, 30]),
        ("30,10", [30, 10]),
        ("-2.5,0", [-2.5, 0]),
        ("1:3:1e0", [1, 2, 3]),
    ],
)
def test_snr_grids(text, expected):
    assert capacity.parse_snr(text) == expected


def test_snr_grids_are_counted_not_accumulated():
    """Adding 0.1 up ten times gives 0.9999999999999999 and one point too many or too few."""
    assert capacity.parse_snr("0:1:0.1") == [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0]
    assert capacity.parse_snr("10:30:0.1")[-1] == 30.0
    assert len(capacity.parse_snr("10:30:0.1")) == 201


@pytest.mark.parametrize(
    "text",
    [
        *("30:10", "abc", "nan", "inf", "-inf", "10:nan", "10:inf", "", ",", "10,", ":", "10:"),
        *(":30", "10:30:", "10:30:0", "10:30:-5", "30:10:-5", "10:20:30:40", "10:30:nan"),
        *("0:50:0.0001", "0:50:1e-300", "0:50:1e-99999999", "1e9", "1e99999999", "0:1e9", "-101"),
        *("10,20,10", "10;20", "0x10", "10dB", "10 20", ",".join(map(str, range(501)))),
    ],
)
def test_bad_snr_is_one_line_with_an_example(text):
    with pytest.raises(UsageError) as caught:
        capacity.parse_snr(text)
    assert "\n" not in caught.value.message
    assert "10:30" in caught.value.message
    assert len(caught.value.message) < 250


@given(st.text(max_size=20))
def test_any_text_gives_numbers_or_a_usage_error(text):
    try:
        values = capacity.parse_snr(text)
    except UsageError:
        return
    assert 1 <= len(values) <= 500
    assert all(math.isfinite(value) and abs(value) <= 100 for value in values)
