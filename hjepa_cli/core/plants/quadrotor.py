"""A quadrotor hovers in a vertical plane: it has six states and two forces.

A rigid body with a rotor at each end. The rotors also meet the air sideways: moving along their
plane, they drag (blade flapping), and because they sit above the centre of mass the drag tilts the
body against its motion. So hovering is unstable, a slowly growing swing, as with any helicopter.
With f the sum of both thrusts, w the hub's speed along the body's x axis and t the turning force:

    m ẍ = f sin θ − c w cos θ
    m z̈ = f cos θ − m g + c w sin θ        w = ẋ cos θ − ż sin θ + h θ̇
    I θ̈ = a t − h c w

The forces are what is added to hovering: (f − m g, t), each within half the weight, so that no
rotor must pull down.
"""

import dataclasses
import functools
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Bools, Floats, Pixels, finite
from hjepa_cli.core.plants.cost import stage_cost
from hjepa_cli.core.plants.drawing import Colour, Rod, draw
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.linear import linearise, lqr_gain
from hjepa_cli.core.plants.system import Integrated, System, Teacher, runge_kutta_step

BODY_RGB, ROTOR_RGB = (0, 114, 178), (160, 0, 0)
Point = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Quadrotor(System):
    """These numbers fix the plant, its teacher and its camera."""

    state_names: ClassVar = ("x", "x_dot", "z", "z_dot", "theta", "theta_dot")
    state_units: ClassVar = ("m", "m/s", "m", "m/s", "rad", "rad/s")
    action_shape: ClassVar = (2,)
    mirror: ClassVar = (1.0, -1.0)  # a mirrored one lifts the same and turns the other way

    name: str = "quadrotor"
    step_s: float = 10e-3
    mass_kg: float = 0.5
    inertia_kg_m2: float = 0.005
    arm_m: float = 0.15
    hub_m: float = 0.1  # of the rotors above the centre of mass
    drag_kg_s: float = 0.3
    gravity_m_s2: float = 9.81
    force_limit_n: float = 0.5 * 0.5 * 9.81
    state_weights: tuple[float, ...] = (40.0, 2.0, 40.0, 2.0, 20.0, 0.5)
    force_weights: tuple[float, ...] = (0.5, 2.0)
    band: tuple[float, ...] = (0.1, np.inf, 0.1, np.inf, 0.1, np.inf)
    window_m: float = 1.6  # across; half as high

    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> Integrated:
        """Simulate by the equations; ``mass_scale`` is of mass and moment of inertia."""
        return Integrated(self, self.advance, devices, mass_scale)

    def advance(self, states: Floats, forces_n: Floats, mass_scale: Floats | None = None) -> Floats:
        """Take one Runge-Kutta step."""
        rate = functools.partial(self._rate, finite(forces_n, "forces_n"), mass_scale)
        return runge_kutta_step(rate, finite(states, "states"), self.step_s)

    def _rate(self, forces_n: Floats, mass_scale: Floats | None, states: Floats) -> Floats:
        mass, inertia = np.moveaxis(np.ones(2) if mass_scale is None else mass_scale, -1, 0)
        mass, inertia = mass * self.mass_kg, inertia * self.inertia_kg_m2
        lift, turn = np.moveaxis(forces_n, -1, 0)
        _, x_dot, _, z_dot, theta, theta_dot = np.moveaxis(states, -1, 0)
        sin, cos = np.sin(theta), np.cos(theta)
        thrust = lift + self.mass_kg * self.gravity_m_s2
        drag = self.drag_kg_s * (x_dot * cos - z_dot * sin + self.hub_m * theta_dot)
        x_ddot = (thrust * sin - drag * cos) / mass
        z_ddot = (thrust * cos + drag * sin) / mass - self.gravity_m_s2
        theta_ddot = (self.arm_m * turn - self.hub_m * drag) / inertia
        return np.stack([x_dot, x_ddot, z_dot, z_ddot, theta_dot, theta_ddot], axis=-1)

    def teacher(self) -> Teacher:
        """Return the linear quadratic regulator of hovering, clipped."""
        return _teacher(self)

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """Move x only: the air looks the same everywhere."""
        moved = np.array(states, float)
        moved[..., 0] += np.asarray(shift_px) * self.window_m / WIDTH_PX
        return moved

    def camera(self) -> "Camera":
        """Return its camera."""
        return Camera(self)

    def in_band(self, states: Floats) -> Bools:
        """Say whether |x| ≤ 0.1 m, |z| ≤ 0.1 m and |θ| ≤ 0.1 rad."""
        return np.asarray((np.abs(states) <= self.band).all(axis=-1))

    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Return the capped quadratic cost with the teacher's weights."""
        return stage_cost(states, forces_n, self.state_weights, self.force_weights)


