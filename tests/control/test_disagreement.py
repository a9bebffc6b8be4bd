"""The distance between two levels: by hand, calibrated, and in a cell."""

import numpy as np
import pytest
import torch
from test_controllers import untrained_model

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import StrideController
from hjepa_cli.core.control.disagreement import TwoLevels, calibrate_levels
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.error_growth import conformal_growth
from hjepa_cli.core.control.loop import Link, LinkDraws
from hjepa_cli.core.control.planners import OnePredictor
from hjepa_cli.core.radio.uplink import Access, Uplink

AGES = (4, 20, 80)


class Straight:
    """Strides of three steps that add 1 N to the embedding per step."""

    stride = 3

    def plan(self, z):
        return z[:, :1] + torch.arange(3), z + 3.0


def test_levels_part_with_every_stride_and_meet_at_a_packet():
    alone = StrideController(Straight(), 2)
    both = TwoLevels(
        StrideController(Straight(), 2),
        step=lambda z, forces_n: z + 1.5,  # where the other level thinks a step leads
        act=lambda z: z[:, 0],
        force_limit_n=20.0,
    )
    everybody, second = np.ones(2, dtype=bool), np.array([False, True])
    apart = []
    for k in range(9):
        arrives = everybody if k == 0 else second & (k == 4)
        packets = torch.zeros(int(arrives.sum()), 1) if arrives.any() else None
        assert np.array_equal(both.act(arrives, packets), alone.act(arrives, packets))
        assert np.array_equal(both.planned_n(), alone.planned_n())
        apart.append(both.apart * 40)
    # Half a newton a step, known at the end of each stride; device 1 starts anew at k = 4.
    assert np.transpose(apart) == pytest.approx(
        np.array([[0, 0, 1.5, 1.5, 1.5, 3, 3, 3, 4.5], [0, 0, 1.5, 1.5, 0, 0, 1.5, 1.5, 1.5]])
    )


class Late(Straight):
    def follow(self, z, forces_n, ages):
        return z + torch.from_numpy(ages).float()[:, None]


def levels_of(controller):
    return TwoLevels(controller, lambda z, forces_n: z + 1.5, lambda z: z[:, 0], 20.0)


def test_before_a_late_packet_comes_levels_are_not_apart():
    both = levels_of(StrideController(Late(), 2))
    nobody, first = np.zeros(2, dtype=bool), np.array([True, False])
    for _ in range(4):
        assert (both.act(nobody, None, np.zeros(0, int)) == 0).all() and (both.apart == 0).all()
    both.act(first, torch.zeros(1, 1), np.array([2]))
    for _ in range(2):
        both.act(nobody, None, np.zeros(0, int))
    assert both.apart * 40 == pytest.approx([1.5, 0.0])  # who is not heard yet has no levels


def test_late_packets_and_lost_forces_are_those_without_the_other_level():
    lost = np.random.default_rng(0).random((40, 2)) < 0.5

    def played(wrap):
        link = Link(LinkDraws(2, None, lost, 3), wrap(StrideController(Late(), 2)))
        sent = lambda k: np.array([k % 9 == 0, k % 7 == 0])  # noqa: E731
        packets = lambda k: torch.full((int(sent(k).sum()), 1), float(k))  # noqa: E731
        return [link.forces_n(sent(k), packets(k) if sent(k).any() else None) for k in range(40)]

    assert np.array_equal(played(levels_of), played(lambda controller: controller))


def test_a_packet_that_is_kept_back_is_no_start_of_either_level():
    class KeepsBack:
        """Passes the first step's packets on, and no others."""

        def __init__(self, devices):
            self.pass_on = lambda *first: self._later(*first)

        def _later(self, *first):
            self.pass_on = lambda delivered, packets, ages: (delivered & False, None, ages)
            return first

    checked = levels_of(StrideController(Straight(), 2, check=KeepsBack))
    undisturbed = levels_of(StrideController(Straight(), 2))
    everybody = np.ones(2, dtype=bool)
    for k in range(9):
        packets = torch.zeros(2, 1) if k in (0, 4) else None
        forces_n = checked.act(everybody if k in (0, 4) else ~everybody, packets)
        arrives = packets if k == 0 else None
        expected_n = undisturbed.act(everybody if k == 0 else ~everybody, arrives)
        assert np.array_equal(forces_n, expected_n)
        assert np.array_equal(checked.apart, undisturbed.apart), k


