"""The search for tolerances on synthetic curves whose crossing is known."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.loop import Draws, Outcome, delivery_schedule, gap_schedule
from hjepa_cli.core.evaluation.protocol import KINDS, Curves, Point, Reference, measure_curves

PROTOCOL = dataclasses.replace(load_settings(flags={"protocol": "paper"}).protocol, bootstrap=300)
GRID = PROTOCOL.gaps
Curve = Callable[[float], float]


class Fake:
    """Devices whose scores are a known function of the mean gap, plus a device's own offset."""

    def __init__(self, curve: Curve, spread: float = 0.0, few_bias: float = 0.0) -> None:
        self.curve, self.few_bias = curve, few_bias
        self.offsets = spread * np.random.default_rng(0).standard_normal(PROTOCOL.bracket_devices)
        self.offsets -= self.offsets.mean()
        self.asked: list[tuple[Point, int]] = []

    def measure(self, points: Sequence[Point], devices: int) -> Outcome:
        self.asked += [(point, devices) for point in points]
        bias = self.few_bias if devices == PROTOCOL.curve_devices else 0.0
        scores = np.array(
            [self.curve(point.gap) + bias + self.offsets[:devices] for point in points]
        )
        return Outcome(scores, 1 / np.maximum(scores, 1e-3), np.zeros_like(scores))

    def curves(self, protocol: ProtocolSettings = PROTOCOL) -> Curves:
        ones = np.ones(PROTOCOL.bracket_devices)
        reference = Reference(ones, ones, protocol.bootstrap, seed=0)
        first = self._first().part(slice(None), slice(protocol.curve_devices))
        return measure_curves(self.measure, lambda: first, reference, protocol)

    def _first(self) -> Outcome:
        scores = (self.curve(1.0) + self.offsets)[None]
        return Outcome(scores, 1 / np.maximum(scores, 1e-3), np.zeros_like(scores))

    def gaps_with_many(self, kind: str) -> list[float]:
        many = PROTOCOL.bracket_devices
        return [
            point.gap for point, devices in self.asked if devices == many and point.kind == kind
        ]


def falling(tolerance: float, slope: float = 0.5) -> Curve:
    """0.62 exactly at ``tolerance``, linear in ln gap."""
    return lambda gap: 0.62 - slope * math.log(gap / tolerance)


@pytest.mark.parametrize("tolerance", [1.3, 4.9, 5.0, 39.0, 41.0, 93.7, 200.0, 280.0])
def test_both_tolerances_of_a_known_curve(tolerance: float) -> None:
    curves = Fake(falling(tolerance), spread=0.3).curves()
    for kind in KINDS:
        found = curves.searches[kind].result()
        assert found.gap == pytest.approx(tolerance, rel=1e-3)
        assert not found.censored
        assert found.interval[0] < found.gap < found.interval[1]
        # Offsets of 0.3 move the mean of 256 by 0.01875, the crossing by 0.01875 / slope in ln gap.
        half = 1.96 * 0.3 / math.sqrt(256) / 0.5
        assert math.log(found.interval[1] / found.interval[0]) == pytest.approx(2 * half, rel=0.15)


def test_the_delivery_curve_is_exact_where_scores_are_linear_in_ln_p() -> None:
    found = Fake(falling(93.7)).curves().searches["delivery"].result()
    assert found.gap == pytest.approx(93.7, rel=1e-12)


@pytest.mark.parametrize("tolerance", [1.3, 93.7, 201.0])
def test_the_final_bracket_is_narrow_and_measured_with_many(tolerance: float) -> None:
    fake = Fake(falling(tolerance))
    fake.curves()
    for kind in KINDS:
        gaps = sorted(fake.gaps_with_many(kind))
        left = max(gap for gap in gaps if gap <= tolerance * (1 + 1e-9))
        right = min(gap for gap in gaps if gap >= tolerance * (1 - 1e-9))
        assert right / left - 1 <= {"gap": 0.03, "delivery": 0.06}[kind]
        assert len(gaps) <= 9


def test_the_grid_is_measured_with_few_and_its_first_point_is_shared() -> None:
    fake = Fake(falling(50))
    curves = fake.curves()
    few = [point for point, devices in fake.asked if devices == PROTOCOL.curve_devices]
    assert few == [Point(kind, gap) for kind in KINDS for gap in GRID[1:]]
    for kind in KINDS:
        points, outcome = curves.grid[kind]
        assert points == [Point(kind, gap) for gap in GRID]
        expected = [[falling(50)(gap)] * PROTOCOL.curve_devices for gap in GRID]
        assert outcome.score == pytest.approx(np.array(expected))


