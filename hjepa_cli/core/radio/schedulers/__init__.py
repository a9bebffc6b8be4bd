"""Who sends in a slot: one file per scheduler, each with one function ``score``.

The J highest scores above 0 win the J resource blocks of a slot; :mod:`.view` has what a scheduler
may know.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers import (
    drift_plus_penalty,
    innovation,
    max_aoi,
    opportunistic,
    round_robin,
    whittle,
)
from hjepa_cli.core.radio.schedulers.view import View

Score = Callable[[View], NDArray[np.float64]]

SCHEDULERS: Mapping[str, Score] = MappingProxyType(
    {
        "round-robin": round_robin.score,
        "opportunistic": opportunistic.score,
        "max-aoi": max_aoi.score,
        "drift-plus-penalty": drift_plus_penalty.score,
        "whittle": whittle.score,
        "innovation": innovation.score,
    }
)
REPORTING = ("innovation",)  # devices report their innovation to these


def pick(scores: NDArray[np.float64], blocks: int) -> NDArray[np.bool_]:
    """The winners: bool [N], at most ``blocks`` of them, ties to the lower device number."""
    best = np.argsort(-scores, kind="stable")[:blocks]
    chosen = np.zeros(len(scores), dtype=bool)
    chosen[best] = scores[best] > 0
    return chosen
