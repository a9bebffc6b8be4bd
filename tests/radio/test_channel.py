"""The channel against the standard's numbers, the paper's equation and Monte Carlo."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.core.radio import channel
from hjepa_cli.errors import UsageError

COLUMNS = ("InF-LOS", "InF-SL", "InF-DL", "InF-SH", "InF-DH")

# Independent double-precision evaluation of Table 7.4.1-1 (equal to Sionna 2.2.0 to the last bit).
# Row 4 is a hall of TS-JEPA's Table IV: 50 m horizontally, 10 m and 1.5 m antenna heights.
GOLDEN_DB = [
    (0.5, 1, (26.1204300824, 26.9794000867, 26.9794000867, 26.3794000867, 27.6094000867)),
    (3.5, 1, (42.1772928427, 43.8813608870, 43.8813608870, 43.2813608870, 44.5113608870)),
    (3.5, 10, (63.6772928427, 69.3813608870, 69.3813608870, 66.2813608870, 66.4113608870)),
    (
        3.75,
        50.71735402207988,
        (79.4074607259, 87.9621183451, 90.9547155413, 83.0992268754, 82.4535546288),
    ),
    (3.75, 100, (85.7465940868, 95.4806253546, 101.4806253546, 89.8806253546, 88.9106253546)),
    (5, 25, (75.1761402688, 82.6268703079, 82.6268703079, 78.5320202862, 78.2242862766)),
    (28, 50, (95.8638576887, 105.2668957374, 108.1963897816, 100.4194707266, 99.7806037218)),
    (3.5, 600, (101.9075447259, 114.7242177718, 128.6613605257, 107.1788396458, 105.3528732704)),
    (100, 600, (129.5702518832, 143.8428568848, 157.7799996387, 136.2974787588, 134.4715123834)),
]


@pytest.mark.parametrize("column", range(5), ids=COLUMNS)
@pytest.mark.parametrize(("carrier_ghz", "distance_m", "losses_db"), GOLDEN_DB)
def test_path_loss_matches_the_standard(carrier_ghz, distance_m, losses_db, column):
    loss = channel.path_loss_db(COLUMNS[column], carrier_ghz, distance_m)
    assert loss == pytest.approx(losses_db[column], abs=1e-9)


@pytest.mark.parametrize("scenario", COLUMNS)
def test_path_loss_grows_with_distance_and_frequency_and_is_never_below_line_of_sight(scenario):
    distance_m = np.geomspace(1, 600, 200)
    carrier_ghz = np.geomspace(0.5, 100, 50)[:, None]
    loss = channel.path_loss_db(scenario, carrier_ghz, distance_m)
    assert loss.shape == (50, 200)
    assert np.all(np.diff(loss, axis=0) > 0)
    assert np.all(np.diff(loss, axis=1) > 0)
    assert np.all(loss >= channel.path_loss_db("InF-LOS", carrier_ghz, distance_m))


def test_dense_low_clutter_is_never_below_sparse_low_clutter():
    distance_m = np.geomspace(1, 600, 200)
    dense = channel.path_loss_db("InF-DL", 3.75, distance_m)
    assert np.all(dense >= channel.path_loss_db("InF-SL", 3.75, distance_m))
    assert np.any(dense == channel.path_loss_db("InF-SL", 3.75, distance_m))  # the bound binds


def test_shadowing_standard_deviations():
    sigmas = {name: row.shadowing_db for name, row in channel.SCENARIOS.items()}
    assert sigmas == {"InF-LOS": 4.3, "InF-SL": 5.7, "InF-DL": 7.2, "InF-SH": 5.9, "InF-DH": 4.0}


def heights(clutter=2.0, bs=8.0, ue=1.5):
    return {"clutter_height_m": clutter, "bs_height_m": bs, "ue_height_m": ue}


@pytest.mark.parametrize(
    ("scenario", "distance_m", "density", "size_m", "height", "expected", "tolerance"),
    [
        ("InF-SL", 10, 0.2, 10, heights(), 0.8, 1e-12),
        ("InF-SL", 50, 0.2, 10, heights(), 0.32768, 1e-12),
        ("InF-DL", 50, 0.6, 2, heights(), math.exp(-50 / 2.1827133359), 1e-12),
        ("InF-SH", 50, 0.2, 10, heights(), 0.917755335623, 1e-12),
        ("InF-SH", 150, 0.2, 10, heights(), 0.773002243215, 1e-12),
        ("InF-DH", 50, 0.6, 2, heights(6, 8), 1.2959e-7, 1e-11),
        ("InF-DH", 50, 0.6, 2, heights(3, 10), 0.017554251438, 1e-12),
        ("InF-DH", 10, 0.4, 2, heights(3, 10), 0.637163814050, 1e-12),
    ],
)
def test_line_of_sight_probability(
    scenario, distance_m, density, size_m, height, expected, tolerance
):
    probability = channel.line_of_sight_probability(
        scenario, distance_m, clutter_density=density, clutter_size_m=size_m, **height
    )
    assert probability == pytest.approx(expected, abs=tolerance, rel=0)


def test_line_of_sight_limits():
    hall = {"clutter_density": 0.2, "clutter_size_m": 10.0} | heights()
    distance_m = np.linspace(0, 300, 100)
    for scenario in COLUMNS[1:]:
        probability = channel.line_of_sight_probability(scenario, distance_m, **hall)
        assert probability[0] == 1.0
        assert np.all(np.diff(probability) < 0)
        empty = hall | {"clutter_density": 0.0}
        assert np.all(channel.line_of_sight_probability(scenario, distance_m, **empty) == 1.0)
    assert np.all(channel.line_of_sight_probability("InF-LOS", distance_m, **hall) == 1.0)
    # Raising the base station over the same clutter opens the view.
    higher = hall | {"bs_height_m": np.array([4.0, 8.0, 12.0])}
    assert np.all(np.diff(channel.line_of_sight_probability("InF-SH", 50.0, **higher)) > 0)


@pytest.mark.parametrize("carrier_ghz", [0.499, 100.1, -1.0, 0.0, math.nan, math.inf, [3.5, 0.1]])
def test_frequency_outside_the_standard_is_refused(carrier_ghz):
    with pytest.raises(UsageError, match=r"carrier frequency .* 0\.5 … 100 GHz"):
        channel.path_loss_db("InF-SH", carrier_ghz, 50.0)


@pytest.mark.parametrize("distance_m", [0.99, 0.0, -5.0, 600.1, math.nan, math.inf, [50.0, 601.0]])
def test_distance_outside_the_standard_is_refused(distance_m):
    with pytest.raises(UsageError, match=r"3D distance .* 1 … 600 m"):
        channel.path_loss_db("InF-SH", 3.75, distance_m)


def test_unknown_scenario_names_the_choices():
    for scenario in ("InF-HH", "inf-sh", "UMi", ""):
        with pytest.raises(UsageError, match="InF-LOS, InF-SL, InF-DL, InF-SH, InF-DH"):
            channel.path_loss_db(scenario, 3.75, 50.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clutter_density": 1.0}, "clutter density"),
        ({"clutter_density": -0.1}, "clutter density"),
        ({"clutter_density": math.nan}, "clutter density"),
        ({"clutter_size_m": 0.0}, "clutter size"),
        ({"clutter_height_m": 1.5}, "not above the device"),
        ({"clutter_height_m": 1.0}, "not above the device"),
        ({"clutter_height_m": np.array([2.0, 1.0])}, "not above the device"),
        ({"bs_height_m": 1.8}, "below the clutter"),
        ({"ue_height_m": math.nan}, "device height"),
    ],
)
def test_bad_halls_are_refused(change, message):
    hall = {"clutter_density": 0.2, "clutter_size_m": 10.0} | heights() | change
    for scenario in ("InF-SH", "InF-DH"):
        with pytest.raises(UsageError, match=message):
            channel.line_of_sight_probability(scenario, 50.0, **hall)


def test_low_base_stations_do_not_look_at_heights():
    hall = {"clutter_density": 0.2, "clutter_size_m": 10.0}
    flat = channel.line_of_sight_probability("InF-SL", 50.0, **hall, **heights(1.0, 1.5))
    assert flat == channel.line_of_sight_probability("InF-SL", 50.0, **hall, **heights())


def outage_as_printed(power_w, loss_db, noise_w, rate_bps, bandwidth_hz):
    """The paper's eq. 4, letter for letter."""
    return 1 - math.exp(
        -(10 ** (loss_db / 10)) * (noise_w / power_w) * (2 ** (rate_bps / bandwidth_hz) - 1)
    )


