"""Survival times: schedules, counts, intervals, splitting, links; and the stage."""

import io
import json
import math

import numpy as np
import pytest
from scipy import stats

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation import survival
from hjepa_cli.core.evaluation.simulator import Simulator
from hjepa_cli.core.evaluation.survival import Gaps, LossCurve, LossyLink, Trial
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, Interrupted, OutOfMemory, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import report, survive
from hjepa_cli.storage import seals

SETTINGS = {
    "protocol.warmup_steps": 300,
    "protocol.steps": 300,
    "protocol.gaps": (1, 200, 400),
    "survival.intervals_steps": (10,),
    "survival.loops": 24,
    "survival.splitting_paths": 0,
    "methods": ("oracle", "hold-true"),
    "control.gains_n": [],
}


def test_a_trial_has_one_gap():
    trial = Trial(10, 50, 30)
    times = np.flatnonzero(trial.schedule(25, trial.steps(25), 3)[:, 2])
    assert times.tolist() == [0, 10, 20, 30, 40, 50, 75, 85, 95]


@pytest.mark.parametrize(("k", "n"), [(0, 20), (1, 50), (7, 50), (50, 50)])
def test_intervals_are_scipys_exact_ones(k, n):
    low, high = survival.clopper_pearson(k, n)
    exact = stats.binomtest(k, n).proportion_ci(method="exact")
    assert (float(low), float(high)) == pytest.approx((exact.low, exact.high), abs=1e-9)


def test_what_gaps_are_tolerated_by_hand():
    curve = LossCurve(np.array([10, 20, 30, 40]), np.array([0, 3, 1, 60]), np.full(4, 100))
    assert curve.probability.tolist() == [0.0, 0.02, 0.02, 0.6]  # 3 and 1 of 100 are pooled
    # 0 of 100: at most 3.6 %; 3 of 100: 0.6 to 8.5 %; 60 of 100: at least 49.7 %.
    assert curve.tolerated(0.1) == (30, (30, 40), False)
    assert curve.tolerated(0.01) == (10, (0, 40), False)
    assert curve.wanted((0.1, 0.01), 1.06) == [14, 35]
    assert LossCurve(np.array([10]), np.array([0]), np.array([9])).tolerated(0.5) == (
        10, (10, None), True,
    )  # fmt: skip


def test_splitting_finds_a_probability_that_is_known():
    """That a normal walk of 30 steps comes to 24, by 4 million direct walks: 5.6e-6 at most off.

    The mean of 20 estimates with 256 paths: 4 standard errors of theirs.
    """
    random, steps, height = np.random.default_rng(0), 30, 17.0

    def run(normal, rows):
        return np.cumsum(normal, axis=0).max(axis=0) / height

    direct = np.mean([
        np.mean(run(random.standard_normal((steps, 100_000)), None) >= 1) for _ in range(10)
    ])  # fmt: skip
    found = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        found.append(survival.splitting(run, random.standard_normal((steps, 256)), random))
    p, spread = np.array(found).T
    assert 5e-4 < direct < 5e-3
    assert p.mean() == pytest.approx(direct, abs=4 * p.std() / math.sqrt(20) + 2e-4)
    assert np.log(p).std() < spread.mean() < 3 * np.log(p).std()


def test_splitting_says_none_where_paths_come_no_further():
    random = np.random.default_rng(0)
    never = survival.splitting(
        lambda normal, rows: np.full(normal.shape[1], 0.5), random.standard_normal((3, 16)), random
    )
    assert never == (0.0, math.inf)


def test_a_link_that_loses_control_against_simulated_transfers():
    """Runs of losses of a two-state link, 4 million transfers; gaps of 30 steps and more lose."""
    random, interval = np.random.default_rng(5), 10
    for link in (LossyLink.independent(0.2), LossyLink(0.2, 4.0)):
        stay, enter = 1 - 1 / link.burst, link.loss / ((1 - link.loss) * link.burst)
        lost, lengths = False, []
        drawn = random.random(400_000)
        for value in drawn:
            lost = value < (stay if lost else enter)
            if lost and lengths and lengths[-1] >= 0:
                lengths[-1] += 1
            elif lost:
                lengths.append(1)
            elif lengths and lengths[-1] >= 0:
                lengths.append(-1)
        runs = np.array([length for length in lengths if length > 0])
        measured = np.mean(runs >= 2) * len(runs) / len(drawn)
        curve = LossCurve(np.array([10, 29, 30, 10**7]), np.array([0, 0, 9, 9]), np.full(4, 9))
        lose = survival.loss_of_gap(curve, [])
        found = survival.losses_per_transfer(link, interval, lose)
        assert found == pytest.approx(measured, rel=0.05), link
        down = np.maximum(runs * interval - 15.0, 0).sum() / (len(drawn) * interval)
        assert survival.availability(link, interval, 15.0) == pytest.approx(1 - down, rel=0.01)


