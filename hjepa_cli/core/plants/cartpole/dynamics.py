"""The cart-pole's exact equations of motion, for references and for the oracle.

Frictionless, uniform rod of length 2l. With temp = (u + m l θ̇² sin θ) / (M + m):

    θ̈ = (g sin θ − temp cos θ) / (l (4/3 − m cos² θ / (M + m)))
    ẍ = temp − m l θ̈ cos θ / (M + m)
"""

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.plants.cartpole.parameters import CartPoleParameters


def derivative(plant: CartPoleParameters, states: ArrayLike, force_n: ArrayLike) -> Floats:
    """Return the time derivative of the state.

    Args:
        plant: masses, length and gravity.
        states: ``[..., 4]`` x [m], x_dot [m/s], theta [rad], theta_dot [rad/s].
        force_n: ``[...]`` force on the cart [N].

    Returns:
        ``[..., 4]`` in m/s, m/s², rad/s, rad/s².
    """
    _, x_dot, theta, theta_dot = np.moveaxis(np.asarray(states, float), -1, 0)
    total_kg = plant.cart_mass_kg + plant.pole_mass_kg
    moment_kg_m = plant.pole_mass_kg * plant.half_length_m
    sin, cos = np.sin(theta), np.cos(theta)
    temp = (np.asarray(force_n) + moment_kg_m * theta_dot**2 * sin) / total_kg
    theta_ddot = (plant.gravity_m_s2 * sin - cos * temp) / (
        plant.half_length_m * (4 / 3 - plant.pole_mass_kg * cos**2 / total_kg)
    )
    x_ddot = temp - moment_kg_m * theta_ddot * cos / total_kg
    return np.stack([x_dot, x_ddot, theta_dot, theta_ddot], axis=-1)


def rk4_step(
    plant: CartPoleParameters, states: ArrayLike, force_n: ArrayLike, duration_s: float
) -> Floats:
    """Advance by one classical Runge-Kutta step under a held force.

    Args:
        plant: masses, length and gravity.
        states: ``[..., 4]``.
        force_n: ``[...]`` force on the cart [N].
        duration_s: length of the step.

    Returns:
        ``[..., 4]`` the states after ``duration_s``.
    """
    start = np.asarray(states, float)
    a = derivative(plant, start, force_n)
    b = derivative(plant, start + duration_s / 2 * a, force_n)
    c = derivative(plant, start + duration_s / 2 * b, force_n)
    d = derivative(plant, start + duration_s * c, force_n)
    return start + duration_s / 6 * (a + 2 * b + 2 * c + d)
