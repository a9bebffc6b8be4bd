"""Many loops on one scheduled uplink, against the loop whose deliveries are given."""

import dataclasses
import math
import tracemalloc

import numpy as np
import pytest
import torch

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import LastForce, StrideController
from hjepa_cli.core.control.disagreement import LevelDisagreement, TwoLevels
from hjepa_cli.core.control.drivers import Driver
from hjepa_cli.core.control.error_growth import ErrorGrowthTable
from hjepa_cli.core.control.loop import Draws, every_step, gap_schedule, simulate
from hjepa_cli.core.control.methods.true_state import true_state_driver
from hjepa_cli.core.evaluation.cell_simulation import (
    CHUNK_STEPS,
    CellOutcome,
    Outbox,
    measure_growth,
    simulate_cell,
    streamed_draws,
)
from hjepa_cli.core.evaluation.load_search import (
    MAX_BISECTIONS,
    LoadPoint,
    blocks_for,
    combine,
    find_load,
)
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.phy.shannon import report_bits
from hjepa_cli.core.radio.uplink import Access, Uplink
from hjepa_cli.errors import UsageError

DESKTOP = plant("desktop")
PROTOCOL = load_settings(flags={"protocol": "paper"}).protocol
ANY_GROWTH = ErrorGrowthTable(np.arange(1.0, 400.0))
NO_FADING = 300.0  # dB of power margin


def protocol(**changes):
    return dataclasses.replace(PROTOCOL, **changes)


def method(name):
    return true_state_driver(name, DESKTOP, 2064)


def access(scheduler="round-robin", blocks=1, **changes):
    known = {
        "margin_db": NO_FADING,
        "k_factor_db": -math.inf,
        "coherence_slots": 1.0,
        "round_errors": (0.0,),
        "growth": ANY_GROWTH,
        "seed": 0,
    }
    return Access(scheduler, blocks, **{**known, **changes})


def cell(name, devices, use, steps=300, seed=0, **changes):
    return simulate_cell(
        DESKTOP, protocol(steps=steps, **changes), seed, devices, use, method(name)
    )


def given(name, schedule, seed=0, **changes):
    steps, devices = schedule.shape
    draws = Draws.make(protocol(steps=steps, **changes), devices, seed)
    one = method(name)
    return simulate(DESKTOP, draws, schedule[None], one.controller(devices), one.sensor)


# --- The loop -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["hold-true", "oracle", "zero-true"])
@pytest.mark.parametrize("devices", [1, 7, 40])
def test_round_robin_without_fading_is_duty_exactly(name, devices):
    ours = cell(name, devices, access())
    turns = np.arange(300)[:, None] % devices == np.arange(devices)
    turns[0] = True
    theirs = given(name, turns)
    assert np.array_equal(ours.score, theirs.score[0])
    assert np.array_equal(ours.cost, theirs.cost[0])
    assert ours.packets.sum() == 299


@pytest.mark.parametrize("blocks", [2, 3])
def test_turns_on_several_blocks_are_duty_with_other_phases(blocks):
    load, steps = 13, 200
    phases = np.arange(load * blocks) // blocks
    schedule = np.arange(steps)[:, None] % load == phases
    schedule[0] = True
    ours = cell("hold-true", load * blocks, access(blocks=blocks), steps=steps)
    assert np.array_equal(ours.score, given("hold-true", schedule).score[0])


def test_turns_without_fading_carry_what_duty_tolerates():
    """Counts within 1/D* of each other: loads within a device per block, whatever the phases."""
    steps = 300
    teacher = given("optimal", every_step(steps, 200)).score[0]

    def by_turns(load):
        blocks = blocks_for(load)
        return cell("hold-true", load * blocks, access(blocks=blocks), steps=steps)

    def by_duty(load):
        found = given("hold-true", gap_schedule(load, steps, load * blocks_for(load)))
        return CellOutcome(found.score[0], found.cost[0], np.zeros(1, int), 0, steps - 1)

    loads = []
    for drive in (by_turns, by_duty):

        def simulate_load(load, drive=drive):
            found = drive(load)
            return LoadPoint(load, blocks_for(load), found, teacher[: len(found.score)])

        loads.append(find_load(simulate_load, 0.62, 0.03, replicates=10, seed=0, start=50.0).load)
    assert loads[0] == pytest.approx(loads[1], abs=1.0)


@pytest.mark.parametrize("scheduler", ["round-robin", "opportunistic", "max-aoi", "whittle"])
def test_a_block_for_everybody_is_a_perfect_link(scheduler):
    ours = cell("hold-true", 9, access(scheduler, blocks=9), plant_spread=0.2)
    theirs = given("hold-true", every_step(300, 9), plant_spread=0.2)
    assert np.array_equal(ours.score, theirs.score[0])


