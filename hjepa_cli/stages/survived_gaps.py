"""Simulation finds the gaps between packets that loops survive, by method and interval."""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.evaluation import survival
from hjepa_cli.core.evaluation.load_simulator import PacketBits
from hjepa_cli.core.evaluation.simulator import BLOCK_LOOPS, Simulator, Tick
from hjepa_cli.core.evaluation.survival import Gaps, LossCurve, Rare, Silences, Trial
from hjepa_cli.core.evaluation.workers import Workers
from hjepa_cli.stages.model_set import ModelSet

Row = dict[str, Any]

LONGER = 1.5  # a gap than the one before, beyond the protocol's
MOST_LONGER = 3
ROUNDS = 5  # of finer gaps
WIDTH = 1.06  # of a bracket that is fine enough
RARE_TRIALS = 3  # gaps that splitting looks at


class Survivals:
    """Searches the gaps that methods survive; several threads may ask for some."""

    def __init__(self, models: ModelSet, workers: Workers, tick: Tick) -> None:
        self._models, self._workers, self._tick = models, workers, tick
        self._settings = models.settings

    def measure(self, method: str, interval: int) -> Row:
        """Return a method's curve of losses over the gap, and the gap at each level."""
        options, trial = self._settings.survival, Trial.of(self._settings.protocol, interval)
        outcomes: dict[int, Silences] = {}
        wanted: Sequence[int] = gaps_at_first(self._settings, interval)
        for _ in range(ROUNDS + MOST_LONGER):
            outcomes |= self._silences(method, trial, wanted)
            curve = counted(outcomes)
            if curve.probability[-1] <= survival.LEVELS[0]:
                wanted = longer_gap(self._settings, int(curve.gaps[-1]))
            else:
                wanted = [
                    gap for gap in curve.wanted(survival.LEVELS, WIDTH) if gap not in outcomes
                ]
            if not wanted:
                break
        rare = self._rare(method, trial, curve) if options.splitting_paths else []
        # What a packet has in bits is the driver's to say, where the models are.
        [bits] = self._workers.results([self._submit(method, PacketBits(method))], self._tick)
        return {
            "method": method,
            "interval_steps": interval,
            "bits_per_transmission": bits,
            "points": [described(gap, outcomes[gap]) for gap in curve.gaps.tolist()],
            "splitting": [{"gap_steps": gap, "p": p, "sd_ln_p": sd} for gap, p, sd in rare],
            "levels": levels_of(curve, rare, interval),
        }

    def _silences(self, method: str, trial: Trial, gaps: Sequence[int]) -> dict[int, Silences]:
        loops = self._settings.survival.loops
        count = min(max(loops * len(gaps) // BLOCK_LOOPS, 1), loops)
        cuts = [loops * number // count for number in range(count + 1)]
        units = [
            Gaps(method, trial, tuple(gaps), start, stop)
            for start, stop in itertools.pairwise(cuts)
        ]
        futures = [self._submit(method, unit) for unit in units]
        joined = Silences.joined(self._workers.results(futures, self._tick))
        return {
            gap: Silences(joined.lost[i], joined.left_band[i], joined.back_steps[i])
            for i, gap in enumerate(gaps)
        }

    def _rare(self, method: str, trial: Trial, curve: LossCurve) -> list[tuple[int, float, float]]:
        """Return gaps, ascending, with the probability by splitting and its error in logarithms.

        The first is the longest at which not even one loop in a hundred is lost; from there along
        the line through what is known.
        """
        found: dict[int, tuple[float, float]] = {}
        gap = max(curve.tolerated(survival.LEVELS[1])[0], trial.interval_steps + 1)
        paths = self._settings.survival.splitting_paths
        for _ in range(RARE_TRIALS):
            future = self._submit(method, Rare(method, trial, gap, paths))
            [found[gap]] = self._workers.results([future], self._tick)
            gap = next_rare_gap(curve, found, trial.interval_steps)
            if gap in found:
                break
        return [(gap, *found[gap]) for gap in sorted(found)]

    def _submit(self, method: str, unit: Any) -> Any:
        model = self._models.of(method).file
        return self._workers.submit(Simulator, self._settings, model, unit, self._tick)


def gaps_at_first(settings: Settings, interval: int) -> list[int]:
    """Return the gaps to begin with: none at all, and the protocol's that are longer."""
    return [interval, *(gap for gap in settings.protocol.gaps if gap > interval)]


def longer_gap(settings: Settings, gap: int) -> list[int]:
    """Return the gap to go on with where none so far loses enough loops; none if long enough."""
    limit = settings.protocol.gaps[-1] * LONGER**MOST_LONGER
    return [round(gap * LONGER)] if gap < limit else []


def longest_gap(settings: Settings) -> int:
    """Return the longest gap of loops that are never lost, which memory must hold."""
    found = []
    for interval in settings.survival.intervals_steps:
        wanted = gaps_at_first(settings, interval)
        while wanted:
            found.append(wanted[-1])
            wanted = longer_gap(settings, wanted[-1])
    return max(found)


def counted(outcomes: Mapping[int, Silences]) -> LossCurve:
    """Return the curve of what was counted."""
    gaps = sorted(outcomes)
    lost = [int(outcomes[gap].lost.sum()) for gap in gaps]
    loops = [outcomes[gap].lost.size for gap in gaps]
    return LossCurve(np.array(gaps), np.array(lost), np.array(loops))


def next_rare_gap(curve: LossCurve, found: Mapping[int, tuple[float, float]], interval: int) -> int:
    """Return where the logarithm of the probability should be that of one in 10,000."""
    known = {
        gap: p for gap, p in zip(curve.gaps.tolist(), curve.probability.tolist(), strict=True) if p
    }
    known |= {gap: p for gap, (p, _) in found.items() if p > 0}
    places = sorted(known)
    if not places:  # nothing is lost anywhere: further out
        return round(max(found) * LONGER)
    if len(places) == 1:
        return max(interval + 1, round(places[0] * 0.9))
    logs = [math.log(known[gap]) for gap in places]
    wanted = math.log(survival.RARE)
    at = next((i for i, value in enumerate(logs) if value >= wanted), len(logs) - 1)
    left, right = (at - 1, at) if at else (0, 1)
    slope = (logs[right] - logs[left]) / (places[right] - places[left])
    if slope <= 0:
        return max(interval + 1, round(places[left] * 0.9))
    guess = places[left] + (wanted - logs[left]) / slope
    return max(interval + 1, round(max(guess, places[0] * 0.7)))


def levels_of(
    curve: LossCurve, rare: Sequence[tuple[int, float, float]], interval: int
) -> list[Row]:
    """Return the survival times at each level, counted, by splitting or as a bound."""
    levels = []
    for level in survival.LEVELS:
        gap, (low, high), at_least = curve.tolerated(level)
        levels.append(_level(level, "counted", gap, (low, high), interval, at_least))
    if not rare:  # what no upper bound of the counts contradicts
        _, (low, _), at_least = curve.tolerated(survival.RARE)
        levels.append(_level(survival.RARE, "bound", low, (low, None), interval, at_least))
        return levels
    gaps = np.array([gap for gap, _, _ in rare], np.float64)
    logs = np.array([math.log(p) if p > 0 else -50.0 for _, p, _ in rare])
    errors = np.array([sd if p > 0 else 0.0 for _, p, sd in rare])
    wanted = math.log(survival.RARE)
    ends = [_where(gaps, logs + 1.96 * side * errors, wanted) for side in (0, 1, -1)]
    gap, low, high = (max(interval, math.floor(end)) for end in ends)
    how = "splitting" if logs.min() <= wanted <= logs.max() else "splitting, extrapolated"
    levels.append(_level(survival.RARE, how, gap, (low, high), interval, False))
    return levels


def _level(
    level: float,
    how: str,
    gap: int,
    ends: tuple[int, int | None],
    interval: int,
    at_least: bool,
) -> Row:
    """Return a level of a row; a gap of one interval is no silence, and less is none either."""
    low, high = ends
    return {
        "loss_probability": level,
        "how": how,
        "gap_steps": gap,
        "survival_steps": max(gap - interval, 0),
        "survival_ci95": [
            max(low - interval, 0),
            None if high is None else max(high - interval, 0),
        ],
        "at_least": at_least,
    }


def _where(gaps: Floats, logs: Floats, wanted: float) -> float:
    """Return where logarithms reach a value, on the lines between them and beyond the ends."""
    logs = np.maximum.accumulate(logs)
    if len(gaps) == 1 or logs[0] == logs[-1]:
        return float(gaps[0] if logs[0] <= wanted else 0.0)
    at = int(np.clip(np.searchsorted(logs, wanted), 1, len(gaps) - 1))
    rise = logs[at] - logs[at - 1]
    if rise <= 0:
        return float(gaps[at - 1])
    return float(gaps[at - 1] + (wanted - logs[at - 1]) / rise * (gaps[at] - gaps[at - 1]))


def described(gap: int, outcome: Silences) -> Row:
    """Return a point of a curve as printed."""
    lost, loops = int(outcome.lost.sum()), outcome.lost.size
    low, high = survival.clopper_pearson(lost, loops)
    back = np.sort(outcome.back_steps)
    places = [back[min(math.ceil(share * loops) - 1, loops - 1)] for share in (0.5, 0.95)]
    return {
        "gap_steps": gap,
        "lost": lost,
        "loops": loops,
        "p_lost": lost / loops,
        "p_lost_ci95": [float(low), float(high)],
        "p_left_band": float(outcome.left_band.mean()),
        "back_steps_median": float(places[0]) if np.isfinite(places[0]) else None,
        "back_steps_p95": float(places[1]) if np.isfinite(places[1]) else None,
    }
