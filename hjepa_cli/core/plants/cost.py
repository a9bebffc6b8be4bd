"""A step has a quadratic cost."""

from collections.abc import Sequence

import numpy as np

from hjepa_cli.core.arrays import Floats

COST_CAP = 50.0


def stage_cost(
    states: Floats,
    forces_n: Floats,
    state_weights: Sequence[float],
    force_weight: float | Sequence[float],
) -> Floats:
    """Return min(xᵀQx + uᵀRu, 50) of one step, capped so that one lost device stays finite.

    Q has the diagonal ``state_weights``, R is ``force_weight`` or has that diagonal [m]; states
    [..., S] are in SI units, the applied forces [...] or [..., m].
    """
    squares = forces_n**2
    effort = squares @ np.asarray(force_weight) if np.ndim(force_weight) else force_weight * squares
    cost = states**2 @ np.asarray(state_weights, dtype=np.float64) + effort
    return np.minimum(cost, COST_CAP)
