"""Simulation finds how many loops one resource block carries under a scheduler.

The load of a block is devices per transmission and slot. A light load is simulated on several
blocks at once, so that every point has about as many devices.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from hjepa_cli.core import statistics
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.evaluation.cell_simulation import CellOutcome
from hjepa_cli.core.radio.laws.scheduled import SupportedLoad

BLOCK_DEVICES = 200  # simulated at a time, about
MAX_LOAD = 512
MAX_BISECTIONS = 8
WIDER = 1.15  # how far outside to look for an end of the interval
MAX_WIDENINGS = 3


@dataclasses.dataclass(frozen=True)
class LoadPoint:
    """Holds one simulated load: devices per block, J blocks, and what came of the N devices.

    ``reference`` is the teacher's score of the same devices [N].
    """

    load: float
    blocks: int
    outcome: CellOutcome
    reference: Floats

    @property
    def score(self) -> float:
        """Return the normalised score."""
        return float(statistics.ratio(self.outcome.score, self.reference))

    @property
    def packets_per_slot(self) -> float:
        """Return the packets delivered per block and slot."""
        return float(self.outcome.packets.sum()) / (self.blocks * self.outcome.counted_slots)

    @property
    def reports_per_slot(self) -> float:
        """Return the innovation reports per block and slot."""
        return self.outcome.reports / (self.blocks * self.outcome.counted_slots)


def blocks_for(load: float) -> int:
    """Return J, so that about :data:`BLOCK_DEVICES` devices are simulated."""
    return max(1, int(BLOCK_DEVICES // load))


def find_load(
    simulate: Callable[[int], LoadPoint],
    acceptable_score: float,
    bracket: float,
    *,
    replicates: int,
    seed: int,
    start: float | None = None,
) -> SupportedLoad:
    """Bisect the load on a logarithmic scale, at most 8 times.

    Where an end of the interval lies beyond the loads of the search, others are simulated there.

    Args:
        simulate: simulates a load in 1 … :data:`MAX_LOAD`.
        acceptable_score, bracket: to stay at, and the relative width at which to stop.
        replicates, seed: of the bootstrap over devices. It takes devices as independent; they share
            blocks, so that several seeds say more.
        start: a load near the one to find, like that of another seed: fewer to simulate.
    """
    points = _bisected(simulate, acceptable_score, bracket, start)
    for remaining in range(MAX_WIDENINGS, -1, -1):
        ascending = [points[load] for load in sorted(points)]
        crossing, least, most = _crossings(ascending, acceptable_score, replicates, seed)
        outside = [min(round(min(points) / WIDER), min(points) - 1)] * math.isinf(least)
        outside += [max(round(max(points) * WIDER), max(points) + 1)] * math.isinf(most)
        outside = [load for load in outside if math.isfinite(crossing) and 1 <= load <= MAX_LOAD]
        if not outside or not remaining:
            break
        points |= {load: simulate(load) for load in outside}
    inside = [point for point in ascending if point.load <= crossing] or ascending[:1]
    ends = {-math.inf: 0.0, math.inf: float(ascending[-1].load)}  # numbers that can be multiplied
    return SupportedLoad(
        load=ends.get(crossing, crossing),
        interval=(ends.get(least, least), ends.get(most, most)),
        at_least=crossing == math.inf,
        packets_per_slot=inside[-1].packets_per_slot,
        reports_per_slot=inside[-1].reports_per_slot,
        points=tuple((point.load, point.score) for point in ascending),
    )


def _bisected(
    simulate: Callable[[int], LoadPoint],
    acceptable_score: float,
    bracket: float,
    start: float | None,
) -> dict[int, LoadPoint]:
    """Simulate loads on both sides of the one to find, nearer and nearer; return them by load."""
    points: dict[int, LoadPoint] = {}
    low, high, step = 1, MAX_LOAD, 1 + 4 * bracket
    for _ in range(MAX_BISECTIONS):
        if not points:
            middle = min(round(start or math.sqrt(high)), high)
        elif start and not (low in points and high in points):
            middle = round(high / step) if high in points else round(low * step)
            middle, step = min(max(middle, 1), MAX_LOAD), step**2
        else:
            middle = round(math.sqrt(low * high))
        if middle in points:
            middle = min({low, high} - points.keys(), default=0)
        if not middle:
            break
        points[middle] = simulate(middle)
        if points[middle].score < acceptable_score:
            high = min(middle, high)
        else:
            low = max(middle, low)
        both = low in points and high in points
        if both and (high - low <= 1 or high / low <= 1 + bracket):
            break
    return points


def combine(found: Sequence[SupportedLoad]) -> SupportedLoad:
    """Average over seeds, with Student's t interval over them."""
    if len(found) == 1:
        return found[0]
    loads = np.array([one.load for one in found])
    low, high = map(float, statistics.student_interval(loads))
    return SupportedLoad(
        load=float(loads.mean()),
        interval=(max(low, 0.0), high),
        at_least=any(one.at_least for one in found),
        packets_per_slot=float(np.mean([one.packets_per_slot for one in found])),
        reports_per_slot=float(np.mean([one.reports_per_slot for one in found])),
        points=tuple(sorted(point for one in found for point in one.points)),
        parts=tuple(found),
    )


def pooled_score(
    points: Sequence[LoadPoint], replicates: int, seed: int
) -> tuple[float, tuple[float, float]]:
    """Return the normalised score of a load over devices of all seeds, and its 95 % interval."""
    score = np.concatenate([point.outcome.score for point in points])
    reference = np.concatenate([point.reference for point in points])
    weights = statistics.bootstrap_weights(len(score), replicates, seed)
    low, high = statistics.interval(statistics.ratio(score, reference, weights))
    return float(statistics.ratio(score, reference)), (float(low), float(high))


def _crossings(
    points: Sequence[LoadPoint], acceptable_score: float, replicates: int, seed: int
) -> tuple[float, float, float]:
    """Interpolate the load between the simulated ones; the 95 % interval over devices.

    −∞ and ∞ where the score is not acceptable at the least load, and acceptable at the largest.
    """
    loads = np.array([point.load for point in points], np.float64)
    scores = np.array([point.score for point in points])
    most = max(len(point.reference) for point in points)
    weights = statistics.bootstrap_weights(most, replicates, seed)
    drawn = [
        statistics.ratio(point.outcome.score, point.reference, weights[:, : len(point.reference)])
        for point in points
    ]
    crossing, crossings = (
        statistics.first_crossing(loads, each, acceptable_score, log=False)
        for each in (scores, np.stack(drawn, axis=-1))
    )
    low, high = statistics.interval(crossings)
    return float(crossing), float(low), float(high)
