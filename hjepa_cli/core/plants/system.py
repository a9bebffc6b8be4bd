"""A plant has a state, a step, a camera and a teacher; all else works with any that has them.

There are n devices with S states each; A stands for ``action_shape``, which is ``()`` where one
force drives a device and ``(m,)`` where m forces do. So ``[n, *A]`` is ``[n]`` or ``[n, m]``.
"""

import abc
import math
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.core.arrays import Bools, Floats, described, finite
from hjepa_cli.core.plants.answers import look_at
from hjepa_cli.core.plants.frames import Camera
from hjepa_cli.core.plants.linear import linearise, unstable_rate_rad_s
from hjepa_cli.errors import ArrayError, UsageError
from hjepa_cli.plugins import check_members

Teacher = Callable[[ArrayLike], Floats]


class Simulation(Protocol):
    """A simulation moves n devices of a system together."""

    @property
    def states(self) -> Floats:
        """Return the states ``[n, S]``, which can be set too."""

    @states.setter
    def states(self, states: ArrayLike) -> None: ...

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step under forces ``[n, *A]``, clipped to the limit; no noise."""


class Integrated:
    """It simulates a system by its own equations.

    ``advance`` makes a step of states ``[n, S]`` under forces ``[n, *A]`` with mass factors
    ``[n, 2]``, 1 where ``mass_scale`` is ``None``.

    Raises:
        UsageError: no devices, or factors that are not positive.
        NumericalError: states are set, or forces applied, that are not finite.
    """

    def __init__(
        self,
        system: "System",
        advance: Callable[[Floats, Floats, Floats], Floats],
        devices: int,
        mass_scale: ArrayLike | None = None,
    ) -> None:
        self._system, self._advance = system, advance
        self._mass_scale = check_masses(devices, mass_scale)
        self._states = np.zeros((devices, len(system.state_names)))

    @property
    def states(self) -> Floats:
        """Return the states ``[n, S]``."""
        return self._states.copy()

    @states.setter
    def states(self, states: ArrayLike) -> None:
        self._states = check_states(states, self._states.shape).copy()

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step."""
        limit_n = self._system.force_limit_n
        applied_n = np.clip(finite(forces_n, "forces_n"), -limit_n, limit_n)
        self._states = self._advance(self._states, applied_n, self._mass_scale)


def runge_kutta_step(rate: Callable[[Floats], Floats], states: Floats, duration_s: float) -> Floats:
    """Return states ``[..., S]`` after one classical fourth-order step.

    ``rate`` maps states to their time derivative, under whatever is held.
    """
    a = rate(states)
    b = rate(states + duration_s / 2 * a)
    c = rate(states + duration_s / 2 * b)
    d = rate(states + duration_s * c)
    return np.asarray(states + duration_s / 6 * (a + 2 * b + 2 * c + d))


def check_states(states: ArrayLike, shape: tuple[int, ...], name: str = "states") -> Floats:
    """Return states, called so in messages, as float64.

    Raises:
        ArrayError: their shape is another one.
        NumericalError: one is not finite.
    """
    checked = finite(states, name)
    if checked.shape != shape:
        raise ArrayError(f"{name}: shape {checked.shape}, not {shape}; it is {described(checked)}")
    return checked


def check_rows(states: ArrayLike, names: tuple[str, ...]) -> Floats:
    """Return states ``[n, S]``, as named, as float64; errors as of :func:`check_states`."""
    checked = finite(states, "states")
    if checked.ndim != 2 or checked.shape[1] != len(names):
        raise ArrayError(
            f"states: shape {checked.shape}, not (n, {len(names)}): {', '.join(names)}; they are "
            f"{described(checked)}"
        )
    return checked


def check_masses(devices: int, mass_scale: ArrayLike | None) -> Floats:
    """Return mass factors ``[devices, 2]``, all 1 for ``None``.

    Raises:
        UsageError: no devices, or factors that are not positive.
    """
    if devices < 1:
        raise UsageError(f"devices = {devices}; a simulation needs at least 1")
    scale = np.ones((devices, 2)) if mass_scale is None else np.asarray(mass_scale, float)
    if scale.shape != (devices, 2) or not (np.isfinite(scale) & (scale > 0)).all():
        raise UsageError(f"mass_scale must be {devices} × 2 positive factors")
    return scale


