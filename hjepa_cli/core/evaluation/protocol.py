"""The protocol measures curves over the gap and over the delivery probability, and tolerances.

A curve is measured on a grid with few devices; where it crosses the acceptable score it is
measured again with more, until the crossing is bracketed to a few per cent (3 for D*, 6 for p*).

Both curves live on one axis, the mean gap g between packets in steps: D = g for the gap curve,
p = 1/g for the delivery curve, whose crossing is interpolated in ln p instead of in D.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core import statistics
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.loop import Draws, Outcome, delivery_schedule, gap_schedule

BESIDE = ("in_band", "lq_ratio", "lost")  # what a point of a curve has beside its score
KINDS = ("gap", "delivery")
STEP_OUT = 4  # brackets that a search goes outwards at a time, until the interval is inside
MAX_GUESSES = 4  # rounds of a search that go by guessing, before it bisects
WIDE = 4.0  # the ends of a bracket so far apart tell little of what lies between them
CLIFF = 0.05  # that scores fall by over a bracket's width, several times what chance makes
CHANCE = 2.0  # brackets of random gaps are wider by: scores there differ by chance, too
SPREAD = 2.7  # D* ÷ the mean gap at p*, about: of random gaps the longest decide


@dataclasses.dataclass(frozen=True)
class Point:
    """Is one point of a curve: a link with mean gap ``gap`` between packets, in steps.

    Attributes:
        kind: ``"gap"``: every D = ``gap`` steps; ``"delivery"``: with p = 1/``gap`` at each.
    """

    kind: str
    gap: float

    def schedule(self, draws: Draws) -> NDArray[np.bool_]:
        """Return when packets arrive: bool [steps, N]."""
        if self.kind == "gap":
            return gap_schedule(self.gap, draws.steps, draws.devices)
        return delivery_schedule(1 / self.gap, draws.delivery)

    def coordinate(self) -> dict[str, float]:
        """Return ``{"d": D}`` or ``{"p": p}``, as curves are printed."""
        return {"d": self.gap} if self.kind == "gap" else {"p": 1 / self.gap}


@dataclasses.dataclass(frozen=True, eq=False)
class Reference:
    """Holds the teacher, acting on the true state at every step, on the same draws.

    Attributes:
        score, cost: [N], all bracket devices.
        seed: of the bootstrap.
    """

    score: Floats
    cost: Floats
    replicates: int
    seed: int

    def relative_score(self, outcome: Outcome) -> Floats:
        """Return the normalised score of each point [P]."""
        return statistics.ratio(outcome.score, self.score[: outcome.score.shape[1]])

    def score_replicates(self, outcome: Outcome) -> Floats:
        """Return bootstrap replicates of the normalised score [B, P]."""
        devices = outcome.score.shape[1]
        weights = statistics.bootstrap_weights(devices, self.replicates, self.seed)
        return statistics.ratio(outcome.score, self.score[:devices], weights)

    def describe(self, points: Sequence[Point], outcome: Outcome) -> list[dict[str, Any]]:
        """Return curve entries as printed.

        Each has its coordinate, the normalised score and its interval, the share of steps in the
        band as it is, the LQ ratio, the share of loops that were lost, the number of devices, and
        the share of packets that were flagged, if somebody looked.
        """
        scores = self.relative_score(outcome)
        low, high = statistics.interval(self.score_replicates(outcome))
        devices = outcome.score.shape[1]
        flagged = np.full(len(points), np.nan)
        if outcome.flagged is not None:
            flagged = outcome.flagged.mean(axis=1)
        lq_ratios = self.cost[:devices].mean() / outcome.cost.mean(axis=1)
        return [
            {
                **point.coordinate(),
                "score": float(scores[i]),
                "ci95": [float(low[i]), float(high[i])],
                "in_band": float(outcome.score[i].mean()),
                "lq_ratio": float(lq_ratios[i]),
                "lost": float(outcome.lost[i].mean()),
                "n_devices": devices,
                **({} if np.isnan(flagged[i]) else {"flagged": float(flagged[i])}),
            }
            for i, point in enumerate(points)
        ]


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Tells how sparse packets may get before the score falls below the acceptable one.

    That is a mean gap in steps; 0 where not even a packet at every step suffices, the end of the
    grid where the score is still acceptable there (``censored``). Its 95 % interval lies within.
    """

    gap: float
    interval: tuple[float, float]
    censored: bool


