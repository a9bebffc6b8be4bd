"""A step of any system says how stable its equilibrium is, and which linear law holds it there.

Near rest a control step is x_{k+1} = A x_k + B u_k. A and B are taken from the step itself, so that
a new system needs its equations only.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np

from hjepa_cli.core.arrays import Floats

NUDGE = 1e-5  # central differences: error of order 1e-10
MARGIN = 1e-4  # |λ| below 1 + this is drift of an integrator, not growth


def linearise(
    advance: Callable[[Floats, Floats], Floats], state: Floats, force_n: Floats
) -> tuple[Floats, Floats]:
    """Return A [S, S] and B [S, m] of a control step, by central differences.

    ``advance`` maps states [n, S] and forces [n, *A] to states [n, S]; it is linearised at
    ``state`` [S] and ``force_n`` [*A].
    """
    count, forces = state.size, force_n.size
    nudges = NUDGE * np.concatenate([np.eye(count + forces), -np.eye(count + forces)])
    states = state + nudges[:, :count]
    forces_n = force_n + nudges[:, count:].reshape(-1, *force_n.shape)
    moved = advance(states, forces_n)
    slopes = ((moved[: count + forces] - moved[count + forces :]) / (2 * NUDGE)).T
    return slopes[:, :count], slopes[:, count:]


def gains_at_rest(teacher: Callable[[Floats], Floats], states: int) -> Floats:
    """Return K [m, S] of the law u = −K x that a teacher [n, S] → [n, *A] follows near rest."""
    nudges = NUDGE * np.concatenate([np.eye(states), -np.eye(states)])
    forces_n = teacher(nudges).reshape(2 * states, -1)
    return np.asarray(((forces_n[states:] - forces_n[:states]) / (2 * NUDGE)).T)


def unstable_rate_rad_s(a: Floats, step_s: float) -> float:
    """Return the sum of the unstable poles' real parts: Σ ln|λ| ÷ step over |λ| > 1 of A."""
    growth = np.abs(np.linalg.eigvals(a))
    return float(sum(math.log(rate) for rate in growth.tolist() if rate > 1 + MARGIN) / step_s)


def lqr_gain(
    a: Floats, b: Floats, state_weights: Sequence[float], force_weights: Sequence[float]
) -> Floats:
    """Return the gain K [m, S] of u = −K x that minimises Σ xᵀQx + uᵀRu, Q and R diagonal."""
    import scipy.linalg  # takes a third of a second, which a device on the wire need not wait

    q, r = np.diag(state_weights), np.diag(force_weights)
    p = scipy.linalg.solve_discrete_are(a, b, q, r)
    return np.asarray(np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a))
