"""Cart-poles are plants: ``desktop``, the paper's at 1 ms, and ``gym``, Gymnasium's at 20 ms."""

import dataclasses
import math
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Bools, Floats, finite
from hjepa_cli.core.plants.cartpole.camera import Camera
from hjepa_cli.core.plants.cartpole.parameters import STATE_NAMES, CartPoleParameters
from hjepa_cli.core.plants.cartpole.teacher import sdre
from hjepa_cli.core.plants.cost import stage_cost
from hjepa_cli.core.plants.frames import WIDTH_PX
from hjepa_cli.core.plants.system import System, Teacher, runge_kutta_step
from hjepa_cli.errors import UsageError

if TYPE_CHECKING:
    from hjepa_cli.core.plants.cartpole.simulation import CartPoles

SIZES = {"state_weights": 4, "window_m": 2, "cart_size_m": 2}  # of the other numbers there is one
SCORE_X_M = 0.05
SCORE_THETA_RAD = 0.05


@dataclasses.dataclass(frozen=True)
class CartPolePlant(CartPoleParameters, System):
    """A kind of cart-pole is its numbers with all that surrounds them."""

    state_names: ClassVar[tuple[str, ...]] = STATE_NAMES
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s", "rad", "rad/s")

    def check_members(self) -> None:
        """Raise UsageError for numbers that no cart-pole has: a weight may be 0, all else not."""
        super().check_members()
        for field in dataclasses.fields(CartPoleParameters):
            count, value = SIZES.get(field.name, 1), getattr(self, field.name)
            if field.name in ("name", "discrete_teacher"):
                continue
            found = np.asarray(value, object).ravel().tolist()
            real = int if field.name == "substeps" else (int, float)
            sound = all(isinstance(one, real) and 0 <= one < math.inf for one in found)
            if len(found) != count or not sound or (0 in found and field.name != "state_weights"):
                wanted = "a number above 0" if count == 1 else f"{count} numbers above 0"
                says = f"{field.name} = {value!r}; expected {wanted}"
                raise UsageError(f"plant '{self.name}': {says}")

    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> "CartPoles":
        """Simulate by pymunk; ``mass_scale`` is of cart and pole."""
        from hjepa_cli.core.plants.cartpole.simulation import CartPoles  # pymunk, when it is needed

        return CartPoles(self, devices, mass_scale=mass_scale)

    def in_band(self, states: Floats) -> Bools:
        """Say whether |x| ≤ 0.05 m and |θ| ≤ 0.05 rad."""
        return (np.abs(states[..., 0]) <= SCORE_X_M) & (np.abs(states[..., 2]) <= SCORE_THETA_RAD)

    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Return the capped quadratic cost with the teacher's weights."""
        return stage_cost(states, forces_n, self.state_weights, self.force_weight)

    def fallen(self, states: Floats) -> Bools:
        """Say whether the pole is level or below: on a machine it would lie on the track."""
        return np.abs(states[..., 2]) >= np.pi / 2

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """Move x only: the track looks the same everywhere."""
        moved = np.array(states, float)
        moved[..., 0] += np.asarray(shift_px) * self.window_m[0] / WIDTH_PX
        return moved

    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """Take one Runge-Kutta step."""
        held_n = finite(forces_n, "forces_n")
        states = finite(states, "states")
        return runge_kutta_step(lambda at: self.derivative(at, held_n), states, self.step_s)

    def teacher(self) -> Teacher:
        """Return the saturated state-dependent Riccati controller."""
        return sdre(self)

    def camera(self) -> Camera:
        """Return its camera."""
        return Camera(self)

    def with_pole_length(self, scale: float) -> "CartPolePlant":
        """Return the same with a pole ``scale`` times as long."""
        return dataclasses.replace(self, half_length_m=scale * self.half_length_m)


DESKTOP = CartPolePlant(
    name="desktop",
    cart_mass_kg=0.25,
    pole_mass_kg=0.05,
    half_length_m=0.1,
    step_s=1e-3,
    state_weights=(20.0, 0.5, 20.0, 0.05),
    force_weight=0.05,
    discrete_teacher=False,
    window_m=(0.6, 0.3),
    cart_size_m=(0.06, 0.03),
    pole_width_m=0.016,
)
GYM = CartPolePlant(
    name="gym",
    cart_mass_kg=1.0,
    pole_mass_kg=0.1,
    half_length_m=0.5,
    step_s=20e-3,
    state_weights=(1.0, 0.1, 10.0, 0.1),
    force_weight=0.01,
    discrete_teacher=True,
    window_m=(3.2, 1.6),
    cart_size_m=(0.32, 0.16),
    pole_width_m=0.085,
)
