"""Devices dropped into a factory hall."""

import importlib.util
import math

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.core.radio import factory_hall as hall
from hjepa_cli.core.radio.channel import (
    SCENARIOS,
    line_of_sight_probability,
    path_loss_db,
    thermal_noise_dbm,
)
from hjepa_cli.errors import UsageError


def test_reference_drop():
    # SH over 300 × 150 m at 3.75 GHz, 2·10⁵ draws elsewhere: means 89.1 m, 0.860 and 84.2 dB.
    drops = [hall.drop_devices("InF-SH", 3.75, 400, seed) for seed in range(10)]
    distance = np.concatenate([drop.distance_2d_m for drop in drops])
    assert distance.mean() == pytest.approx(89.1, abs=4 * distance.std() / math.sqrt(4000))
    in_sight = np.concatenate([drop.in_sight for drop in drops])
    assert in_sight.mean() == pytest.approx(0.860, abs=4 * math.sqrt(0.12 / 4000))
    loss = np.concatenate([drop.loss_db for drop in drops])
    # Shadowing is correlated over 10 m of 300 × 150 m: at least 100 independent patches a drop.
    assert loss.mean() == pytest.approx(84.2, abs=4 * loss.std() / math.sqrt(1000))


@pytest.mark.parametrize("scenario", list(hall.FACTORY_HALLS))
def test_every_hall(scenario):
    drop = hall.drop_devices(scenario, 3.75, 200, 0)
    size = hall.FACTORY_HALLS[scenario]
    assert np.all(np.abs(drop.position_m) <= [size.length_m / 2, size.width_m / 2])
    assert np.all(drop.distance_3d_m >= drop.distance_2d_m)
    assert np.all(drop.distance_2d_m >= hall.CLOSEST_M)
    assert np.all(np.isneginf(drop.k_factor_db) == ~drop.in_sight)
    if scenario == "InF-LOS":
        assert drop.in_sight.all()
    # Losses scatter about the median loss with the scenario's shadowing.
    for sight, kind in ((True, "InF-LOS"), (False, scenario)):
        rows = drop.in_sight == sight
        if rows.sum() > 30:
            scatter = drop.loss_db[rows] - path_loss_db(kind, 3.75, drop.distance_3d_m[rows])
            assert abs(scatter.mean()) < SCENARIOS[kind].shadowing_db
            assert 0.5 < scatter.std() / SCENARIOS[kind].shadowing_db < 1.5


@pytest.mark.parametrize(
    ("scenario", "seed"),
    [("InF-SL", seed) for seed in (61, 249, 266, 276, 282, 332)]
    + [("InF-DL", 204), ("InF-DL", 367)],
)
def test_who_is_pushed_out_to_the_bound_stands_on_it(scenario, seed):
    drop = hall.drop_devices(scenario, 3.75, 200, seed)
    assert drop.distance_2d_m.min() == drop.distance_3d_m.min() == hall.CLOSEST_M
    assert np.all(np.isfinite(drop.loss_db))


def test_a_device_on_the_very_mast_is_pushed_out_too():
    point = hall.FactoryHall(1e-12, 1e-12, 0.2, 10.0, 2.0, 1.5)
    drop = hall.drop_devices("InF-SL", 3.75, 3, 0, factory_hall=point)
    assert np.array_equal(drop.distance_3d_m, [hall.CLOSEST_M] * 3)


def test_shadowing_is_correlated_over_ten_metres():
    small = hall.FactoryHall(40.0, 20.0, 0.2, 10.0, 2.0, 8.0)
    pairs = []
    for seed in range(400):
        drop = hall.drop_devices("InF-LOS", 3.75, 2, seed, factory_hall=small)
        scatter = drop.loss_db - path_loss_db("InF-LOS", 3.75, drop.distance_3d_m)
        pairs.append([np.linalg.norm(np.diff(drop.position_m, axis=0)), scatter.prod() / 4.3**2])
    apart, product = np.array(pairs).T
    # E[s₁ s₂]/σ² = e^(−Δ/10): the mean product of a bin within 4 standard errors (sd ≈ √2).
    for near, far in ((0, 8), (8, 16), (16, 50)):
        rows = (apart >= near) & (apart < far)
        expected = np.exp(-apart[rows] / 10).mean()
        assert abs(product[rows].mean() - expected) < 4 * 1.42 / math.sqrt(rows.sum())


