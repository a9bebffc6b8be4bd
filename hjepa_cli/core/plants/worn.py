"""Devices may be worn: heavier, with friction, and with drives that answer late or not at all."""

import dataclasses
import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Bools, Floats, finite
from hjepa_cli.core.plants.cartpole.plant import CartPolePlant
from hjepa_cli.core.plants.frames import Camera
from hjepa_cli.core.plants.system import Simulation, System, Teacher
from hjepa_cli.errors import UsageError

FRICTION = ("viscous", "coulomb")


class Worn(System):
    """A plant is moved by other forces than it is told; all else is that of the plant.

    Args:
        kind: the plant.
        wear: severities by the names of :mod:`hjepa_cli.core.plants.stress`: ``mass``, ``viscous``
            [N s/m], ``coulomb`` [N], ``dead_zone`` [N], ``actuation`` [steps].

    Raises:
        UsageError: friction of a plant that has no cart.
    """

    def __init__(self, kind: System, wear: Mapping[str, float]) -> None:
        self._kind, self._wear = kind, wear
        names = ("name", "step_s", "force_limit_n", "state_names", "state_units")
        vars(self).update(
            {name: getattr(kind, name) for name in (*names, "action_shape", "mirror")}
        )
        rubbing = [name for name in FRICTION if wear.get(name)]
        if rubbing and not isinstance(kind, CartPolePlant):
            raise UsageError(f"condition {rubbing[0]} is of carts; plant {kind.name} has none")
        # Friction acts beside the drive, which alone has a limit: it brakes a saturated one, too.
        self._driven = dataclasses.replace(kind, force_limit_n=math.inf) if rubbing else kind  # type: ignore[type-var]

    def __getattr__(self, name: str) -> Any:
        """Return what the plant alone has, as the numbers of a cart-pole."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._kind, name)

    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> Simulation:
        """Return ``devices`` worn ones."""
        scale = np.ones((devices, 2)) if mass_scale is None else np.asarray(mass_scale, float)
        factor = self._wear.get("mass", 1.0)
        return _Simulation(self, self._driven.simulation(devices, mass_scale=factor * scale))

    def moving_n(self, forces_n: Floats, states: Floats) -> Floats:
        """Return what moves devices in states [n, S] where they are told forces [n, *A]."""
        moving = np.where(np.abs(forces_n) < self._wear.get("dead_zone", 0.0), 0.0, forces_n)
        if any(map(self._wear.get, FRICTION)):
            speed_m_s = states[:, self.state_names.index("x_dot")]
            moving = moving - self._wear.get("viscous", 0.0) * speed_m_s
            # Dry friction stops a cart within a step at most; it never turns it back.
            mass_kg = self._kind.cart_mass_kg + self._kind.pole_mass_kg  # type: ignore[attr-defined]
            stopping_n = mass_kg * self._wear.get("mass", 1.0) * speed_m_s / self.step_s
            dry_n = self._wear.get("coulomb", 0.0)
            moving = moving - np.clip(stopping_n, -dry_n, dry_n)
        return np.asarray(moving)

    @property
    def delay_steps(self) -> int:
        """Return how many steps after it is told a force takes effect."""
        return int(self._wear.get("actuation", 0))

    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """Advance as the plant does."""
        return self._kind.advance(states, forces_n)

    def teacher(self) -> Teacher:
        """Return the plant's."""
        return self._kind.teacher()

    def camera(self) -> Camera:
        """Return the plant's."""
        return self._kind.camera()

    def in_band(self, states: Floats) -> Bools:
        """Score as the plant does."""
        return self._kind.in_band(states)

    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Return the plant's cost."""
        return self._kind.cost(states, forces_n)

    def fallen(self, states: Floats) -> Bools:
        """Say what the plant does."""
        return self._kind.fallen(states)

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """Return the plant's."""
        return self._kind.sideways(states, shift_px)


class _Simulation:
    def __init__(self, worn: Worn, inner: Simulation) -> None:
        self._worn, self._inner = worn, inner
        self._told: deque[Floats] = deque(maxlen=worn.delay_steps + 1)

    @property
    def states(self) -> Floats:
        return self._inner.states

    @states.setter
    def states(self, states: ArrayLike) -> None:
        self._inner.states = states

    def step(self, forces_n: ArrayLike) -> None:
        limit_n = self._worn.force_limit_n
        told = np.clip(finite(forces_n, "forces_n"), -limit_n, limit_n)
        while len(self._told) < self._worn.delay_steps:  # before the first: nothing
            self._told.append(np.zeros_like(told))
        self._told.append(told)
        self._inner.step(self._worn.moving_n(self._told[0], self.states))
