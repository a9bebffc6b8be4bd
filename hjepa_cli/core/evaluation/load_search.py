"""How many loops one resource block carries under a scheduler, found by simulating it.

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

BLOCK_DEVICES = 200  # simulated at a time, about
MAX_LOAD = 512
MAX_BISECTIONS = 8
WIDER = 1.15  # how far outside to look for an end of the interval
MAX_WIDENINGS = 3


@dataclasses.dataclass(frozen=True)
class LoadPoint:
    """One simulated load.

    Attributes:
        load: devices per block; whole where a search asks for it.
        blocks: J.
        outcome: of ``load · blocks`` devices.
        reference: the teacher's score of the same devices [N].
    """

    load: float
    blocks: int
    outcome: CellOutcome
    reference: Floats

    @property
    def score(self) -> float:
        """Normalised score."""
        return float(statistics.ratio(self.outcome.score, self.reference))

    @property
    def packets_per_slot(self) -> float:
        """Delivered per block and slot."""
        return float(self.outcome.packets.sum()) / (self.blocks * self.outcome.counted_slots)

    @property
    def reports_per_slot(self) -> float:
        """Innovation reports per block and slot."""
        return self.outcome.reports / (self.blocks * self.outcome.counted_slots)


@dataclasses.dataclass(frozen=True)
class SupportedLoad:
    """The load at which the score falls to the acceptable one.

    Attributes:
        load: devices per block, interpolated between the simulated ones; 0 where not even a block
            per device suffices.
        interval: 95 %, over devices of one seed or over seeds.
        at_least: still acceptable at the largest load tried.
        packets_per_slot, reports_per_slot: per block, at the nearest load inside.
        points: (load, score) as simulated, ascending.
        parts: of each seed, where this is an average over seeds.
    """

    load: float
    interval: tuple[float, float]
    at_least: bool
    packets_per_slot: float
    reports_per_slot: float
    points: tuple[tuple[float, float], ...]
    parts: tuple["SupportedLoad", ...] = ()


def blocks_for(load: float) -> int:
    """J, so that about :data:`BLOCK_DEVICES` devices are simulated."""
    return max(1, int(BLOCK_DEVICES // load))


def find_load(
    simulate: Callable[[int], LoadPoint],
    level: float,
    bracket: float,
    *,
    replicates: int,
    seed: int,
    start: float | None = None,
) -> SupportedLoad:
    """Bisect the load on a logarithmic scale, at most 8 times.

    Where an end of the interval lies beyond the loads of the search, others are simulated there.

    Args:
        simulate: a load in 1 … :data:`MAX_LOAD`.
        level: the acceptable score.
        bracket: relative width at which to stop.
        replicates, seed: of the bootstrap over devices. It takes devices as independent; they share
            blocks, so that several seeds say more.
        start: a load near the one to find, like that of another seed: fewer to simulate.
    """
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
        if points[middle].score < level:
            high = min(middle, high)
        else:
            low = max(middle, low)
        both = low in points and high in points
        if both and (high - low <= 1 or high / low <= 1 + bracket):
            break

    def crossings() -> tuple[float, float, float]:
        return _crossings([points[load] for load in sorted(points)], level, replicates, seed)

    for _ in range(MAX_WIDENINGS):
        crossing, least, most = crossings()
        outside = [round(min(points) / WIDER)] * math.isinf(least)
        outside += [round(max(points) * WIDER)] * math.isinf(most)
        outside = [load for load in outside if math.isfinite(crossing) and 1 <= load <= MAX_LOAD]
        points |= {load: simulate(load) for load in outside}
    return _supported([points[load] for load in sorted(points)], *crossings())


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
        points=tuple(point for one in found for point in one.points),
        parts=tuple(found),
    )


def pooled_score(
    points: Sequence[LoadPoint], replicates: int, seed: int
) -> tuple[float, tuple[float, float]]:
    """Normalised score of one load over the devices of all seeds, with its 95 % interval."""
    score = np.concatenate([point.outcome.score for point in points])
    reference = np.concatenate([point.reference for point in points])
    weights = statistics.bootstrap_weights(len(score), replicates, seed)
    low, high = statistics.interval(statistics.ratio(score, reference, weights))
    return float(statistics.ratio(score, reference)), (float(low), float(high))


def _crossings(
    points: Sequence[LoadPoint], level: float, replicates: int, seed: int
) -> tuple[float, float, float]:
    """Interpolate the load between the simulated ones; the 95 % interval over devices.

    −∞ and ∞ where the score is below the level at the least load, above it at the largest.
    """
    loads = np.array([point.load for point in points], np.float64)
    scores = np.array([point.score for point in points])
    most = max(len(point.reference) for point in points)
    weights = statistics.bootstrap_weights(most, replicates, seed)
    drawn = np.stack(
        [
            statistics.ratio(
                point.outcome.score, point.reference, weights[:, : len(point.reference)]
            )
            for point in points
        ],
        axis=-1,
    )
    crossing = statistics.first_crossing(loads, scores, level, log=False)
    low, high = statistics.interval(statistics.first_crossing(loads, drawn, level, log=False))
    return float(crossing), float(low), float(high)


def _supported(
    points: Sequence[LoadPoint], crossing: float, low: float, high: float
) -> SupportedLoad:
    """What was found between the simulated loads, in numbers that can be multiplied."""
    inside = [point for point in points if point.load <= crossing] or points[:1]
    ends = {-math.inf: 0.0, math.inf: float(points[-1].load)}
    return SupportedLoad(
        load=ends.get(crossing, crossing),
        interval=(ends.get(low, low), ends.get(high, high)),
        at_least=crossing == math.inf,
        packets_per_slot=inside[-1].packets_per_slot,
        reports_per_slot=inside[-1].reports_per_slot,
        points=tuple((point.load, point.score) for point in points),
    )
