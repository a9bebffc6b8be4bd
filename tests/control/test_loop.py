"""The closed loop: schedules against brute force, simulations against plain loops."""

import dataclasses
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from played import play

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.controllers import LastForce, Oracle
from hjepa_cli.core.control.loop import (
    Draws,
    delivery_schedule,
    every_step,
    gap_schedule,
    last_states,
    noise_per_step,
    packets_per_step,
    simulate,
)
from hjepa_cli.core.plants.cartpole.plant import CartPolePlant
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.named import plant, teacher
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import NumericalError, UsageError

DESKTOP = plant("desktop")


def protocol(**changes: Any) -> ProtocolSettings:
    return dataclasses.replace(
        load_settings(flags={"protocol": "paper"}).protocol, **{"steps": 60, **changes}
    )


def true_state(seen: np.ndarray) -> np.ndarray:
    return seen[:, -1]


# --- Schedules ----------------------------------------------------------------------------------


@given(
    st.fractions(1, 50, max_denominator=16),
    st.integers(1, 70),
    st.integers(1, 60),
)
def test_gap_schedule_by_brute_force(gap: Fraction, steps: int, devices: int) -> None:
    schedule = gap_schedule(float(gap), steps, devices)
    for device in range(devices):
        phase = float(gap) * ((device * (math.sqrt(5) - 1) / 2) % 1.0)
        times = {math.ceil(float(n * gap) + phase - 1e-9) for n in range(steps + 1)} | {0}
        assert np.flatnonzero(schedule[:, device]).tolist() == sorted(t for t in times if t < steps)


def test_gap_schedule_of_whole_gaps_spreads_devices_over_phases() -> None:
    schedule = gap_schedule(4, 40, 400)
    for device in range(400):
        assert set(np.diff(np.flatnonzero(schedule[4:, device]))) == {4}
    # After the common first packet the load is nearly the same at every step.
    assert np.abs(schedule[1:].sum(axis=1) - 100).max() <= 2


@pytest.mark.parametrize("gap", [1, 7.3, 48.1, 138.2, 180.9, 320])
@pytest.mark.parametrize(("warmup", "steps", "devices"), [(1000, 3000, 64), (0, 1000, 256)])
def test_packets_are_counted_as_a_loop_sends_them(
    gap: float, warmup: int, steps: int, devices: int
) -> None:
    """In steady state 1/D a step, to 1 %; from the start on the first packet comes on top."""
    sent = gap_schedule(gap, warmup + steps, devices)[warmup:].mean()
    assert packets_per_step(gap, steps, warmup) == pytest.approx(sent, rel=0.01)


@pytest.mark.parametrize("gap", [1.0, 1.5, 2.0, 7.3])
def test_the_packet_at_the_start_is_counted_exactly(gap: float) -> None:
    """Over 60 steps of 20,000 devices: the packet at 0 is more only where none was due."""
    sent = gap_schedule(gap, 60, 20_000).mean()
    assert packets_per_step(gap, 60, 0) == pytest.approx(sent, rel=2e-3)


def test_the_warm_up_is_not_scored() -> None:
    """Scores after a warm-up are those of the same steps of a longer simulation."""
    options = protocol(steps=100, warmup_steps=200)
    draws = Draws.make(options, 3, seed=0)
    assert (draws.steps, draws.warmup_steps) == (300, 200)
    seen: list[np.ndarray] = []
    outcome = simulate(
        DESKTOP,
        draws,
        gap_schedule(60, 300, 3)[None],
        LastForce(DESKTOP.teacher(), 3, keep=True),
        true_state,
        watch=lambda k, states, forces_n: seen.append(DESKTOP.in_band(states)),
    )
    assert outcome.score[0] == pytest.approx(np.mean(seen[200:], axis=0))
    assert not np.allclose(outcome.score[0], np.mean(seen, axis=0))


def test_steady_state_stays_when_the_scored_time_is_doubled_and_the_start_flatters() -> None:
    """The oracle at D = 140: two halves of the scored time agree, the first second is better."""
    draws = Draws.make(protocol(warmup_steps=0, steps=5000), 160, seed=0)
    inside: list[np.ndarray] = []
    drive = Oracle(DESKTOP.teacher(), DESKTOP.advance, DESKTOP.force_limit_n, 160)
    schedule = gap_schedule(140, 5000, 160)[None]
    watch = lambda k, states, forces_n: inside.append(DESKTOP.in_band(states))  # noqa: E731
    simulate(DESKTOP, draws, schedule, drive, true_state, watch=watch)
    scores = np.array(inside, float)
    start, first, second = scores[:1000].mean(0), scores[1000:3000].mean(0), scores[3000:].mean(0)
    error = np.std(first - second, ddof=1) / math.sqrt(160)
    assert abs(np.mean(first - second)) < 3 * error
    gain = start - scores[1000:].mean(0)
    assert np.mean(gain) > 2 * np.std(gain, ddof=1) / math.sqrt(160)


