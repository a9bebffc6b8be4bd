"""The teacher is a saturated state-dependent Riccati controller (SDRE), tabulated.

The equations of motion factor exactly into ẋ = A(θ, θ̇) x + B(θ) u. At every state the linear
quadratic problem of that A and B is solved and u = −K(θ, θ̇) x is applied, clipped to the force
limit. K depends on (θ, θ̇) only, so it is solved once on a grid and interpolated afterwards.
"""

import functools
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.arrays import Floats, described, finite
from hjepa_cli.core.plants.cartpole.parameters import CartPoleParameters
from hjepa_cli.core.plants.system import Teacher
from hjepa_cli.errors import ArrayError

THETA_LIMIT_RAD = 1.2
THETA_DOT_LIMIT_RAD_S = 25.0
CELLS = (96, 100)  # of the gain table over theta and theta_dot; even, so that 0 is a node


def gains(plant: CartPoleParameters, theta: Floats, theta_dot: Floats) -> Floats:
    """Return the gains K ``[n, 4]`` of u = −K x at theta ``[n]`` [rad], theta_dot ``[n]`` [rad/s].

    ``plant.discrete_teacher`` selects the discrete Riccati equation at ``step_s``.
    """
    a, b = state_dependent_form(plant, theta, theta_dot)
    q, r = np.diag(plant.state_weights), plant.force_weight
    if plant.discrete_teacher:
        return _discrete_gain(*_hold(a, b, plant.step_s), q * plant.step_s, r * plant.step_s)
    return _continuous_gain(a, b, q, r)


def state_dependent_form(
    plant: CartPoleParameters, theta: Floats, theta_dot: Floats
) -> tuple[Floats, Floats]:
    """Return A ``[n, 4, 4]`` and B ``[n, 4, 1]`` of the exact factorisation ẋ = A x + B u."""
    total_kg = plant.cart_mass_kg + plant.pole_mass_kg
    length_m, pole_kg = plant.half_length_m, plant.pole_mass_kg
    sin, cos = np.sin(theta), np.cos(theta)
    inertia = length_m * (4 / 3 - pole_kg * cos**2 / total_kg)
    coupling = pole_kg * length_m * cos / total_kg
    a = np.zeros((*np.shape(theta), 4, 4))
    b = np.zeros((*np.shape(theta), 4, 1))
    a[:, 0, 1] = a[:, 2, 3] = 1.0
    a[:, 3, 2] = plant.gravity_m_s2 * np.sinc(theta / np.pi) / inertia
    a[:, 3, 3] = -cos * sin * pole_kg * length_m * theta_dot / (total_kg * inertia)
    a[:, 1, 2] = -coupling * a[:, 3, 2]
    a[:, 1, 3] = pole_kg * length_m * theta_dot * sin / total_kg - coupling * a[:, 3, 3]
    b[:, 3, 0] = -cos / (total_kg * inertia)
    b[:, 1, 0] = 1 / total_kg - coupling * b[:, 3, 0]
    return a, b


@functools.cache
def sdre(plant: CartPoleParameters) -> Teacher:
    """Return the teacher of a cart-pole, a function from states ``[..., 4]`` to forces_n ``[...]``.

    Beyond the table (|θ| > 1.2 rad, |θ̇| > 25 rad/s) the gains of its edge are used. It raises
    NumericalError where a state is not finite.
    """
    cells = _bilinear_cells(plant)
    limits = np.array([THETA_LIMIT_RAD, THETA_DOT_LIMIT_RAD_S])
    per_cell = np.array(CELLS) / (2 * limits)
    last = np.array(CELLS) - 1

    def force_n(states: ArrayLike) -> Floats:
        states = finite(states, "states")
        if states.shape[-1:] != (4,):
            raise ArrayError(f"states: {described(states)}; expected [..., 4]")
        flat = states.reshape(-1, 4)
        place = (np.clip(flat[:, 2:], -limits, limits) + limits) * per_cell
        cell = np.minimum(place.astype(np.intp), last)
        s, t = (place - cell).T[:, :, None]
        c = cells[cell[:, 0] * CELLS[1] + cell[:, 1]].transpose(1, 0, 2)
        x, x_dot, theta, theta_dot = ((c[0] + s * c[1] + t * (c[2] + s * c[3])) * flat).T
        # K x, written out so that a state's force does not depend on the batch it comes in.
        force: Floats = -(x + x_dot + theta + theta_dot)
        return force.clip(-plant.force_limit_n, plant.force_limit_n).reshape(states.shape[:-1])

    return force_n


