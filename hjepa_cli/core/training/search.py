"""Few numbers whose worth only a simulation tells are sought by CMA-ES."""

from collections.abc import Callable

import numpy as np
from cmaes import CMA

from hjepa_cli.core.arrays import Floats

Evaluate = Callable[[Floats], Floats]
"""It says how good each of candidates [C, P] is: [C], more is better."""


def best(
    evaluate: Evaluate, start: Floats, spread: Floats, *, candidates: int, rounds: int, seed: int
) -> Floats:
    """Return the mean [P] of the distribution that the search ends with.

    The covariance matrix adaptation evolution strategy (Hansen, arXiv:1604.00772) draws
    ``candidates`` per round, the first time around ``start`` with the standard deviations
    ``spread`` [P], at least two numbers each.
    """
    strategy = CMA(np.zeros(len(start)), 1.0, seed=seed, population_size=candidates)
    for _ in range(rounds):
        drawn = [strategy.ask() for _ in range(candidates)]
        quality = evaluate(start + spread * np.stack(drawn))
        strategy.tell(list(zip(drawn, (-quality).tolist(), strict=True)))
    return np.asarray(start + spread * strategy.mean)