def test_first_devices_do_not_depend_on_how_many_there_are():
    few, many = hall.drop_devices("InF-SH", 3.75, 5, 1), hall.drop_devices("InF-SH", 3.75, 50, 1)
    assert few.loss_db == pytest.approx(many.loss_db[:5], abs=1e-9)
    assert np.array_equal(few.in_sight, many.in_sight[:5])


def test_dense_clutter_hides_the_base_station():
    assert hall.drop_devices("InF-SH", 3.75, 300, 0).in_sight.mean() > 0.7
    assert hall.drop_devices("InF-DL", 3.75, 300, 0).in_sight.mean() < 0.1


def test_power_control_holds_the_target():
    loss, noise = np.array([70.0, 83.0, 95.0]), thermal_noise_dbm(20e6, 6.0)
    gain = np.array([0.1, 1.0, 3.0])
    power = hall.required_power_dbm(20.0, loss, noise, gain)
    assert power - loss - noise + 10 * np.log10(gain) == pytest.approx([20.0] * 3)
    margin = hall.power_margin_db(23.0, 20.0, loss, noise)
    # Blocked exactly where the fade is deeper than the margin.
    assert np.array_equal(power > 23.0, gain < 10 ** (-margin / 10))
    assert hall.required_power_dbm(20.0, 80.0, noise, 0.0) == math.inf


def test_the_share_of_blocked_devices_is_the_rayleigh_outage():
    gains = np.random.default_rng(0).standard_exponential(400_000)
    blocked = hall.required_power_dbm(20.0, 90.0, -95.0, gains) > 23.0
    expected = stats.expon.cdf(10 ** (-hall.power_margin_db(23.0, 20.0, 90.0, -95.0) / 10))
    assert abs(blocked.mean() - expected) < 4 * math.sqrt(expected / len(gains))


def test_bad_halls_are_refused():
    with pytest.raises(UsageError, match="unknown scenario"):
        hall.drop_devices("InF-XX", 3.75, 3, 0)
    low_clutter = hall.FactoryHall(300.0, 150.0, 0.2, 10.0, 1.5, 8.0)
    with pytest.raises(UsageError, match="not above the device"):
        hall.drop_devices("InF-SH", 3.75, 3, 0, factory_hall=low_clutter)
    with pytest.raises(UsageError, match="carrier"):
        hall.drop_devices("InF-SH", 200.0, 3, 0)
    huge = hall.FactoryHall(3000.0, 150.0, 0.2, 10.0, 2.0, 8.0)
    with pytest.raises(UsageError, match="3D distance"):
        hall.drop_devices("InF-SH", 3.75, 30, 0, factory_hall=huge)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason="sionna-no-rt not installed")
def test_path_loss_and_sight_equal_sionna_s():
    import torch
    from sionna.phy.channel.tr38901 import InFScenario, PanelArray

    double = {"precision": "double", "device": "cpu"}
    antenna = PanelArray(
        num_rows_per_panel=1,
        num_cols_per_panel=1,
        polarization="single",
        polarization_type="V",
        antenna_pattern="omni",
        carrier_frequency=3.75e9,
        **double,
    )
    for name in ("SL", "DL", "SH", "DH"):
        size, drop = (
            hall.FACTORY_HALLS[f"InF-{name}"],
            hall.drop_devices(f"InF-{name}", 3.75, 50, 0),
        )
        for in_sight, kind in ((False, f"InF-{name}"), (True, "InF-LOS")):
            peer = InFScenario(
                3.75e9, name, antenna, antenna, "uplink", enable_shadow_fading=False, **double
            )
            place = np.column_stack([drop.position_m, np.full(50, size.ue_height_m)])
            none = torch.zeros(1, 50, 3, dtype=torch.float64)
            peer.set_topology(
                torch.tensor(place[None]),
                torch.tensor([[[0.0, 0.0, size.bs_height_m]]], dtype=torch.float64),
                none,
                none[:, :1],
                none,
                torch.ones(1, 50, dtype=torch.bool),
                los=in_sight,
            )
            ours = path_loss_db(kind, 3.75, drop.distance_3d_m)
            assert peer.basic_pathloss[0, 0].numpy() == pytest.approx(ours, abs=1e-9)
        sight = line_of_sight_probability(
            f"InF-{name}",
            drop.distance_2d_m,
            clutter_density=size.clutter_density,
            clutter_size_m=size.clutter_size_m,
            clutter_height_m=size.clutter_height_m,
            bs_height_m=size.bs_height_m,
            ue_height_m=size.ue_height_m,
        )
        assert peer.los_probability[0, 0].numpy() == pytest.approx(sight, abs=1e-12)