class System(abc.ABC):
    """A kind of plant has a teacher, a camera and a score; states have any leading axes.

    Attributes:
        name: as in ``--plant``.
        step_s: a control step, and a radio slot.
        force_limit_n: every force lies within ± this [N]; models see forces divided by it. A system
            driven by torques takes them as forces on a lever.
        state_names: of the S states, a position before its velocity; probes and gates go by them.
        state_units: of the S states.
        action_shape: A; ``()`` for one force.
        mirror: what a mirrored picture does to the forces: a factor for each.
    """

    name: str
    step_s: float
    force_limit_n: float
    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    action_shape: ClassVar[tuple[int, ...]] = ()
    mirror: ClassVar[float | tuple[float, ...]] = -1.0

    def __init_subclass__(cls, **named: Any) -> None:
        """Let what classes from outside of the package answer be looked at."""
        super().__init_subclass__(**named)
        if not cls.__module__.startswith("hjepa_cli."):
            look_at(cls)

    @abc.abstractmethod
    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> Simulation:
        """Return ``devices`` of them at rest; ``mass_scale`` ``[n, 2]`` are factors on two masses.

        Raises:
            UsageError: no devices, or factors that are not positive.
        """

    @abc.abstractmethod
    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """Return states ``[..., S]`` one control step on under forces ``[..., *A]``, exactly.

        Raises:
            NumericalError: a state or a force is not finite.
        """

    @abc.abstractmethod
    def teacher(self) -> Teacher:
        """Return what to learn from, a function of states ``[..., S]``: forces_n ``[..., *A]``."""

    @abc.abstractmethod
    def camera(self) -> Camera:
        """Return the camera that looks at it."""

    @abc.abstractmethod
    def in_band(self, states: Floats) -> Bools:
        """Score a step: say whether states ``[..., S]`` are where they should be, ``[...]``."""

    @abc.abstractmethod
    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Return a step's quadratic cost; see :func:`hjepa_cli.core.plants.cost.stage_cost`."""

    def fallen(self, states: Floats) -> Bools:
        """Say which states ``[..., S]`` no force brings back, ``[...]``: a loop there is over.

        It does not have to name them all, and by default names none.
        """
        return np.zeros(states.shape[:-1], bool)

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """Return the states ``[..., S]`` whose pictures are those of ``states``, moved right.

        Training needs it to move pictures (``shift_px``) and to ask the teacher what it would do
        there.

        Raises:
            UsageError: this plant looks different elsewhere, or does not say.
        """
        raise UsageError(
            f"plant {self.name} does not say what moving its picture sideways means",
            hint="set shift_px = 0 in [encoder], or write System.sideways",
        )

    def with_pole_length(self, scale: float) -> "System":
        """Return the same plant with a pole ``scale`` times as long.

        Raises:
            UsageError: it has none.
        """
        raise UsageError(
            f"conditions.pole_length = {scale:g}; plant {self.name} has no pole: leave it at 1",
            key="conditions.pole_length",
        )

    def check_members(self) -> None:
        """Raise UsageError for members that are of another kind, or that do not go together."""
        check_members(self, tuple, "state_names", "state_units", "action_shape")
        check_members(self, (int, float), "step_s", "force_limit_n")
        names, words = self.state_names, all(isinstance(name, str) for name in self.state_names)
        sizes = all(isinstance(size, int) and size > 0 for size in self.action_shape)
        for name, fits, wanted in (
            ("step_s", 0 < self.step_s < math.inf, "more than 0"),
            ("force_limit_n", 0 < self.force_limit_n < math.inf, "more than 0"),
            ("state_names", words and 0 < len(names) == len(set(names)), "a name for each state"),
            ("action_shape", sizes and len(self.action_shape) < 2, "() or (m,)"),
            ("mirror", {*np.ravel(self.mirror).tolist()} <= {1, -1}, "1 or -1 for each force"),
        ):
            if not fits:
                says = f"{name} = {getattr(self, name)!r}; expected {wanted}"
                raise UsageError(f"plant '{self.name}': {says}")
        for one, other, counts in (
            ("state_names", "state_units", (len(self.state_names), len(self.state_units))),
            ("action_shape", "mirror", (math.prod(self.action_shape), np.size(self.mirror))),
        ):
            if counts[0] != counts[1]:
                raise UsageError(
                    f"plant '{self.name}': {one} is for {counts[0]} values, {other} for {counts[1]}"
                )

    @property
    def unstable_rate_rad_s(self) -> float:
        """Return λ, the sum of the unstable poles at rest [rad/s], from the exact equations."""
        still = np.zeros(len(self.state_names)), np.zeros(self.action_shape)
        return unstable_rate_rad_s(linearise(self.advance, *still)[0], self.step_s)

    @property
    def data_rate_limit_bits_per_s(self) -> float:
        """Return λ/ln 2: no controller stabilises it from fewer bit/s (data-rate theorem)."""
        return self.unstable_rate_rad_s / math.log(2)

    @property
    def force_signs(self) -> tuple[float, ...]:
        """Return :attr:`mirror` as one factor for each force."""
        return tuple(np.ravel(self.mirror).tolist())

    def no_force(self, devices: int) -> Floats:
        """Return forces that do nothing to ``devices`` devices, ``[n, *A]``."""
        return np.zeros((devices, *self.action_shape))
