"""A cart-pole is some numbers and the exact equations of motion that hold for them.

It is frictionless, with a uniform rod of length 2l. With temp = (u + m l θ̇² sin θ) / (M + m):

    θ̈ = (g sin θ − temp cos θ) / (l (4/3 − m cos² θ / (M + m)))
    ẍ = temp − m l θ̈ cos θ / (M + m)
"""

import dataclasses
import math

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Floats

STATE_NAMES = ("x", "x_dot", "theta", "theta_dot")


@dataclasses.dataclass(frozen=True)
class CartPoleParameters:
    """These numbers fix a kind of cart-pole, its teacher and its camera."""

    name: str
    cart_mass_kg: float
    pole_mass_kg: float
    half_length_m: float
    step_s: float
    state_weights: tuple[float, float, float, float]  # diagonal of Q
    force_weight: float  # R
    discrete_teacher: bool  # solve the discrete Riccati equation at step_s
    window_m: tuple[float, float]  # what the camera sees: width, height
    cart_size_m: tuple[float, float]  # width, height
    pole_width_m: float
    gravity_m_s2: float = 9.81
    substeps: int = 10
    force_limit_n: float = 20.0

    @property
    def unstable_rate_rad_s(self) -> float:
        """Return λ, the upright equilibrium's unstable pole [rad/s]."""
        total = self.cart_mass_kg + self.pole_mass_kg
        inertia = self.half_length_m * (4 / 3 - self.pole_mass_kg / total)
        return math.sqrt(self.gravity_m_s2 / inertia)

    def derivative(self, states: ArrayLike, force_n: ArrayLike) -> Floats:
        """Return the time derivative ``[..., 4]`` of states ``[..., 4]`` in SI units.

        The force on the cart is ``[...]``.
        """
        _, x_dot, theta, theta_dot = np.moveaxis(np.asarray(states, float), -1, 0)
        total_kg = self.cart_mass_kg + self.pole_mass_kg
        moment_kg_m = self.pole_mass_kg * self.half_length_m
        sin, cos = np.sin(theta), np.cos(theta)
        temp = (np.asarray(force_n) + moment_kg_m * theta_dot**2 * sin) / total_kg
        theta_ddot = (self.gravity_m_s2 * sin - cos * temp) / (
            self.half_length_m * (4 / 3 - self.pole_mass_kg * cos**2 / total_kg)
        )
        x_ddot = temp - moment_kg_m * theta_ddot * cos / total_kg
        return np.stack([x_dot, x_ddot, theta_dot, theta_ddot], axis=-1)