@pytest.mark.parametrize("name", ["hold-true", "oracle"])
def test_a_late_link_is_late_in_the_cell_as_it_is_alone(name):
    link = {"delay_steps": 9, "jitter_steps": 3, "downlink_loss": 0.2}
    ours = cell(name, 9, access(blocks=9), **link)
    assert np.array_equal(ours.cost, given(name, every_step(300, 9), **link).cost[0])
    assert not np.array_equal(ours.cost, cell(name, 9, access(blocks=9)).cost)


def test_two_levels_meet_a_late_link():
    """The scheduler asks how far they are apart before the first packet has come."""

    class Standing:
        stride = 2

        def plan(self, z):
            return z[:, :1].expand(-1, 2), z

        def follow(self, z, forces_n, ages):
            return z

    def drives(devices):
        controller = StrideController(Standing(), devices)
        return TwoLevels(controller, lambda z, forces_n: z + 0.1, lambda z: z[:, 0], 20.0)

    one = Driver("levels", lambda seen: torch.zeros(len(seen), 1), drives, drives, 2064, "levels")
    levels = LevelDisagreement(ANY_GROWTH, np.full(20, 0.01), 0.5)
    slots = protocol(steps=30, delay_steps=4)
    found = simulate_cell(DESKTOP, slots, 0, 6, access("whittle", levels=levels), one)
    assert np.isfinite(found.cost).all()


def test_samples_under_way_are_not_those_that_are_kept():
    everybody = np.ones(3, dtype=bool)
    for make in (np.zeros, torch.zeros):
        outbox = Outbox()
        under_way = outbox.deliver(make((3, 2)), everybody, everybody)
        assert outbox.deliver(make((3, 2)) + 1, everybody, ~everybody) is None
        assert (under_way == 0).all()
        copies = outbox.deliver(None, ~everybody, everybody)
        assert (copies == 1).all()


def test_age_based_schedulers_without_fading_are_round_robin():
    scores = [cell("oracle", 30, access(name)).score for name in ("max-aoi", "whittle")]
    assert np.array_equal(scores[0], scores[1])
    # After the common first packet the oldest is whoever is next in turn.
    assert scores[0].mean() == pytest.approx(cell("oracle", 30, access()).score.mean(), abs=0.02)


def test_fades_beyond_the_margin_cost_round_robin_its_turns():
    steps, margin_db = 800, 3.0
    blocked = 1 - math.exp(-(10 ** (-margin_db / 10)))
    blind = cell("hold-true", 10, access(margin_db=margin_db), steps=steps)
    share = blind.packets.sum() / (steps - 1)
    assert abs(share - (1 - blocked)) < 4 * math.sqrt(blocked * (1 - blocked) / steps)
    seeing = cell("hold-true", 10, access("max-aoi", margin_db=margin_db), steps=steps)
    assert seeing.packets.sum() > 0.99 * steps  # somebody of ten can nearly always send


def test_block_errors_are_lost():
    found = cell("hold-true", 10, access(round_errors=(0.2,)), steps=800)
    assert abs(found.packets.sum() / 799 - 0.8) < 4 * math.sqrt(0.16 / 799)


def test_copies_of_a_lost_sample_are_combined():
    alone, repeated = (
        cell("hold-true", 10, access(round_errors=errors), steps=1200)
        for errors in ((0.5,), (0.5, 0.0))
    )
    # A packet takes 2 transmissions on average, or 1.5: half of them a second copy.
    assert abs(alone.packets.sum() / 1199 - 1 / 2) < 4 * math.sqrt(0.25 / 1199)
    assert abs(repeated.packets.sum() / 1199 - 2 / 3) < 4 * math.sqrt(0.25 / 1199)
    assert repeated.score.mean() > alone.score.mean()


def test_devices_of_one_margin_each():
    margins = np.array([NO_FADING, -60.0, NO_FADING])
    found = cell("hold-true", 3, access("max-aoi", margin_db=margins), steps=100)
    assert found.packets[1] == 0 and found.packets[0] > 45 and found.packets[2] > 45


def test_draws_are_those_of_the_other_loop_and_are_not_kept():
    steps = CHUNK_STEPS + 40
    options = protocol(steps=steps, plant_spread=0.3)
    draws = Draws.make(options, 4, 5)
    initial, mass_scale, noise = streamed_draws(options, 4, 5)
    assert np.array_equal(initial, draws.initial)
    assert np.array_equal(mass_scale, draws.mass_scale)
    assert np.array_equal([next(noise) for _ in range(steps)], draws.noise)


def test_memory_does_not_grow_with_slots():
    def peak(steps):
        tracemalloc.start()
        cell("hold-true", 8, access("innovation", margin_db=5.0), steps=steps)
        top = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return top

    peak(10)
    # 8 devices × 600 more steps of noise alone would be 154 kB.
    assert peak(700) - peak(100) < 60_000