def test_loops_that_fell_are_lost() -> None:
    """Nobody drives: every pole falls."""
    draws = Draws.make(protocol(steps=600), 4, seed=0)
    drive = LastForce(lambda states: 0 * DESKTOP.teacher()(states), 4, keep=True)
    fallen = simulate(DESKTOP, draws, every_step(600, 4)[None], drive, true_state)
    held = LastForce(DESKTOP.teacher(), 4, keep=True)
    upright = simulate(DESKTOP, draws, every_step(600, 4)[None], held, true_state)
    assert fallen.lost.mean() > 0.5 and not upright.lost.any()


def test_a_fallen_device_is_over() -> None:
    """It sends nothing more, gets no force, is out of band and costs as much as a step can."""
    heard, told, states, forces_n = [], [], [], []

    class Pushes:
        """It drives all but device 0, which it pushes over."""

        def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
            heard.append(delivered.copy())
            forces_n = np.zeros(3)
            if packets is not None:
                forces_n[delivered] = DESKTOP.teacher()(packets)
            forces_n[0] = 20.0
            return forces_n

        def give_up(self, devices: np.ndarray) -> None:
            told.append((len(heard), devices.copy()))

    def watch(k: int, now: np.ndarray, played_n: np.ndarray) -> None:
        states.append(now.copy())
        forces_n.append(played_n.copy())

    draws = Draws.make(protocol(steps=500), 3, seed=0)
    outcome = simulate(DESKTOP, draws, every_step(500, 3)[None], Pushes(), true_state, watch=watch)
    [(fell_at, devices)] = told
    assert devices.tolist() == [True, False, False]
    theta = np.array(states)[:, 0, 2]
    assert fell_at == np.flatnonzero(np.abs(theta) >= np.pi / 2)[0]
    assert 50 < fell_at < 450
    sent, played_n = np.array(heard), np.array(forces_n)
    assert sent[:fell_at].all() and sent[:, 1:].all() and not sent[fell_at:, 0].any()
    assert (played_n[:fell_at, 0] == 20).all() and (played_n[fell_at:, 0] == 0).all()
    before = DESKTOP.cost(np.array(states)[:fell_at, 0], played_n[:fell_at, 0])
    cost = (before.sum() + (500 - fell_at) * COST_CAP) / 500
    assert outcome.cost[0, 0] == pytest.approx(cost, rel=1e-12)
    inside = DESKTOP.in_band(np.array(states)[:fell_at, 0]).sum() / 500
    assert outcome.score[0, 0] == pytest.approx(inside)
    assert outcome.lost[0].tolist() == [1, 0, 0]


def test_a_fallen_device_goes_on_where_a_simulation_says_so() -> None:
    heard: list[np.ndarray] = []

    class Pushes:
        def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
            heard.append(delivered.copy())
            return np.full(2, 20.0)

    draws = Draws.make(protocol(steps=400), 2, seed=0)
    simulate(DESKTOP, draws, every_step(400, 2)[None], Pushes(), true_state, ends=False)
    assert np.array(heard).all()


def test_fractional_gaps_keep_their_mean() -> None:
    schedule = gap_schedule(2.6, 2600, 1)
    assert schedule.sum() == 1000
    assert set(np.diff(np.flatnonzero(schedule[:, 0]))) == {2, 3}


def test_gap_of_one_and_certain_delivery_are_every_step() -> None:
    uniforms = np.random.default_rng(0).random((30, 5))
    assert np.array_equal(gap_schedule(1, 30, 5), every_step(30, 5))
    assert np.array_equal(delivery_schedule(1.0, uniforms), every_step(30, 5))


def test_delivery_schedule_thresholds_its_uniforms() -> None:
    uniforms = np.random.default_rng(0).random((4000, 3))
    some, more = delivery_schedule(0.1, uniforms), delivery_schedule(0.2, uniforms)
    assert np.array_equal(some[1:], uniforms[1:] < 0.1)
    assert some[1:].mean() == pytest.approx(0.1, abs=0.01)
    assert (more | some).sum() == more.sum()  # a better link delivers all that a worse one does