@pytest.mark.parametrize("power_dbm", [0.0, 10.0, 23.0])
@pytest.mark.parametrize("rate_bps", [1e6, 2.064e6, 30e6, 80e6])
def test_outage_is_the_equation_of_the_paper(power_dbm, rate_bps):
    loss_db = channel.path_loss_db("InF-SH", 3.75, 50.71735402207988)
    mean_snr_db = channel.received_snr_db(power_dbm, loss_db, -95.0)
    printed = outage_as_printed(
        10 ** (power_dbm / 10) * 1e-3, float(loss_db), 10**-9.5 * 1e-3, rate_bps, 20e6
    )
    assert channel.outage_probability(rate_bps, 20e6, mean_snr_db) == pytest.approx(
        printed, rel=1e-9
    )


@pytest.mark.parametrize(
    ("loss_db", "power_dbm", "expected"),
    [
        (82.4535546288, 23.0, (0.000881, 0.002785, 0.027499)),
        (82.4535546288, 10.0, (0.017440, 0.054117, 0.426708)),
        (83.0992268754, 23.0, (0.001023, 0.003230, 0.031836)),
    ],
)
def test_outage_check_values(loss_db, power_dbm, expected):
    """Outage of rates that need an SNR of 5, 10 and 20 dB, at −95 dBm of noise."""
    mean_snr_db = channel.received_snr_db(power_dbm, loss_db, -95.0)
    rate_bps = channel.achievable_rate_bps(20e6, [5.0, 10.0, 20.0])
    assert channel.outage_probability(rate_bps, 20e6, mean_snr_db) == pytest.approx(
        expected, abs=6e-7
    )