@functools.cache
def _teacher(kind: Quadrotor) -> Teacher:
    a, b = linearise(kind.advance, np.zeros(6), np.zeros(2))
    gain = lqr_gain(a, b, kind.state_weights, kind.force_weights)

    def force_n(states: ArrayLike) -> Floats:
        # Not a matrix product, which would depend on the batch a state comes in.
        forces = -(finite(states, "states")[..., None, :] * gain).sum(axis=-1)
        return np.asarray(forces.clip(-kind.force_limit_n, kind.force_limit_n))

    return force_n


class Camera:
    """It stands in front of the plant and looks at the place where that should hover."""

    def __init__(self, kind: Quadrotor) -> None:
        self._kind, self._scale_px_m = kind, WIDTH_PX / kind.window_m

    def render(self, states: ArrayLike) -> Pixels:
        """Draw states ``[n, 6]`` as beam, masts and rotors: frames ``[n, 64, 128, 3]``."""
        states = finite(states, "states")
        arm_m, hub_m, blade_m = self._kind.arm_m, self._kind.hub_m, 0.6 * self._kind.arm_m

        def rod(start: Point, end: Point, width_m: float, colour: Colour) -> Rod:
            ends = self._place(states, start), self._place(states, end)
            return Rod(*ends, width_m * self._scale_px_m, colour)

        rods = [rod((-arm_m, 0), (arm_m, 0), 0.05, BODY_RGB)]
        for side in (-arm_m, arm_m):
            tips = (side - blade_m, hub_m), (side + blade_m, hub_m)
            rods.append(rod((side, 0), (side, hub_m), 0.03, BODY_RGB))
            rods.append(rod(*tips, 0.03, ROTOR_RGB))
        return draw(rods)

    def manifest(self) -> dict[str, Any]:
        """Return everything that fixes a picture."""
        return {"version": 1, "scale_px_m": self._scale_px_m, "arm_m": self._kind.arm_m,
                "hub_m": self._kind.hub_m, "body_rgb": list(BODY_RGB),
                "rotor_rgb": list(ROTOR_RGB)}  # fmt: skip

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the line from rotor to rotor, and the beam's."""
        states, arm_m, hub_m = finite(state, "state")[None], self._kind.arm_m, self._kind.hub_m
        ends = [self._place(states, (side, up)) for up in (hub_m, 0) for side in (-arm_m, arm_m)]
        return [np.concatenate(ends[:2]), np.concatenate(ends[2:])]

    def _place(self, states: Floats, point_m: Point) -> Floats:
        """Return where a point of the body is in the picture, (column, row) ``[n, 2]``."""
        along, up = point_m
        x, z, theta = states[:, 0], states[:, 2], states[:, 4]
        sin, cos = np.sin(theta), np.cos(theta)
        right, above = x + along * cos + up * sin, z - along * sin + up * cos
        scale = self._scale_px_m
        return np.stack([WIDTH_PX / 2 + right * scale, HEIGHT_PX / 2 - above * scale], axis=1)


QUADROTOR = Quadrotor()