def test_the_tolerated_loss_is_where_control_lasts_as_long():
    curve = LossCurve(np.array([10, 20, 30, 40]), np.array([0, 1, 10, 90]), np.full(4, 100))
    lose = survival.loss_of_gap(curve, [])
    for burst in (None, 3.0):
        loss = survival.tolerated_loss(10, lose, 1e-7, burst)
        link = LossyLink.independent(loss) if burst is None else LossyLink(loss, burst)
        assert survival.losses_per_transfer(link, 10, lose) == pytest.approx(1e-7, rel=1e-3)


def test_losses_between_and_beyond_what_was_counted():
    lose = survival.loss_of_gap(
        LossCurve(np.array([10, 30, 40]), np.array([0, 1, 10]), np.full(3, 100)), [(20, 1e-4)]
    )
    assert lose(np.array([20.0, 30.0, 40.0, 41.0])) == pytest.approx([1e-4, 1e-2, 0.1, 1.0])
    assert lose(np.array([25.0, 10.0])) == pytest.approx([1e-3, 1e-6])


def test_what_is_lost_does_not_come_back():
    """The region from which loops recover: the teacher itself, without noise, saves none beyond.

    It starts from where loops of hold-true are first lost in a gap of 400 ms.
    """
    kind, settings = plant("desktop"), load_settings(flags=SETTINGS)
    simulator, lost = Simulator(settings, None), []
    trial = Trial.of(settings.protocol, 10)

    class Keep(survival.Watch):
        def __call__(self, k, states, forces_n):
            before = self.lost.copy()
            super().__call__(k, states, forces_n)
            lost.extend(states[(self.lost & ~before).ravel()])

    steps = trial.steps(400)
    draws = survival._draws(simulator, steps, 48)
    watch = Keep(kind, trial, (400,), 48)
    schedule = trial.schedule(400, steps, 48)[None]
    survival._drive(simulator, "hold-true", draws, schedule, watch, lambda n: None)
    assert len(lost) > 20
    simulation, teacher = kind.simulation(len(lost)), kind.teacher()
    simulation.states = np.array(lost)
    for _ in range(3000):
        simulation.step(teacher(simulation.states))
        simulation.states = np.clip(simulation.states, -50, 50)
    assert kind.in_band(simulation.states).mean() < 0.1


def test_loops_of_a_block_are_those_of_the_whole():
    simulator = Simulator(load_settings(flags=SETTINGS), None)
    trial = Trial(10, 60, 60)
    whole = Gaps("hold-true", trial, (10, 90), 0, 6).compute(simulator, lambda n: None)
    part = Gaps("hold-true", trial, (90,), 4, 6).compute(simulator, lambda n: None)
    assert np.array_equal(whole.lost[1:, 4:], part.lost)
    assert np.array_equal(whole.back_steps[1:, 4:], part.back_steps)


@pytest.mark.parametrize("unit", ["counted", "by splitting"])
def test_silences_over_a_link_that_is_late_and_loses_forces(unit):
    """Packets of 40 ms ago, and one force in a hundred, each lose more than half of the loops."""
    trial, found = Trial(10, 100, 100), []
    for link in ({}, {"protocol.delay_steps": 40}, {"protocol.downlink_loss": 0.99}):
        simulator = Simulator(load_settings(flags=SETTINGS | link), None)
        gaps = Gaps("hold-true", trial, (180,), 0, 48)
        if unit == "counted":
            found.append(gaps.compute(simulator, lambda n: None).lost.mean())
        else:
            rare = survival.Rare("hold-true", trial, 180, 48)
            found.append(rare.compute(simulator, lambda n: None)[0])
    assert found[0] < 0.2 and found[1] > 0.5 and found[2] > 0.5, found