@pytest.mark.parametrize("gap", [1, 7, 333.3, 1e6])
def test_the_first_packet_always_arrives(gap: float) -> None:
    assert gap_schedule(gap, 20, 50)[0].all()
    assert delivery_schedule(1 / gap, np.random.default_rng(0).random((20, 50)))[0].all()


@pytest.mark.parametrize("gap", [0.5, 0.0, -1.0, math.nan, math.inf])
def test_gaps_below_one_step_and_without_end_are_refused(gap: float) -> None:
    with pytest.raises(UsageError, match="1 step or longer"):
        gap_schedule(gap, 10, 2)


@pytest.mark.parametrize("p", [-0.1, 1.1, math.nan])
def test_probabilities_outside_the_unit_interval_are_refused(p: float) -> None:
    with pytest.raises(UsageError, match="between 0 and 1"):
        delivery_schedule(p, np.zeros((10, 2)))


# --- Draws --------------------------------------------------------------------------------------


def test_draws_do_not_depend_on_how_many_devices_there_are() -> None:
    few, many = (Draws.make(protocol(plant_spread=0.1), count, seed=3) for count in (5, 12))
    for name in ("initial", "noise", "delivery", "mass_scale"):
        assert np.array_equal(getattr(few, name), getattr(many.part(slice(5)), name)), name


def test_draws_differ_between_seeds_and_devices_but_not_between_calls() -> None:
    draws = Draws.make(protocol(), 4, seed=3)
    assert np.array_equal(draws.noise, Draws.make(protocol(), 4, seed=3).noise)
    assert not np.array_equal(draws.noise, Draws.make(protocol(), 4, seed=4).noise)
    assert len(np.unique(draws.initial)) == 16


def test_draws_have_the_protocols_distributions() -> None:
    options = protocol(plant_spread=0.2)
    draws = Draws.make(options, 400, seed=0)
    half_widths = np.array([0.03, 0.1, 0.08, 0.5])
    assert (np.abs(draws.initial) <= half_widths).all()
    assert np.abs(draws.initial).mean(axis=0) == pytest.approx(half_widths / 2, rel=0.1)
    assert draws.noise.std(axis=(0, 1)) == pytest.approx([0, 0.002, 0, 0.03], rel=0.02)
    assert draws.delivery.mean() == pytest.approx(0.5, abs=0.01)
    assert draws.mass_scale.shape == (400, 2)
    assert (np.abs(draws.mass_scale - 1) <= 0.2).all()
    assert draws.mass_scale.std() == pytest.approx(0.2 / np.sqrt(3), rel=0.1)


def test_options_change_only_what_they_name() -> None:
    plain, spread, noisy = (
        Draws.make(protocol(**changes), 3, seed=0)
        for changes in ({}, {"plant_spread": 0.3}, {"process_noise": "isotropic"})
    )
    assert np.array_equal(plain.mass_scale, np.ones((3, 2)))
    assert np.array_equal(plain.noise, spread.noise)
    assert np.array_equal(plain.delivery, noisy.delivery)
    # The same gusts on x_dot; the other states now have them too.
    assert np.array_equal(plain.noise[..., 1], noisy.noise[..., 1])
    assert noisy.noise.std(axis=(0, 1)) == pytest.approx([0.002] * 4, rel=0.15)
    assert noise_per_step(protocol()).tolist() == [0.0, 0.002, 0.0, 0.03]


# --- Simulation ---------------------------------------------------------------------------------


def plain_loop(draws: Draws, schedule: np.ndarray, device: int, keep: bool) -> tuple[float, float]:
    """One device, one cart-pole, no batching: hold or zero on the true state."""
    poles = CartPoles(DESKTOP, 1, mass_scale=draws.mass_scale[device : device + 1])
    poles.states = draws.initial[device : device + 1]
    poles.step([0.0])
    act = teacher("desktop")
    score = cost = force = 0.0
    for k in range(draws.steps):
        x, x_dot, theta, theta_dot = state = poles.states[0]
        if schedule[k, device]:
            force = float(act(state))
        elif not keep:
            force = 0.0
        score += abs(x) <= 0.05 and abs(theta) <= 0.05
        quadratic = 20 * x**2 + 0.5 * x_dot**2 + 20 * theta**2 + 0.05 * theta_dot**2
        cost += min(quadratic + 0.05 * force**2, 50.0)
        poles.step([force])
        poles.states = np.clip(poles.states + draws.noise[k, device], -50, 50)
    return score / draws.steps, cost / draws.steps