def _bilinear_cells(plant: CartPoleParameters) -> Floats:
    """Return per cell the coefficients ``[cells, 4, 4]`` of 1, s, t and s t, s and t in 0 … 1.

    The gains on the grid are K(−θ, −θ̇) = K(θ, θ̇), which halves the work.
    """
    theta = np.linspace(0.0, THETA_LIMIT_RAD, CELLS[0] // 2 + 1)
    theta_dot = np.linspace(-THETA_DOT_LIMIT_RAD_S, THETA_DOT_LIMIT_RAD_S, CELLS[1] + 1)
    grid = [axis.ravel() for axis in np.meshgrid(theta, theta_dot, indexing="ij")]
    half = gains(plant, *grid).reshape(theta.size, theta_dot.size, 4)
    table = np.concatenate([half[:0:-1, ::-1], half])
    near, far = table[:-1, :-1], table[1:, 1:]
    along, across = table[1:, :-1], table[:-1, 1:]
    cells = np.stack([near, along - near, across - near, far - along - across + near], axis=2)
    return cells.reshape(-1, 4, 4)


def _continuous_gain(a: Floats, b: Floats, q: Floats, r: float) -> Floats:
    """Solve AᵀP + PA − PBR⁻¹BᵀP + Q = 0 and return R⁻¹BᵀP, ``[n, 4]``."""
    b_t = np.swapaxes(b, -1, -2)
    q = np.broadcast_to(q, a.shape)
    hamiltonian = np.block([[a, -b @ b_t / r], [-q, -np.swapaxes(a, -1, -2)]])
    p = _stable_solution(hamiltonian, lambda eigenvalues: eigenvalues.real)
    return np.asarray((b_t @ p / r)[:, 0])


def _discrete_gain(a: Floats, b: Floats, q: Floats, r: float) -> Floats:
    """Solve P = AᵀPA − AᵀPB(R + BᵀPB)⁻¹BᵀPA + Q and return (R + BᵀPB)⁻¹BᵀPA, ``[n, 4]``."""
    b_t = np.swapaxes(b, -1, -2)
    q = np.broadcast_to(q, a.shape)
    a_inverse_t = np.linalg.inv(np.swapaxes(a, -1, -2))
    g = b @ b_t / r @ a_inverse_t
    symplectic = np.block([[a + g @ q, -g], [-a_inverse_t @ q, a_inverse_t]])
    p = _stable_solution(symplectic, np.abs)
    return np.asarray((b_t @ p @ a / (r + b_t @ p @ b))[:, 0])


def _stable_solution(matrix: Floats, growth: Callable[[NDArray[np.complex128]], Floats]) -> Floats:
    """Return P ``[n, 4, 4]`` whose graph (1, P) spans the stable half of the eigenvectors.

    ``matrix`` ``[n, 8, 8]`` is Hamiltonian or symplectic, with four eigenvalues on each side; the
    four smallest by ``growth`` are the stable ones.
    """
    eigenvalues, vectors = np.linalg.eig(matrix)
    stable = np.argsort(growth(eigenvalues), axis=-1)[:, None, :4]
    vectors = np.take_along_axis(vectors, stable, axis=-1)
    return np.asarray((vectors[:, 4:] @ np.linalg.inv(vectors[:, :4])).real)


def _hold(a: Floats, b: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Discretise ẋ = A x + B u exactly for a force held over ``step_s`` (matrix exponential)."""
    squarings = 6
    scaled = np.zeros((len(a), 5, 5))
    scaled[:, :4, :4] = a
    scaled[:, :4, 4:] = b
    scaled *= step_s / 2**squarings
    term = total = np.broadcast_to(np.eye(5), scaled.shape)
    for order in range(1, 12):  # Taylor: ‖scaled‖ < 0.1, so the rest is below 1e-20
        term = term @ scaled / order
        total = total + term
    for _ in range(squarings):
        total = total @ total
    return total[:, :4, :4], total[:, :4, 4:]
