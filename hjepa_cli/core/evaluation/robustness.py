"""Scores under conditions stand beside the nominal ones, of the same devices under the same draws.

Both are divided by what the teacher scores on nominal devices that it sees at every step: what a
condition takes from the teacher too counts against the method. There are P gaps and N devices.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hjepa_cli.core import statistics
from hjepa_cli.core.control.loop import Outcome
from hjepa_cli.core.evaluation.protocol import Point, Reference
from hjepa_cli.core.plants.system import System

GAPS_S = (0.02, 0.08, 0.16)  # between packets


def gaps_of(kind: System) -> tuple[int, ...]:
    """Return the gaps at which robustness is measured, in steps of a plant, each once."""
    return tuple(dict.fromkeys(max(round(gap_s / kind.step_s), 1) for gap_s in GAPS_S))


def describe(
    points: Sequence[Point], outcome: Outcome, nominal: Outcome, reference: Reference
) -> list[dict[str, Any]]:
    """Return the points of a row as printed: as those of a curve, with score ÷ nominal score.

    That is ``None`` where the nominal score is 0.
    """
    described = reference.describe(points, outcome)
    for point, beside in zip(described, _beside(outcome, nominal, reference), strict=True):
        point.update(beside)
    return described


def mean_of(
    outcomes: Sequence[Outcome], nominal: Outcome, reference: Reference
) -> list[dict[str, Any]]:
    """Return by gap the mean over rows of scores, and of scores ÷ nominal ones, with intervals.

    The rows are a fixed set: intervals are over devices, the same ones in all rows.
    """
    score = np.mean([outcome.score for outcome in outcomes], axis=0)
    mean = Outcome(score, score, score)
    low, high = statistics.interval(reference.score_replicates(mean))
    values: list[dict[str, Any]] = [
        {"score": float(value), "ci95": [float(low[i]), float(high[i])]}
        for i, value in enumerate(reference.relative_score(mean))
    ]
    beside = _beside(mean, nominal, reference)
    return [value | one for value, one in zip(values, beside, strict=True)]


def kept(outcome: Outcome) -> dict[str, Any]:
    """Return an outcome as plain data, which :func:`taken` reads."""
    return {name: None if of is None else of.tolist() for name, of in vars(outcome).items()}


def taken(values: Mapping[str, Any]) -> Outcome:
    """Return the outcome of :func:`kept`."""
    arrays = {name: np.array(of) for name, of in values.items() if of is not None}
    return Outcome(**arrays)


def _beside(outcome: Outcome, nominal: Outcome, reference: Reference) -> list[dict[str, Any]]:
    """Return by gap the score ÷ the nominal one, of the same devices, and its interval."""
    weights = statistics.bootstrap_weights(
        outcome.score.shape[1], reference.replicates, reference.seed
    )
    found: list[dict[str, Any]] = []
    for scores, usual in zip(outcome.score, nominal.score, strict=True):
        one: dict[str, Any] = {"relative": None, "relative_ci95": None}
        if usual.any():
            one["relative"] = float(statistics.ratio(scores, usual))
            replicates = statistics.ratio(scores, usual, weights)
            one["relative_ci95"] = statistics.interval(replicates).tolist()
        found.append(one)
    return found