@pytest.mark.parametrize("keep", [True, False])
def test_batched_points_equal_one_device_at_a_time(keep: bool) -> None:
    draws = Draws.make(protocol(plant_spread=0.1), 3, seed=5)
    schedules = np.stack(
        [gap_schedule(7, 60, 3), gap_schedule(2.5, 60, 3), delivery_schedule(0.2, draws.delivery)]
    )
    together = simulate(
        DESKTOP, draws, schedules, LastForce(teacher("desktop"), 9, keep=keep), true_state
    )
    for point in range(3):
        for device in range(3):
            score, cost = plain_loop(draws, schedules[point], device, keep)
            assert together.score[point, device] == pytest.approx(score, abs=1e-12)
            assert together.cost[point, device] == pytest.approx(cost, rel=1e-9)


def test_first_devices_do_as_they_do_among_many() -> None:
    draws = Draws.make(protocol(), 6, seed=5)

    def run(some: Draws) -> np.ndarray:
        schedule = gap_schedule(11, 60, some.devices)[None]
        controller = LastForce(teacher("desktop"), some.devices, keep=True)
        return simulate(DESKTOP, some, schedule, controller, true_state).cost[0]

    assert run(draws.part(slice(2))) == pytest.approx(run(draws)[:2], rel=1e-12)


class Recorder:
    """A controller that pushes gently and remembers which packets came when."""

    def __init__(self, devices: int) -> None:
        self.packets: list[dict[int, Any]] = []
        self.devices = devices

    def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
        arrived = np.flatnonzero(delivered)
        assert (packets is None) == (len(arrived) == 0)
        self.packets.append({int(i): packets[row] for row, i in enumerate(arrived)})
        return np.full(self.devices, 0.1 * len(self.packets))


def test_a_packet_of_step_k_carries_the_frames_up_to_k() -> None:
    """Golden index test: replay the plant alone and look up every state that was sent."""
    draws = Draws.make(protocol(steps=12), 2, seed=0)
    recorder = Recorder(2)
    simulate(
        DESKTOP,
        draws,
        gap_schedule(5, 12, 2)[None],
        recorder,
        lambda seen: seen,
    )
    poles = CartPoles(DESKTOP, 2)
    poles.states = draws.initial
    trajectory = {-1: poles.states}
    poles.step([0.0, 0.0])  # unscored, no force, no noise
    trajectory[0] = poles.states
    for k in range(12):
        poles.step(np.full(2, 0.1 * (k + 1)))
        poles.states = poles.states + draws.noise[k]
        trajectory[k + 1] = poles.states
    sent_at = {
        device: [k for k, p in enumerate(recorder.packets) if device in p] for device in (0, 1)
    }
    assert sent_at == {0: [0, 5, 10], 1: [0, 4, 9]}
    for k, packets in enumerate(recorder.packets):
        for device, seen in packets.items():
            expected = [trajectory[max(k - back, -1)][device] for back in range(15, -1, -1)]
            assert np.allclose(seen, expected, atol=1e-12)


def test_with_every_packet_hold_zero_and_oracle_are_the_optimal_controller() -> None:
    draws = Draws.make(protocol(), 4, seed=1)
    act = teacher("desktop")
    always = every_step(60, 4)[None]
    controllers = [
        LastForce(act, 4, keep=True),
        LastForce(act, 4, keep=False),
        Oracle(act, DESKTOP.advance, 20.0, 4),
    ]
    outcomes = [simulate(DESKTOP, draws, always, c, true_state) for c in controllers]
    for device in range(4):
        score, cost = plain_loop(draws, always[0], device, keep=True)
        for outcome in outcomes:
            assert outcome.score[0, device] == pytest.approx(score, abs=1e-12)
            assert outcome.cost[0, device] == pytest.approx(cost, rel=1e-9)


class NeverOver(CartPolePlant):
    """A pole that goes on swinging, as plants do that do not say what has fallen."""

    def fallen(self, states: np.ndarray) -> np.ndarray:
        return System.fallen(self, states)


def test_states_are_clipped_and_nothing_ends_a_run() -> None:
    swinging = NeverOver(**{f.name: getattr(DESKTOP, f.name) for f in dataclasses.fields(DESKTOP)})
    draws = Draws.make(protocol(steps=400), 2, seed=0)
    draws.initial[1, 1] = 49.0  # m/s, and it will be pushed further

    class Shove:
        def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
            return np.full(2, 1e6)  # the actuator clips to 20 N

    seen = []

    def sensor(states: np.ndarray) -> np.ndarray:
        seen.append(states[:, -1])
        return states[:, -1]

    outcome = simulate(swinging, draws, every_step(400, 2)[None], Shove(), sensor)
    assert len(seen) == 400
    assert np.abs(seen)[:, 0, 3].max() > 10  # the pole went round
    pushed = 20 * 400 / 0.3 * 1e-3  # F t / (M + m)
    assert seen[-1][0, 1] == pytest.approx(pushed, rel=0.15)
    assert np.max(seen) == 50.0
    assert outcome.cost[0, 0] > 15  # R u² alone is 20