def test_the_stage_ranks_prediction_over_holding(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    settings = load_settings(flags=SETTINGS)
    result = survive.run(settings, Screen(quiet=True))
    rows = {(row["method"], row["loss_probability"]): row for row in result["rows"]}
    assert rows["oracle", 0.1]["survival_steps"] > rows["hold-true", 0.1]["survival_steps"] > 50
    for row in result["rows"]:
        low, high = row["survival_ci95"]
        assert low <= row["survival_steps"] and (high is None or row["survival_steps"] <= high)
        assert row["transfer_interval_s"] == 0.01 and row["devices"] == 645
    assert {row["how"] for row in result["rows"]} == {"counted", "bound"}
    json.dumps(result, default=str)
    again = survive.run(settings, Screen(quiet=True), out=tmp_path / "runs" / "survive" / "0001")
    assert again["rows"] == json.loads(json.dumps(result["rows"]))
    assert "drive 24 loops" in survive.plan(settings).work[0]
    report.run(Screen(quiet=True), [tmp_path / "runs"], out=tmp_path / "report.html")
    survive.show(result, Screen(stdout=(printed := io.StringIO())))
    for shown in (printed.getvalue(), (tmp_path / "report.html").read_text()):
        assert "devices at 20 dB in 20 MHz, shannon" in " ".join(shown.split())
    for edit in ({"step_s": 0}, {"rows": []}, {"curves": None}, {"n_loops": "many"}):
        path = tmp_path / "runs" / "survive" / "0001" / "result.json"
        whole = path.read_text()
        path.write_text(json.dumps(seals.sealed(json.loads(whole) | edit)))
        with pytest.raises(DataError, match=r"result\.json lacks what a survive run has"):
            report.run(Screen(quiet=True), [tmp_path / "runs"], out=tmp_path / "report.html")
        with pytest.raises(DataError, match=r"result\.json lacks what a survive run has"):
            survive.run(settings, Screen(quiet=True), out=path.parent)
        path.write_text(whole)


def test_an_interruption_loses_no_curve_that_was_measured(tmp_path, monkeypatch):
    """The rest is measured, with the same result; a curve that was changed meanwhile is refused."""
    monkeypatch.chdir(tmp_path)
    settings = load_settings(flags=SETTINGS | {"survival.loops": 8})
    whole = survive.run(settings, Screen(quiet=True), out=tmp_path / "whole")
    measure, asked = survive.Survivals.measure, []

    def stopped_at_the_second(self, method, interval):
        asked.append(method)
        if len(asked) == 2:
            raise KeyboardInterrupt
        return measure(self, method, interval)

    monkeypatch.setattr(survive.Survivals, "measure", stopped_at_the_second)
    with pytest.raises(Interrupted):
        survive.run(settings, Screen(quiet=True), out=tmp_path / "cut")
    again = survive.run(settings, Screen(quiet=True), out=tmp_path / "cut")
    assert asked == ["oracle", "hold-true", "hold-true"]
    assert [again[key] for key in ("rows", "curves")] == [whole[key] for key in ("rows", "curves")]

    (tmp_path / "cut" / "result.json").unlink()
    kept = tmp_path / "cut" / survive.FILE
    kept.write_text(kept.read_text().replace('"lost": 0', '"lost": 1', 1))
    with pytest.raises(DataError, match=r"survival\.json was changed after it was written"):
        survive.run(settings, Screen(quiet=True), out=tmp_path / "cut")


@pytest.mark.parametrize(
    ("flags", "match"),
    [
        ({"survival.intervals_steps": (400,)}, "--intervals 400: .* 300 steps after a silence"),
        ({"survival.intervals_steps": ()}, "no interval given"),
        ({"radio.phy": "nr", "radio.bandwidth_hz": 21e6}, "TS 38.101-1 lists"),
    ],
)
def test_what_cannot_be_silenced(flags, match):
    with pytest.raises(UsageError, match=match):
        survive.opened(load_settings(flags=SETTINGS | flags), Screen(quiet=True), None, None)


def test_loops_that_no_memory_holds_are_refused_before_any_is_drawn():
    flags = SETTINGS | {"survival.loops": 10**8}
    with pytest.raises(OutOfMemory, match="a loop of 100000000 devices over"):
        survive.opened(load_settings(flags=flags), Screen(quiet=True), None, None)


@pytest.mark.parametrize(("loops", "paths"), [(24, 0), (8, 96)])
def test_memory_is_that_of_the_longest_loops(loops, paths, monkeypatch):
    """Loops that no gap loses are driven on: 5, 8, 12 and 18 steps, beyond 5 · 1.5³."""
    asked = []

    def check(protocol, devices):
        asked.append((protocol.total_steps, devices))
        raise OutOfMemory("no")

    monkeypatch.setattr(survive, "check_memory", check)
    flags = {"protocol.gaps": (1, 5), "survival.intervals_steps": (3, 4), "survival.loops": loops}
    settings = load_settings(flags=SETTINGS | flags | {"survival.splitting_paths": paths})
    with pytest.raises(OutOfMemory):
        survive.opened(settings, Screen(quiet=True), None, None)
    assert asked == [(150 + 18 + 300, max(loops, paths))]