@pytest.mark.parametrize("mean_snr_db", [0.0, 10.0, 20.0])
@pytest.mark.parametrize("spectral_efficiency", [0.5, 1.0, 4.0])
def test_outage_closed_form_against_a_million_draws(mean_snr_db, spectral_efficiency):
    rng = np.random.default_rng(np.random.SeedSequence([38901, int(mean_snr_db)]))
    gains = channel.rayleigh_power_gains(rng, 1_000_000)
    rates = np.log2(1 + 10 ** (mean_snr_db / 10) * gains)  # bit/s per Hz, written out
    counted = np.mean(rates < spectral_efficiency)
    closed = channel.outage_probability(spectral_efficiency * 1e6, 1e6, mean_snr_db)
    standard_error = math.sqrt(closed * (1 - closed) / gains.size)
    assert abs(counted - closed) < 4 * standard_error


def test_fading_is_exponential_with_unit_mean_and_independent():
    gains = channel.rayleigh_power_gains(np.random.default_rng(7), (1000, 1000))
    assert gains.shape == (1000, 1000)
    assert gains.mean() == pytest.approx(1.0, abs=4e-3)  # 4 standard errors
    assert gains.var() == pytest.approx(1.0, abs=4 * math.sqrt(8) * 1e-3)
    assert np.mean(gains > 3) == pytest.approx(math.exp(-3), abs=1e-3)
    slot_to_slot = np.corrcoef(gains[:, :-1].ravel(), gains[:, 1:].ravel())[0, 1]
    assert abs(slot_to_slot) < 4e-3


def test_outage_has_the_right_signs():
    loss_db = channel.path_loss_db("InF-SH", 3.75, np.linspace(5, 500, 50))
    snr_db = channel.received_snr_db(10.0, loss_db, -95.0)
    assert np.all(np.diff(snr_db) < 0)
    assert np.all(np.diff(channel.outage_probability(20e6, 20e6, snr_db)) > 0)  # farther: worse
    rates = np.linspace(1e5, 1e8, 50)
    assert np.all(np.diff(channel.outage_probability(rates, 20e6, 20.0)) > 0)  # faster: worse
    bands = np.linspace(1e6, 2e7, 50)
    assert np.all(np.diff(channel.outage_probability(5e6, bands, 20.0)) < 0)  # wider: better
    stronger = channel.received_snr_db([0.0, 10.0, 20.0], 80.0, -95.0)
    assert np.all(np.diff(channel.outage_probability(20e6, 20e6, stronger)) < 0)