# --- Innovation ---------------------------------------------------------------------------------


def test_a_perfect_prediction_has_nothing_to_report():
    calm = {"noise_x_dot_m_s": 0.0, "noise_theta_dot_rad_s": 0.0}
    quiet = cell("oracle", 20, access("innovation"), **calm)
    assert quiet.reports == 0
    assert cell("oracle", 20, access("innovation")).reports > 0


def test_innovation_carries_loads_that_turns_do_not():
    use = {"margin_db": 10.0, "growth": measure_growth(DESKTOP, PROTOCOL, 9, method("hold-true"))}
    loads = {
        name: cell("hold-true", 100, access(name, blocks=2, **use), steps=700)
        for name in ("round-robin", "max-aoi", "innovation")
    }
    scores = {name: found.score.mean() for name, found in loads.items()}
    # 50 loops a block: 0.83 against 0.27 at 1,000 steps of 200 devices.
    assert scores["innovation"] > 0.65 > 0.5 > scores["max-aoi"]
    reports = loads["innovation"].reports / (2 * 700)
    assert 0.5 < reports < 2.0  # δ is steered to one per block and slot


def test_reports_tell_who_deserves_the_block():
    uplink = Uplink(access("innovation", margin_db=NO_FADING), 4)
    uplink.begin()
    assert uplink.grant().all()  # the first slot is everybody's
    uplink.begin()
    everybody = np.ones(4, dtype=bool)
    uplink.hear(everybody, np.array([0.0, 0.011, 0.30, 0.05]))
    assert uplink.reports == 2  # 0.011 is below δ = 0.02
    assert np.flatnonzero(uplink.grant()).tolist() == [2]
    uplink.begin()
    uplink.hear(everybody, np.array([0.0, 0.0, 0.0, 0.07]))
    assert uplink.reports == 2  # device 3 has reported; its innovation has not doubled
    assert np.flatnonzero(uplink.grant()).tolist() == [3]
    assert report_bits(1000) == 18 and report_bits(1024) == 18 and report_bits(1025) == 19


def test_devices_take_turns_to_look_once_they_may_have_something_to_say():
    growth = ErrorGrowthTable(
        np.r_[np.full(12, 1e-9), np.ones(300)]
    )  # nothing can have gone wrong before age 13
    uplink = Uplink(access("innovation", growth=growth, round_errors=(1.0,)), 10)
    looked = np.zeros((21, 10))
    for slot in range(21):
        uplink.begin()
        looked[slot] = uplink.checking()
        uplink.hear(uplink.checking(), np.zeros(int(looked[slot].sum())))
        uplink.grant()
    assert not looked[:13].any()
    assert np.all(looked[13:].sum(axis=0) == 1)  # in slots 13 to 20, every eighth


class Ramp:
    """A planner whose forces count up from the embedding."""

    stride = 3

    def plan(self, z):
        return z[:, :1] + torch.arange(3), z + 3


@pytest.mark.parametrize("kind", ["stride", "hold", "zero", "oracle"])
def test_the_outlook_is_what_is_played_without_a_packet(kind):
    random = np.random.default_rng(0)
    if kind == "stride":
        controller, packets = StrideController(Ramp(), 5), torch.rand(5, 2)
    elif kind == "oracle":
        controller, packets = method("oracle").controller(5), random.normal(size=(5, 4)) * 0.05
    else:
        controller, packets = LastForce(lambda p: p, 5, keep=kind == "hold"), random.normal(size=5)
    peer = method("oracle").controller(5) if kind == "oracle" else None
    controller.act(np.ones(5, dtype=bool), packets)
    if peer:
        peer.act(np.ones(5, dtype=bool), packets)
    for step in range(8):
        arrives = random.random(5) < 0.3 if step % 2 else np.zeros(5, dtype=bool)
        planned = controller.planned_n()
        assert np.array_equal(planned, controller.planned_n())
        played = controller.act(arrives, packets[arrives] if arrives.any() else None)
        assert np.array_equal(played[~arrives], planned[~arrives])
        if peer:
            other = peer.act(arrives, packets[arrives] if arrives.any() else None)
            assert np.array_equal(played, other)  # looking ahead changes nothing


def test_growth_tells_controllers_apart():
    hold, oracle = (
        measure_growth(DESKTOP, PROTOCOL, 9, method(name)) for name in ("hold-true", "oracle")
    )
    assert np.all(np.diff(hold.table) >= 0) and len(hold.table) == 320
    assert np.all(hold.at([5, 20, 40]) > 5 * oracle.at([5, 20, 40]))


# --- Loads --------------------------------------------------------------------------------------