def test_a_misleading_grid_is_corrected_by_many_devices() -> None:
    """Few devices put the crossing near 33, many at 90: two grid brackets away."""
    fake = Fake(falling(90.0), few_bias=-0.5)
    for kind in KINDS:
        found = fake.curves().searches[kind].result()
        assert found.gap == pytest.approx(90.0, rel=1e-3)


def test_first_crossing_counts_when_a_curve_recovers() -> None:
    def curve(gap: float) -> float:
        return 0.3 if 50 < gap < 100 else 0.9

    for kind in KINDS:
        found = Fake(curve).curves().searches[kind].result()
        assert 40 < found.gap <= 52


def test_still_acceptable_at_the_end_is_censored() -> None:
    fake = Fake(lambda gap: 0.9)
    for kind in KINDS:
        found = fake.curves().searches[kind].result()
        assert (found.gap, found.interval, found.censored) == (320.0, (320.0, 320.0), True)


def test_acceptable_at_the_end_for_few_is_checked_with_many() -> None:
    found = Fake(falling(200.0), few_bias=0.5).curves().searches["gap"].result()
    assert found.gap == pytest.approx(200.0, rel=1e-3)
    assert not found.censored


def test_a_censored_tolerance_may_have_an_interval_that_is_not() -> None:
    found = Fake(falling(330.0), spread=0.6).curves().searches["gap"].result()
    assert found.censored
    assert 250 < found.interval[0] < 320
    assert found.interval[1] == 320.0


def test_unacceptable_with_every_packet_is_zero() -> None:
    for kind in KINDS:
        found = Fake(lambda gap: 0.5).curves().searches[kind].result()
        assert (found.gap, found.interval, found.censored) == (0.0, (0.0, 0.0), False)


def test_rounds_of_both_searches_are_measured_together() -> None:
    batches = []

    class Counting(Fake):
        def measure(self, points: Sequence[Point], devices: int) -> Outcome:
            batches.append(len(points))
            return super().measure(points, devices)

    Counting(falling(93.7)).curves()
    assert batches[0] == 2 * (len(GRID) - 1)
    # A fan of three for each kind, then both ends of a narrow bracket around the better guess;
    # that of random gaps may be wider, so that one point more is enough.
    assert batches[1:] == [6, 3]


def test_random_gaps_are_searched_where_periodic_ones_say() -> None:
    """The grid has nothing between 1 and 20, where random gaps of 9.4 are the limit.

    They are looked for once the periodic ones are found, at the first guess.
    """
    asked: list[float] = []

    class Cliff(Fake):
        def measure(self, points: Sequence[Point], devices: int) -> Outcome:
            asked.extend(point.gap for point in points if point.kind == "delivery")
            limits = {"gap": 25.3, "delivery": 9.4}
            scores = [[1 / (1 + (p.gap / limits[p.kind]) ** 9)] for p in points]
            return Outcome(*(np.repeat(scores, devices, axis=1) for _ in range(3)))

    protocol = dataclasses.replace(PROTOCOL, curve_devices=256, bracket_devices=256)
    searches = Cliff(lambda gap: 1.0).curves(protocol).searches
    for kind, limit in {"gap": 25.3, "delivery": 9.4}.items():
        assert searches[kind].result().gap == pytest.approx(
            limit * (1 / 0.62 - 1) ** (1 / 9), rel=0.03
        )
    searched = [gap for gap in asked if gap not in GRID]
    assert all(7 < gap < 14 for gap in searched)  # a packet less often than every third step
    assert len(searched) <= 2