class Search:
    """Finds the crossing of one curve: asks for points, takes their outcomes, until content.

    The grid's values from few devices guide the search. Whatever decides the result is measured
    with many: both ends of the final bracket, and points outside the interval. Where few devices
    are many already, the grid has these, and the interval's ends lie on lines between its points.

    Args:
        grid: points of one kind, by ascending gap.
        few: their outcomes with few devices.
        reference: the teacher with many devices.
        protocol: acceptable score, bracket width and devices.
        periodic: of a search over random gaps the one over periodic gaps, which says where to look.
    """

    def __init__(
        self,
        grid: Sequence[Point],
        few: Outcome,
        reference: Reference,
        protocol: ProtocolSettings,
        periodic: "Search | None" = None,
    ) -> None:
        self.kind, self._log = grid[0].kind, grid[0].kind == "delivery"
        scores = reference.relative_score(few).tolist()
        self._grid = dict(zip((point.gap for point in grid), scores, strict=True))
        self._measured: dict[float, Outcome] = {}
        self._reference, self._periodic = reference, periodic
        self._acceptable = protocol.acceptable_score
        self._bracket = protocol.bracket * (CHANCE if self._log else 1)
        self._step_out = 1 + STEP_OUT * protocol.bracket
        self._rounds, self._asked = 0, list[float]()
        self._steps_down = self._steps_up = 1
        if protocol.curve_devices == protocol.bracket_devices:  # few devices are many already
            for row, point in enumerate(grid):
                self.add(point, few.part(slice(row, row + 1)))

    @property
    def points(self) -> list[Point]:
        """Return the points measured so far, ascending."""
        return [Point(self.kind, gap) for gap in sorted(self._measured)]

    @property
    def outcome(self) -> Outcome:
        """Return their outcomes [P, N]."""
        return Outcome.joined([self._measured[gap] for gap in sorted(self._measured)], axis=0)

    def add(self, point: Point, outcome: Outcome) -> None:
        """Take the outcome of a point with many devices [1, N]."""
        self._measured[point.gap] = outcome

    def guess(self) -> float | None:
        """Return about where the crossing is; ``None`` if the grid does not have it."""
        left, right = _bracket(scores := self._scores(), self._acceptable)
        return left and right and self._guess(left, right, scores)

    def wanted(self) -> list[Point]:
        """Return the next points to measure with many devices; none when the search is over."""
        if self._waits():
            return []
        self._rounds += 1
        self._asked = [gap for gap in self._next() if gap not in self._measured]
        return [Point(self.kind, gap) for gap in self._asked]

    def _waits(self) -> bool:
        """Return whether periodic gaps say where to look, and are being searched themselves."""
        left, right = _bracket(self._scores(), self._acceptable)
        wide = left is not None and right is not None and right / left > WIDE
        return wide and self._periodic is not None and self._periodic.is_bracketing

    @property
    def is_bracketing(self) -> bool:
        """Return whether it has asked for points to find the crossing, not its interval."""
        left, right = _bracket(self._scores(), self._acceptable)
        found = left is None or right is None or right / left - 1 <= self._bracket
        return bool(self._asked) and not found

    def result(self) -> Tolerance:
        """Return the crossing and its interval from the points with many devices.

        Between the two points around it the crossing is only interpolated, so that the interval
        reaches at least from the one to the other.
        """
        crossing = float(self._cross(self._reference.relative_score(self.outcome)))
        low, high = self._interval()
        if math.isfinite(crossing):
            gaps = sorted(self._measured)
            right = int(np.searchsorted(gaps, crossing))
            low = min(low, gaps[max(right - 1, 0)])
            high = max(high, gaps[min(right, len(gaps) - 1)])
        ends = {-math.inf: 0.0, math.inf: max(self._grid)}  # below at the first point, or never
        gap, low, high = (ends.get(value, value) for value in (crossing, low, high))
        return Tolerance(gap, (low, high), crossing == math.inf)

    def _scores(self) -> dict[float, float]:
        """Return all scores by gap, with many devices where these are measured."""
        if not self._measured:
            return self._grid
        measured = self._reference.relative_score(self.outcome).tolist()
        return self._grid | dict(zip(sorted(self._measured), measured, strict=True))

    def _next(self) -> Sequence[float]:
        scores = self._scores()
        left, right = _bracket(scores, self._acceptable)
        if left is not None and right is not None and right / left - 1 > self._bracket:
            return self._between(left, right, scores)
        ends = [end for end in (left, right) if end is not None and end not in self._measured]
        return ends or self._next_for_interval()

    def _next_for_interval(self) -> Sequence[float]:
        """Widen the measured range until the interval lies inside it, in steps that double.

        An end that lies where no point is near was only interpolated, and is looked for likewise.
        """
        last = max(self._measured)
        low, high = self._interval()
        wider = []
        above = min((gap for gap in self._measured if gap > low), default=last)
        below = max((gap for gap in self._measured if gap <= low), default=above)
        if low == -math.inf or above / below > WIDE:
            self._steps_down *= 2
            step = self._step_out ** (self._steps_down / 2)
            wider.append(max(above / step, min(self._grid)))
        if high == math.inf:
            self._steps_up *= 2
            wider.append(min(last * self._step_out ** (self._steps_up / 2), max(self._grid)))
        return wider

    def _interval(self) -> tuple[float, float]:
        replicates = self._cross(self._reference.score_replicates(self.outcome))
        low, high = statistics.interval(replicates)
        return float(low), float(high)

    def _cross(self, scores: Floats) -> Floats:
        gaps = np.array(sorted(self._measured))
        return statistics.first_crossing(gaps, scores, self._acceptable, log=self._log)

    def _between(self, left: float, right: float, scores: Mapping[float, float]) -> Sequence[float]:
        """Choose where to cut a bracket that is too wide.

        That is at the guessed crossing and as far to both sides as intervals usually reach at
        first; then at two places, a bracket's width apart, around a better guess; and in the middle
        where the bracket is short, and when guessing has not helped.
        """
        width = 1 + self._bracket
        if self._rounds > MAX_GUESSES or right / left <= width**2:
            return [self._middle(left, right)]
        guess = self._guess(left, right, scores)
        if not self._measured:
            ends = min(self._grid), max(self._grid)
            fan = (guess / self._step_out, guess, guess * self._step_out)
            return sorted({min(max(gap, ends[0]), ends[1]) for gap in fan})
        guess = min(max(guess, left * width), right / width)
        half = math.sqrt(width) * (1 - 1e-9)
        return [gap for gap in (guess / half, guess * half) if left < gap < right]

    def _guess(self, left: float, right: float, scores: Mapping[float, float]) -> float:
        """Return about where the crossing is.

        Beside a cliff it is on a line up its face. Random gaps with ends that are far apart are at
        first searched where periodic ones say. Otherwise scores over random gaps bend, and it is
        where a monotone cubic through all of them crosses; over periodic gaps it is on a line
        between the ends, unless just one of them is measured: then the line goes through that one,
        with the grid's slope. Few devices tell how steep a curve is better than how high.
        """
        beside = self._up_the_cliff(right, scores)
        if beside is None and self._periodic and right / left > WIDE and self._rounds <= 2:
            beside = (self._periodic.guess() or 0.0) / SPREAD
        if beside is not None and left < beside < right:
            return beside
        if self._log:
            gaps = sorted(scores)
            curve = PchipInterpolator(np.log(gaps), [scores[gap] for gap in gaps])
            crossings = np.exp(curve.solve(self._acceptable, extrapolate=False))
            inside = crossings[(left <= crossings) & (crossings <= right)]
            return float(inside[0]) if len(inside) else self._middle(left, right)
        known = [gap for gap in (left, right) if gap in self._measured]
        through, drop = left, scores[left] - scores[right]
        if len(known) == 1:
            of_few = np.interp((left, right), list(self._grid), list(self._grid.values()))
            through, drop = known[0], float(of_few[0] - of_few[1])
        if drop <= 0:
            return self._middle(left, right)
        steps = (scores[through] - self._acceptable) / drop
        return min(through + steps * (right - left), max(self._grid))

    def _up_the_cliff(self, right: float, scores: Mapping[float, float]) -> float | None:
        """Return the crossing on a line through two close points that begin at ``right``.

        ``None`` where scores fall too little between them to tell a slope from chance.
        """
        close = right * (1 + 2 * self._bracket)
        pair = [gap for gap in sorted(scores) if right <= gap <= close][:2]
        if len(pair) < 2 or (drop := scores[pair[0]] - scores[pair[1]]) < CLIFF:
            return None
        return pair[0] - (self._acceptable - scores[pair[0]]) / drop * (pair[1] - pair[0])

    def _middle(self, left: float, right: float) -> float:
        return math.sqrt(left * right) if self._log else (left + right) / 2


