"""The plant: cart-poles simulated by pymunk.

A cart slides on a groove; a uniform rod hangs on it by a pivot. A state is
``(x, x_dot, theta, theta_dot)`` in m, m/s, rad, rad/s; theta = 0 is upright, a positive theta
leans to +x, and neither theta nor the track is bounded.

Chipmunk's step first moves the bodies with their old velocities and then updates the velocities,
which alone is a first-order method. What pymunk holds here is therefore the state *half a substep
earlier*: positions are written ``dt/2`` back and read ``dt/2`` forward along their velocities.
Drift half, kick, drift half is the leapfrog scheme: second order, at no cost.
"""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pymunk
import pymunk.batch
from numpy.typing import ArrayLike

from hjepa_cli import systems
from hjepa_cli.core.metrics import stage_cost
from hjepa_cli.core.seeding import generator
from hjepa_cli.core.system import Bools, Floats, System, Teacher, check_masses
from hjepa_cli.errors import UsageError
from hjepa_cli.settings import Settings

if TYPE_CHECKING:
    from hjepa_cli.core.camera import Camera

VERSIONED = ("desktop", "gym")
TRACK_M = 1e4  # half length of the groove: out of reach
SCORE_X_M = 0.05
SCORE_THETA_RAD = 0.05
START = np.array([0.03, 0.1, 0.08, 0.5])  # m, m/s, rad, rad/s: where a seeded CartPole starts


@dataclasses.dataclass(frozen=True)
class Plant(System):
    """One kind of cart-pole with its teacher's weights and its camera's window."""

    state_names: ClassVar[tuple[str, ...]] = ("x", "x_dot", "theta", "theta_dot")
    state_units: ClassVar[tuple[str, ...]] = ("m", "m/s", "rad", "rad/s")

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

    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> "CartPoles":
        """See :class:`CartPoles`."""
        return CartPoles(self, devices, mass_scale=mass_scale)

    def in_band(self, states: Floats) -> Bools:
        """|x| ≤ 0.05 m and |θ| ≤ 0.05 rad. States [..., 4] → bool [...]."""
        return (np.abs(states[..., 0]) <= SCORE_X_M) & (np.abs(states[..., 2]) <= SCORE_THETA_RAD)

    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """See :func:`hjepa_cli.core.metrics.stage_cost`, with the teacher's weights."""
        return stage_cost(states, forces_n, self.state_weights, self.force_weight)

    # What knows the plant in turn is imported late.

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """The track looks the same everywhere: only x moves."""
        from hjepa_cli.core.camera import WIDTH_PX

        moved = np.array(states, float)
        moved[..., 0] += np.asarray(shift_px) * self.window_m[0] / WIDTH_PX
        return moved

    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """See :func:`hjepa_cli.core.dynamics.rk4_step`."""
        from hjepa_cli.core.dynamics import rk4_step

        return rk4_step(self, states, forces_n, self.step_s)

    def teacher(self) -> Teacher:
        """See :mod:`hjepa_cli.core.policy`."""
        from hjepa_cli.core.policy import sdre

        return sdre(self)

    def camera(self) -> "Camera":
        """See :class:`hjepa_cli.core.camera.Camera`."""
        from hjepa_cli.core.camera import Camera

        return Camera(self)


PLANTS: Mapping[str, Plant] = MappingProxyType(
    {
        "desktop": Plant(
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
        ),
        "gym": Plant(
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
        ),
    }
)


def plant(name: str) -> System:
    """Return the plant called ``name``: a cart-pole, or a module of :mod:`hjepa_cli.systems`.

    Raises:
        UsageError: there is none, naming the valid choices.
    """
    if name in PLANTS:
        return PLANTS[name]
    if name in systems.NAMES:
        return systems.load(name)
    choices = ", ".join([*PLANTS, *systems.NAMES])
    raise UsageError(f"unknown plant '{name}'; choose one of {choices}")


def definition(name: str) -> str | None:
    """What measurements on a plant depend on: its numbers, or the digest of its module.

    ``None`` for the plants of the zoo: :data:`hjepa_cli.core.loop.LOOP_VERSION` tells theirs apart.
    """
    if name in VERSIONED:
        return None
    return repr(PLANTS[name]) if name in PLANTS else systems.source_sha256(name)