def test_the_interval_s_end_is_looked_for_where_no_point_is_near() -> None:
    """Devices differ, so that the interval of random gaps ends between 1 and what was searched."""

    class Cliff(Fake):
        def measure(self, points: Sequence[Point], devices: int) -> Outcome:
            limits = {"gap": 25.3, "delivery": 9.4}
            at = np.array([[point.gap / limits[point.kind]] for point in points])
            scores = 1 / (1 + (at * np.exp(self.offsets[:devices])) ** 9)
            return Outcome(scores, scores, scores)

    protocol = dataclasses.replace(PROTOCOL, curve_devices=64, bracket_devices=64)
    fake = Cliff(lambda gap: 1.0, spread=0.4)
    search = fake.curves(protocol).searches["delivery"]
    low = search.result().interval[0]
    gaps = [point.gap for point in search.points]
    near = max(gap for gap in gaps if gap <= low), min(gap for gap in gaps if gap > low)
    assert 4 < near[0] and near[1] / near[0] < 1.5
    # Where curves are measured as finely as one likes, their replicates cross there, too.
    fine = np.geomspace(3, 20, 400)
    scores = fake.measure([Point("delivery", gap) for gap in fine], 64).score
    weights = np.random.default_rng(1).multinomial(64, np.full(64, 1 / 64), 2000) / 64
    crossings = [fine[np.argmax(curve < 0.62)] for curve in weights @ scores.T]
    assert low == pytest.approx(np.quantile(crossings, 0.025), rel=0.04)


def test_a_wide_interval_takes_few_rounds() -> None:
    """Sixteen devices that tell nothing: the interval is the whole grid."""
    protocol = dataclasses.replace(PROTOCOL, curve_devices=16, bracket_devices=16)
    fake = Fake(falling(300.0, slope=0.02), spread=2.0)
    fake.offsets = fake.offsets[:16] - fake.offsets[:16].mean()
    batches = []
    measure = fake.measure

    def counting(points: Sequence[Point], devices: int) -> Outcome:
        batches.append(len(points))
        return measure(points, devices)

    ones = np.ones(16)
    reference = Reference(ones, ones, protocol.bootstrap, seed=0)
    first = fake._first().part(slice(None), slice(16))
    curves = measure_curves(counting, lambda: first, reference, protocol)
    found = curves.searches["gap"].result()
    assert found.interval[0] < 2 and found.interval[1] == 320.0
    assert len(batches) <= 12


def test_a_grid_of_one_point_works() -> None:
    protocol = dataclasses.replace(PROTOCOL, gaps=(1,))
    found = Fake(lambda gap: 0.9).curves(protocol).searches["gap"].result()
    assert (found.gap, found.censored) == (1.0, True)


def test_points_know_their_schedule_and_their_name() -> None:
    options: Any = dataclasses.replace(
        load_settings(flags={"protocol": "paper"}).protocol, steps=50
    )
    draws = Draws.make(options, 4, seed=0)
    gap, delivery = Point("gap", 2.5), Point("delivery", 2.5)
    assert np.array_equal(gap.schedule(draws), gap_schedule(2.5, 50, 4))
    assert np.array_equal(delivery.schedule(draws), delivery_schedule(0.4, draws.delivery))
    assert gap.coordinate() == {"d": 2.5}
    assert delivery.coordinate() == {"p": 0.4}


def test_curve_entries_carry_score_interval_and_cost_ratio() -> None:
    random = np.random.default_rng(0)
    teacher, method = random.uniform(0.8, 1, 64), random.uniform(0.4, 0.8, (2, 64))
    reference = Reference(teacher, np.full(64, 2.0), 500, seed=0)
    points = [Point("gap", 1.0), Point("gap", 2.0)]
    lost = np.zeros((2, 64))
    lost[1, :16] = 1.0
    entries = reference.describe(points, Outcome(method, np.full((2, 64), 5.0), lost))
    assert [entry["lost"] for entry in entries] == [0.0, 0.25]
    for entry, scores, gap in zip(entries, method, (1.0, 2.0), strict=True):
        assert entry["d"] == gap
        assert entry["score"] == pytest.approx(scores.mean() / teacher.mean())
        assert entry["ci95"][0] < entry["score"] < entry["ci95"][1]
        assert entry["in_band"] == pytest.approx(scores.mean())
        assert entry["lq_ratio"] == pytest.approx(0.4)
        assert entry["n_devices"] == 64


def test_at_a_cliff_the_interval_is_as_wide_as_the_search_looks_closely() -> None:
    """All devices fall at once: resampling them says nothing of where, the bracket does."""
    curves = Fake(lambda gap: 0.9 if gap < 93.7 else 0.1).curves()
    for kind in KINDS:
        found = curves.searches[kind].result()
        low, high = found.interval
        assert low <= 93.7 <= high and low <= found.gap <= high
        # Scores of random gaps differ by chance as much as 3 % of p changes them.
        assert 1.0 < high / low <= 1 + {"gap": 0.03, "delivery": 0.06}[kind]
