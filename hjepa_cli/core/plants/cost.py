"""The quadratic cost of a step."""

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
    """Quadratic cost min(xᵀQx + uᵀRu, 50) of one step, so that one lost device stays finite.

    Args:
        states: [..., S] in SI units.
        forces_n: applied forces [...], or [..., m].
        state_weights: diagonal of Q, the teacher's.
        force_weight: R, the teacher's, or its diagonal [m].
    """
    squares = forces_n**2
    effort = squares @ np.asarray(force_weight) if np.ndim(force_weight) else force_weight * squares
    cost = states**2 @ np.asarray(state_weights, dtype=np.float64) + effort
    return np.minimum(cost, COST_CAP)