def test_noise_moves_each_state_by_its_draw() -> None:
    options = protocol(steps=1, process_noise="isotropic")
    draws = Draws.make(options, 2, seed=0)
    quiet = dataclasses.replace(draws, noise=np.zeros_like(draws.noise))
    twice = [dataclasses.replace(d, noise=np.concatenate([d.noise] * 2)) for d in (draws, quiet)]
    after = []
    for some in (dataclasses.replace(d, delivery=np.zeros((2, 2))) for d in twice):
        recorder = Recorder(2)
        simulate(DESKTOP, some, every_step(2, 2)[None], recorder, true_state)
        after.append(np.stack([recorder.packets[1][device] for device in range(2)]))
    assert after[0] - after[1] == pytest.approx(draws.noise[0], abs=1e-12)


def test_a_controller_that_diverges_is_reported() -> None:
    class Broken:
        def act(self, delivered: np.ndarray, packets: Any) -> np.ndarray:
            return np.array([0.0, np.nan])

    draws = Draws.make(protocol(), 2, seed=0)
    with pytest.raises(NumericalError, match="not finite at step 0"):
        simulate(DESKTOP, draws, every_step(60, 2)[None], Broken(), true_state)


def test_ticks_count_control_steps() -> None:
    ticks = []
    draws = Draws.make(protocol(), 2, seed=0)
    controller = LastForce(teacher("desktop"), 2, keep=True)
    simulate(
        DESKTOP,
        draws,
        every_step(60, 2)[None],
        controller,
        true_state,
        tick=lambda: ticks.append(1),
    )
    assert len(ticks) == 60


def test_play_delivers_one_packet_to_every_device() -> None:
    recorder = Recorder(3)
    forces = play(recorder, np.array([7, 8, 9]), 3, 4)
    assert [sorted(packets) for packets in recorder.packets] == [[0, 1, 2], [], [], []]
    assert recorder.packets[0] == {0: 7, 1: 8, 2: 9}
    assert forces == pytest.approx(np.tile([0.1, 0.2, 0.3, 0.4], (3, 1)))


@pytest.mark.parametrize("delay", [1, 3, 6])
def test_late_packets_by_brute_force(delay: int) -> None:
    """A plain loop per device: what was sensed at k acts at k + delay, nothing acts before."""
    draws = Draws.make(protocol(), 3, seed=5)
    schedules = np.stack([gap_schedule(1, 60, 3), gap_schedule(7.5, 60, 3)])
    act = teacher("desktop")
    outcome = simulate(
        DESKTOP, draws, schedules, LastForce(act, 6, keep=True), true_state, delay_steps=delay
    )
    for point in range(2):
        for device in range(3):
            poles = CartPoles(DESKTOP, 1)
            poles.states = draws.initial[device : device + 1]
            poles.step([0.0])
            sent: dict[int, float] = {}
            force = cost = 0.0
            for k in range(60):
                if schedules[point, k, device]:
                    sent[k] = float(act(poles.states[0]))
                force = sent.get(k - delay, force)
                cost += float(DESKTOP.cost(poles.states[0], np.array(force)))
                poles.step([force])
                poles.states = poles.states + draws.noise[k, device]
            assert outcome.cost[point, device] == pytest.approx(cost / 60, rel=1e-9)


def test_a_late_packet_is_played_late() -> None:
    recorder = Recorder(2)
    play(recorder, np.array([7, 8]), 2, 5, delay_steps=3)
    assert [sorted(packets) for packets in recorder.packets] == [[], [], [], [0, 1], []]


def test_rollouts_and_the_loop_look_back_alike() -> None:
    """What a sensor gets in step k is the same states, stored or simulated."""
    draws = Draws.make(protocol(steps=6), 2, seed=0)
    seen: list[np.ndarray] = []
    rollouts = [draws.initial]
    simulate(
        DESKTOP,
        draws,
        every_step(6, 2)[None],
        LastForce(teacher("desktop"), 2, keep=True),
        lambda states: [seen.append(states), states[:, -1]][1],
        watch=lambda k, states, forces_n: rollouts.append(states),
    )
    stored = np.stack(rollouts, axis=1)
    for k in range(6):
        assert last_states(stored, k) == pytest.approx(seen[k], abs=1e-12)