def curve(crossing, calls, level=0.62, spread=0.01):
    """A stand-in for the simulation: the score falls through the level at ``crossing``.

    ``spread``: the devices' scores lie evenly within ± this.
    """

    def simulate_load(load):
        calls.append(load)
        score = np.full(40, level + 0.004 * (crossing - load))
        score += np.linspace(-spread, spread, 40)
        outcome = CellOutcome(score, score, np.full(40, 25), 100, 1000)
        return LoadPoint(load, 1, outcome, np.ones(40))

    return simulate_load


@pytest.mark.parametrize("crossing", [1.5, 7.3, 41.5, 137.0, 198.2, 480.0])
def test_loads_are_found_in_eight_bisections(crossing):
    calls = []
    found = find_load(curve(crossing, calls), 0.62, 0.03, replicates=200, seed=0)
    assert len(calls) == len(set(calls)) <= MAX_BISECTIONS + 2  # narrow: one more for each end
    assert found.load == pytest.approx(crossing, abs=1e-6)
    assert found.interval[0] < found.load < found.interval[1]
    assert not found.at_least
    assert found.packets_per_slot == 1.0 and found.reports_per_slot == 0.1


@pytest.mark.parametrize("crossing", [100.05, 102.95])
def test_both_ends_of_the_interval_are_simulated(crossing):
    """A crossing close to a simulated load: draws of the devices cross outside the bracket."""
    calls = []
    found = find_load(curve(crossing, calls), 0.62, 0.03, replicates=5000, seed=0, start=100.0)
    assert len(calls) == len(set(calls))
    low, high = found.interval
    # Scores spread evenly over ± 0.01, 40 devices, 0.004 per unit of load: ± 0.46.
    assert crossing - low == pytest.approx(0.46, rel=0.1)
    assert high - crossing == pytest.approx(0.46, rel=0.1)
    assert min(calls) < low and high < max(calls)


@pytest.mark.parametrize("spread", [0.2, 0.5])
def test_a_wide_interval_is_not_cut_off_at_the_simulated_loads(spread):
    """Devices that differ much: the ends are where the bootstrap of all of them has them."""
    calls = []
    found = find_load(
        curve(100.0, calls, spread=spread), 0.62, 0.03, replicates=5000, seed=0, start=100.0
    )
    half = 1.96 * spread / math.sqrt(3) * math.sqrt(41 / 39) / math.sqrt(40) / 0.004
    assert found.interval == pytest.approx((100 - half, 100 + half), rel=0.1)
    assert min(calls) < found.interval[0] and found.interval[1] < max(calls)


@pytest.mark.parametrize("crossing", [2.3, 3.4])
def test_few_devices_are_widened_by_one(crossing):
    """15 % of three devices round to none."""
    calls = []
    found = find_load(
        curve(crossing, calls, spread=0.02), 0.62, 0.03, replicates=5000, seed=0, start=crossing
    )
    half = 1.96 * 0.02 / math.sqrt(3) * math.sqrt(41 / 39) / math.sqrt(40) / 0.004
    assert len(calls) == len(set(calls))
    assert found.interval == pytest.approx((crossing - half, crossing + half), rel=0.15)


@pytest.mark.parametrize("start", [0.0, 1.0, 30.0, 41.5, 60.0, 500.0])
def test_a_load_near_the_one_to_find_saves_simulations(start):
    calls = []
    found = find_load(curve(41.5, calls), 0.62, 0.03, replicates=50, seed=0, start=start)
    assert found.load == pytest.approx(41.5, abs=1e-6)
    assert len(calls) == len(set(calls)) <= (5 if 0.8 < start / 41.5 < 1.2 else MAX_BISECTIONS)


def test_loads_beyond_the_range():
    calls = []
    most = find_load(curve(5000.0, calls), 0.62, 0.03, replicates=50, seed=0)
    assert most.at_least and most.load > 490
    none = find_load(curve(0.5, calls), 0.62, 0.03, replicates=50, seed=0)
    assert none.load == 0.0 and not none.at_least


def test_seeds_are_averaged():
    found = [find_load(curve(c, []), 0.62, 0.03, replicates=50, seed=0) for c in (90.0, 100.0)]
    both = combine(found)
    assert both.load == pytest.approx(95.0)
    half = 12.7062047 * math.sqrt(50) / math.sqrt(2)  # Student's t, one degree of freedom
    assert both.interval == pytest.approx((95 - half, 95 + half))
    assert combine(found[:1]) is found[0]
    loads = [load for load, _ in both.points]
    assert loads == sorted(loads) and len(loads) == sum(len(one.points) for one in found)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"blocks": 5}, "5 resource blocks for 4"), ({"blocks": 0}, "0 resource blocks")],
)
def test_bad_uplinks_are_refused(change, message):
    with pytest.raises(UsageError, match=message):
        Uplink(dataclasses.replace(access(), **change), 4)
    with pytest.raises(UsageError, match="choose from round-robin"):
        Uplink(access("fifo"), 4)