@given(
    rate=st.floats(0, 1e12),
    bandwidth=st.floats(1e-3, 1e12),
    snr_db=st.floats(-100, 100),
)
def test_outage_is_a_probability(rate, bandwidth, snr_db):
    assert 0 <= channel.outage_probability(rate, bandwidth, snr_db) <= 1


def test_outage_limits():
    assert channel.outage_probability(0.0, 20e6, -100.0) == 0.0
    assert channel.outage_probability(1e12, 1.0, 100.0) == 1.0
    # A tiny outage keeps its digits: ε ≈ (2^(R/W) − 1) / γ̄, not 1 − 1.
    tiny = channel.outage_probability(1.0, 20e6, 100.0)
    assert tiny == pytest.approx(math.log(2) / 20e6 / 1e10, rel=1e-6)


@pytest.mark.parametrize(
    "arguments",
    [
        (-1.0, 20e6, 20.0),
        (math.nan, 20e6, 20.0),
        (1e6, 0.0, 20.0),
        (1e6, -20e6, 20.0),
        (1e6, 20e6, math.nan),
        (1e6, 20e6, math.inf),
        (1e6, 20e6, "loud"),
    ],
)
def test_outage_refuses_nonsense(arguments):
    with pytest.raises(UsageError):
        channel.outage_probability(*arguments)


@pytest.mark.parametrize("towards", [0.0, math.inf])
def test_what_rounding_puts_beside_a_bound_is_on_it(towards):
    for distance_m in channel.DISTANCE_3D_M:
        beside = np.nextafter(distance_m, towards)
        loss_db = channel.path_loss_db("InF-SL", 3.75, beside)
        assert loss_db == pytest.approx(channel.path_loss_db("InF-SL", 3.75, distance_m))
    for carrier_ghz in (0.5, 100.0):
        assert channel.path_loss_db("InF-SL", np.nextafter(carrier_ghz, towards), 10.0) > 0
    for snr_db in channel.SNR_DB:
        beside = np.nextafter(snr_db, math.copysign(towards, snr_db))
        assert channel.snr_ratio(beside) == pytest.approx(channel.snr_ratio(snr_db))
    for wrong in (1 - 1e-9, 600 * (1 + 1e-9), math.nan):
        with pytest.raises(UsageError, match="3D distance"):
            channel.path_loss_db("InF-SL", 3.75, wrong)
    with pytest.raises(UsageError, match="clutter density 1 is out of range"):
        channel.line_of_sight_probability(
            "InF-SL", 1.0, clutter_density=1.0, clutter_size_m=1.0, clutter_height_m=2.0,
            bs_height_m=1.5, ue_height_m=1.5,
        )  # fmt: skip


def test_thermal_noise_of_the_cell():
    """−95 dBm of TS-JEPA's Table IV is thermal noise over 20 MHz with a 6 dB noise figure."""
    assert channel.thermal_noise_dbm(20e6, 0.0) == pytest.approx(-100.9897, abs=1e-4)
    assert channel.thermal_noise_dbm(20e6, 6.0) == pytest.approx(-95.0, abs=0.02)


def test_rate_of_the_cell():
    """Bits of one 1 ms slot in 20 MHz at 5, 10 and 20 dB."""
    bits = channel.achievable_rate_bps(20e6, [5.0, 10.0, 20.0]) * 1e-3
    assert bits == pytest.approx([41147.464, 69188.632, 133164.230], abs=5e-4)


def test_received_snr_follows_the_fading():
    mean_db = channel.received_snr_db(23.0, 82.4535546288, -95.0)
    assert mean_db == pytest.approx(35.546, abs=1e-3)
    faded_db = channel.received_snr_db(23.0, 82.4535546288, -95.0, [0.0, 0.1, 10.0])
    assert faded_db[1:] - mean_db == pytest.approx([-10.0, 10.0])
    assert faded_db[0] == -math.inf


def test_scalars_stay_scalars():
    assert np.ndim(channel.path_loss_db("InF-SH", 3.75, 50.0)) == 0
    assert isinstance(channel.path_loss_db("InF-SH", 3.75, 50.0), float)
    assert isinstance(channel.outage_probability(1e6, 20e6, 20.0), float)