def plant_of(settings: Settings) -> System:
    """Return the plant of the settings, after checking that they have one value per state.

    Raises:
        UsageError: they do not.
    """
    kind = plant(settings.plant)
    for name, values in (
        ("collect.start", settings.collect.half_widths),
        ("encoder.gate_r2", settings.encoder.least_r2),
        ("protocol.start", settings.protocol.half_widths),
        ("protocol.noise", settings.protocol.velocity_noise),
    ):
        if len(values) != len(kind.state_names):
            raise UsageError(
                f"{name} has {len(values)} values; plant {kind.name} has {len(kind.state_names)} "
                f"states: {', '.join(kind.state_names)}",
                hint=f"--plant {kind.name}, or a --config FILE.toml that sets {name}",
            )
    return kind


def cart_pole(which: Plant | str) -> Plant:
    """Return a plant, given as such or by name, that is a cart-pole.

    Raises:
        UsageError: it is not.
    """
    kind = plant(which) if isinstance(which, str) else which
    if not isinstance(kind, Plant):
        raise UsageError(f"plant '{kind.name}' is no cart-pole; choose one of {', '.join(PLANTS)}")
    return kind


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
    """Writes ``[devices, 2, fields]`` (carts and poles) into a Space."""

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
    """Many cart-poles of one plant in one pymunk Space.

    Args:
        plant: a plant or its name.
        devices: how many, at least 1.
        mass_scale: ``[devices, 2]`` factors on the cart's and the pole's mass; ``None`` is 1.

    Raises:
        UsageError: unknown plant, no devices, or mass factors that are not positive.
    """

    def __init__(
        self, plant: Plant | str, devices: int, *, mass_scale: ArrayLike | None = None
    ) -> None:
        self.plant = cart_pole(plant)
        scale = check_masses(devices, mass_scale)
        self.devices = devices
        self._substep_s = self.plant.step_s / self.plant.substeps
        self._space = self._build(scale)
        self._motion = _Writer(devices, _MOTION, 6)
        self._force = _Writer(devices, pymunk.batch.BodyFields.FORCE, 2)
        self._reading = pymunk.batch.Buffer()
        self.states = np.zeros((devices, 4))

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
        """The states ``[devices, 4]``: x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]."""
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
        states = np.asarray(states, float)
        if states.shape != (self.devices, 4):
            raise ValueError(f"states have shape {states.shape}, not ({self.devices}, 4)")
        length_m = self.plant.half_length_m
        x, x_dot, theta, theta_dot = states.T
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
        """Advance by one control step of ``plant.step_s``, without noise.

        Args:
            forces_n: force on each cart [N], ``[devices]``, clipped to ± ``plant.force_limit_n``.
        """
        limit_n = self.plant.force_limit_n
        self._force.bodies[:, _CART, 0] = np.clip(forces_n, -limit_n, limit_n)
        for _ in range(self.plant.substeps):  # pymunk clears the forces after each
            self._force.write(self._space)
            self._space.step(self._substep_s)


class CartPole:
    """One cart-pole.

    Args:
        preset: a plant or its name, ``"desktop"`` or ``"gym"``.
        seed: draw the initial state from this seed, uniform within ± :data:`START`; ``None``
            starts upright and at rest.
    """

    def __init__(self, preset: Plant | str, *, seed: int | None = None) -> None:
        self._poles = CartPoles(preset, 1)
        self.plant = self._poles.plant
        if seed is not None:
            self.state = generator(seed).uniform(-1, 1, 4) * START

    @property
    def state(self) -> Floats:
        """The state ``[4]``: x [m], x_dot [m/s], theta [rad], theta_dot [rad/s]."""
        return self._poles.states.reshape(4)

    @state.setter
    def state(self, state: ArrayLike) -> None:
        self._poles.states = np.asarray(state, float).reshape(1, 4)

    def step(self, force_n: float, *, noise: ArrayLike | None = None) -> Floats:
        """Advance by one control step and return the new state ``[4]``.

        Args:
            force_n: force on the cart [N], clipped to ± ``plant.force_limit_n``.
            noise: ``[4]`` added to the state after the step; ``None`` adds none.
        """
        self._poles.step(np.reshape(force_n, 1))
        if noise is not None:
            self.state = self.state + np.asarray(noise, float)
        return self.state
