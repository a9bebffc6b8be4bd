"""The numbers of a cart-pole, on which its physics, its camera and its teacher depend."""

import dataclasses
import math


@dataclasses.dataclass(frozen=True)
class CartPoleParameters:
    """One kind of cart-pole with its teacher's weights and its camera's window."""

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
        """λ, the upright equilibrium's unstable pole [rad/s]."""
        total = self.cart_mass_kg + self.pole_mass_kg
        inertia = self.half_length_m * (4 / 3 - self.pole_mass_kg / total)
        return math.sqrt(self.gravity_m_s2 / inertia)