def _bracket(scores: Mapping[float, float], acceptable: float) -> tuple[float | None, float | None]:
    """Return the gaps around the first score that is not acceptable; ``None`` beyond the grid."""
    left = None
    for gap in sorted(scores):
        if scores[gap] < acceptable:
            return left, gap
        left = gap
    return left, None


@dataclasses.dataclass(frozen=True)
class Curves:
    """Holds by kind one method's outcomes on the grid, of few devices, and searches, of many."""

    grid: dict[str, tuple[list[Point], Outcome]]
    searches: dict[str, Search]


def measure_curves(
    measure: Callable[[Sequence[Point], int], Outcome],
    every_step: Callable[[], Outcome],
    reference: Reference,
    protocol: ProtocolSettings,
) -> Curves:
    """Measure both curves of one method and search both tolerances, always in one batch.

    Args:
        measure: simulates points with the first N draws: outcome arrays [P, N].
        every_step: waits for the method with a packet at every step (g = 1), [1, curve devices]:
            the first point of both curves, the same for all methods with one sensor and one actor.
        reference: the teacher with all bracket devices.
        protocol: grid, devices, acceptable score and bracket.
    """
    gaps = [float(gap) for gap in protocol.gaps]
    later = [Point(kind, gap) for kind in KINDS for gap in gaps[1:]]
    outcome = measure(later, protocol.curve_devices) if later else None
    first = every_step()
    grid: dict[str, tuple[list[Point], Outcome]] = {}
    searches: dict[str, Search] = {}
    for number, kind in enumerate(KINDS):
        rows = slice(number * (len(gaps) - 1), (number + 1) * (len(gaps) - 1))
        parts = [first, *([outcome.part(rows)] if outcome else [])]
        points, joined = [Point(kind, gap) for gap in gaps], Outcome.joined(parts, axis=0)
        grid[kind] = (points, joined)
        searches[kind] = Search(points, joined, reference, protocol, searches.get("gap"))
    while wanted := [point for search in searches.values() for point in search.wanted()]:
        outcome = measure(wanted, protocol.bracket_devices)
        for row, point in enumerate(wanted):
            searches[point.kind].add(point, outcome.part(slice(row, row + 1)))
    return Curves(grid, searches)