def devices(count, slope, seed):
    """Errors whose scale follows the levels' distance with a slope, over ages."""
    random = np.random.default_rng(seed)
    common = np.sqrt(AGES) * 0.01
    apart = common * np.exp(random.normal(size=(count, 3)))
    scale = common * (apart / common) ** slope
    return scale * np.exp(0.3 * random.normal(size=(count, 3))), apart


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_the_slope_is_found_and_new_devices_stay_below_nine_times_in_ten(slope):
    levels = calibrate_levels(AGES, *devices(2000, slope, 1))
    assert levels.exponent == pytest.approx(slope, abs=0.03)
    errors, apart = devices(4000, slope, 2)
    for place, age in enumerate(AGES):
        bound = levels.growth.at(age) * levels.relative_growth(np.full(4000, age), apart[:, place])
        inside = errors[:, place] ** 2 <= bound
        assert inside.mean() == pytest.approx(0.9, abs=4 * np.sqrt(0.09 / 1000))
        # Not only on average: in the half where the levels are far apart, too.
        far = apart[:, place] > np.median(apart[:, place])
        assert inside[far].mean() == pytest.approx(0.9, abs=0.05)


def test_age_alone_does_not_cover_where_levels_are_far_apart():
    errors, apart = devices(4000, 1.0, 3)
    growth = conformal_growth(AGES, devices(2000, 1.0, 1)[0])
    far = apart[:, 1] > np.median(apart[:, 1])
    assert (errors[far, 1] ** 2 <= growth.at(20)).mean() < 0.85


def test_levels_that_know_nothing_leave_the_growth_table():
    errors, apart = devices(78, 0.0, 4)
    shuffled = np.random.default_rng(5).permutation(apart)
    levels = calibrate_levels(AGES, errors, shuffled)
    assert levels.exponent < 0.1
    assert levels.growth.at(AGES) == pytest.approx(
        conformal_growth(AGES, errors[39:]).at(AGES), rel=0.5
    )
    assert (
        levels.relative_growth(20, np.array([0.0])) > 0
    )  # levels that agree fully: floored, not 0


def test_the_uplink_serves_the_doubted_first():
    levels = calibrate_levels(AGES, *devices(78, 1.0, 6))
    for scheduler in ("whittle", "innovation"):
        known = Access(scheduler, 1, 300.0, -np.inf, 1.0, (0.0,), levels.growth, 0, levels)
        uplink = Uplink(known, 3)
        uplink.begin()
        uplink.grant()
        uplink.begin()
        uplink.weigh(np.array([0.01, 0.09, 0.03]))
        assert np.flatnonzero(uplink.grant()) == [1]  # all of one age, none has reported


@torch.no_grad()
def test_a_model_s_levels_are_the_hierarchy_and_its_one_step_predictor():
    torch.manual_seed(0)
    model = untrained_model()
    for layer in model.networks.modules():
        if isinstance(layer, torch.nn.Linear):
            torch.nn.init.normal_(layer.weight, std=0.05)
    method = build_driver("hjepa", load_settings(), model)
    assert build_driver("ts-jepa-1", load_settings(), model).two_levels is None
    both, alone = method.two_levels(3), method.controller(3)
    everybody, flat = np.ones(3, dtype=bool), torch.randn(3, 256)
    forces_n = [both.act(everybody, flat)]
    assert np.array_equal(forces_n[0], alone.act(everybody, flat))
    for k in range(1, 9):
        flat = OnePredictor(model, model.networks["flat"], 1).step(
            flat, torch.from_numpy(forces_n[-1]).float()
        )
        if k % model.strides.h == 0:
            reached = alone.reached[1]
            apart = (model.actor(reached) - model.actor(flat)).abs().numpy() / 40
            assert apart.min() > 0 and both.apart == pytest.approx(apart, rel=1e-4)
        forces_n.append(both.act(~everybody, None))
        assert np.array_equal(forces_n[-1], alone.act(~everybody, None))
