"""Pymunk simulates cart-poles.

A cart slides on a groove; a uniform rod hangs on it by a pivot. A state is
``(x, x_dot, theta, theta_dot)`` in m, m/s, rad, rad/s; theta = 0 is upright, a positive theta
leans to +x, and neither theta nor the track is bounded.

Chipmunk's step first moves the bodies with their old velocities and then updates the velocities,
which alone is a first-order method. What pymunk holds here is therefore the state *half a substep
earlier*: positions are written ``dt/2`` back and read ``dt/2`` forward along their velocities.
Drift half, kick, drift half is the leapfrog scheme: second order, at no cost.
"""

import math
from typing import Any

import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Floats, finite
from hjepa_cli.core.plants.cartpole.parameters import CartPoleParameters
from hjepa_cli.core.plants.system import check_masses, check_states

TRACK_M = 1e4  # half length of the groove: out of reach

# What pymunk stores per body, in the order in which pymunk.batch reads and writes it.
_MOTION = (
    pymunk.batch.BodyFields.POSITION
    | pymunk.batch.BodyFields.ANGLE
    | pymunk.batch.BodyFields.VELOCITY
    | pymunk.batch.BodyFields.ANGULAR_VELOCITY
)
_X, _Y, _ANGLE, _X_DOT, _Y_DOT, _ANGLE_DOT = range(6)
_CART, _POLE = range(2)


class _Writer:
    """It writes ``[devices, 2, fields]`` (carts and poles) into a Space."""

    def __init__(self, devices: int, fields: pymunk.batch.BodyFields, width: int) -> None:
        # pymunk visits the Space's own static body too, after all the others.
        memory = np.zeros((2 * devices + 1, width))
        self.bodies: Floats = memory[:-1].reshape(devices, 2, width)
        self._fields = fields
        self._buffer = pymunk.batch.Buffer()
        self._buffer.set_float_buf(memory)

    def write(self, space: pymunk.Space) -> None:
        pymunk.batch.set_space_bodies(space, self._fields, self._buffer)


class CartPoles:
    """It holds cart-poles of one kind in one pymunk Space.

    Args:
        parameters: their numbers.
        devices: how many, at least 1.
        mass_scale: ``[devices, 2]`` factors on the cart's and the pole's mass; ``None`` is 1.

    Raises:
        UsageError: no devices, or mass factors that are not positive.
        NumericalError: states are set, or forces applied, that are not finite.
    """

    def __init__(
        self,
        parameters: CartPoleParameters,
        devices: int,
        *,
        mass_scale: ArrayLike | None = None,
    ) -> None:
        self.plant = parameters
        self._mass_scale = scale = check_masses(devices, mass_scale)
        self.devices = devices
        self._substep_s = self.plant.step_s / self.plant.substeps
        self._space = self._build(scale)
        self._motion = _Writer(devices, _MOTION, 6)
        self._force = _Writer(devices, pymunk.batch.BodyFields.FORCE, 2)
        self._reading = pymunk.batch.Buffer()
        self.states = np.zeros((devices, 4))

    def __getstate__(self) -> dict[str, Any]:
        """Copy and pickle what defines the simulation, of which pymunk's own objects are made.

        A copy moves like the original up to rounding: pymunk does not tell the impulses that it
        remembers of the last step.
        """
        made_of = {"parameters": self.plant, "devices": self.devices}
        return made_of | {"mass_scale": self._mass_scale, "states": self.states}

    def __setstate__(self, state: dict[str, Any]) -> None:
        made_of = dict(state)
        states = made_of.pop("states")
        self.__init__(**made_of)  # type: ignore[misc]
        self.states = states

    def _build(self, mass_scale: Floats) -> pymunk.Space:
        kind = self.plant
        space = pymunk.Space()
        space.gravity = (0.0, -kind.gravity_m_s2)
        space.iterations = 2  # warm-started: 50 change the state by less than 1e-8 a step
        for cart_scale, pole_scale in mass_scale.tolist():
            pole_mass_kg = kind.pole_mass_kg * pole_scale
            cart = pymunk.Body(kind.cart_mass_kg * cart_scale, math.inf)
            pole = pymunk.Body(pole_mass_kg, pole_mass_kg * kind.half_length_m**2 / 3)
            groove = pymunk.GrooveJoint(
                space.static_body, cart, (-TRACK_M, 0.0), (TRACK_M, 0.0), (0.0, 0.0)
            )
            pivot = pymunk.PivotJoint(cart, pole, (0.0, 0.0), (0.0, -kind.half_length_m))
            for joint in (groove, pivot):
                joint.error_bias = 0.0  # hold the joint at the end of the substep, not over 1/60 s
            space.add(cart, pole, groove, pivot)
        return space

    @property
    def states(self) -> Floats:
        """Return states ``[devices, 4]``: x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]."""
        self._reading.clear()
        pymunk.batch.get_space_bodies(self._space, _MOTION, self._reading)
        bodies = np.frombuffer(self._reading.float_buf())[: 12 * self.devices].reshape(-1, 2, 6)
        cart, pole = bodies[:, _CART], bodies[:, _POLE]
        states = np.empty((self.devices, 4))
        states[:, 1] = cart[:, _X_DOT]
        states[:, 3] = -pole[:, _ANGLE_DOT]
        states[:, 0] = cart[:, _X] + states[:, 1] * (self._substep_s / 2)
        states[:, 2] = -pole[:, _ANGLE] + states[:, 3] * (self._substep_s / 2)
        return states

    @states.setter
    def states(self, states: ArrayLike) -> None:
        length_m = self.plant.half_length_m
        x, x_dot, theta, theta_dot = check_states(states, (self.devices, 4)).T
        x_before = x - x_dot * (self._substep_s / 2)
        theta_before = theta - theta_dot * (self._substep_s / 2)
        cart, pole = self._motion.bodies[:, _CART], self._motion.bodies[:, _POLE]
        cart[:] = 0.0
        cart[:, _X] = x_before
        cart[:, _X_DOT] = x_dot
        pole[:, _X] = x_before + length_m * np.sin(theta_before)
        pole[:, _Y] = length_m * np.cos(theta_before)
        pole[:, _ANGLE] = -theta_before
        # The pole's centre moves with the pivot and around it; anything else the joint would undo.
        pole[:, _X_DOT] = x_dot + length_m * theta_dot * np.cos(theta)
        pole[:, _Y_DOT] = -length_m * theta_dot * np.sin(theta)
        pole[:, _ANGLE_DOT] = -theta_dot
        self._motion.write(self._space)

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step under forces ``[devices]``, clipped; without noise."""
        limit_n = self.plant.force_limit_n
        applied_n = np.clip(finite(forces_n, "forces_n"), -limit_n, limit_n)
        self._force.bodies[:, _CART, 0] = applied_n
        for _ in range(self.plant.substeps):  # pymunk clears the forces after each
            self._force.write(self._space)
            self._space.step(self._substep_s)
