"""What a plant must be for everything else to work with it: a state, a step, a camera, a teacher.

Shapes: n devices, S states; A stands for ``action_shape``, which is
``()`` where one force drives a device and ``(m,)`` where m forces do. So ``[n, *A]`` is ``[n]`` or
``[n, m]``.
"""

import abc
import json
import math
from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.arrays import Bools, Floats
from hjepa_cli.core.plants.linear import linearise, unstable_rate_rad_s
from hjepa_cli.errors import UsageError

Teacher = Callable[[ArrayLike], Floats]


class Simulation(Protocol):
    """n devices of a system, moved together."""

    @property
    def states(self) -> Floats:
        """The states ``[n, S]``, which can be set too."""
        ...

    @states.setter
    def states(self, states: ArrayLike) -> None: ...

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step under forces ``[n, *A]``, clipped to the limit; no noise."""
        ...


class Integrated:
    """A simulation by a system's own equations.

    Args:
        system: states, forces and their limit.
        advance: one step: states ``[n, S]``, forces ``[n, *A]``, mass factors ``[n, 2]``.
        devices: n, at least 1.
        mass_scale: ``[n, 2]``; ``None`` is 1.

    Raises:
        UsageError: no devices, or factors that are not positive.
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
        """The states ``[n, S]``."""
        return self._states.copy()

    @states.setter
    def states(self, states: ArrayLike) -> None:
        states = np.array(states, float)
        if states.shape != self._states.shape:
            raise ValueError(f"states have shape {states.shape}, not {self._states.shape}")
        self._states = states

    def step(self, forces_n: ArrayLike) -> None:
        """Advance by one control step."""
        limit_n = self._system.force_limit_n
        applied_n = np.clip(np.asarray(forces_n, float), -limit_n, limit_n)
        self._states = self._advance(self._states, applied_n, self._mass_scale)


def check_masses(devices: int, mass_scale: ArrayLike | None) -> Floats:
    """Mass factors ``[devices, 2]``, all 1 for ``None``.

    Raises:
        UsageError: no devices, or factors that are not positive.
    """
    if devices < 1:
        raise UsageError(f"devices = {devices}; a simulation needs at least 1")
    scale = np.ones((devices, 2)) if mass_scale is None else np.asarray(mass_scale, float)
    if scale.shape != (devices, 2) or not (np.isfinite(scale) & (scale > 0)).all():
        raise UsageError(f"mass_scale must be {devices} × 2 positive factors")
    return scale


class Camera(Protocol):
    """Sees a system from the side."""

    def render(self, states: ArrayLike) -> NDArray[np.uint8]:
        """States ``[n, S]`` → RGB frames ``[n, 64, 128, 3]``."""
        ...

    def manifest(self) -> dict[str, Any]:
        """All that fixes a picture besides the state, as plain data; ``version`` among it."""
        ...

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """A state ``[S]`` as lines through points ``[k, 2]`` (column, row) of its picture.

        Drawn over a picture to show what a controller believes; the first line is the axis whose
        lean matters.
        """
        ...


def same_camera(recorded: object, system: "System") -> bool:
    """Whether pictures are those of the system's camera, by the manifest that a file holds."""
    return bool(recorded == json.loads(json.dumps(system.camera().manifest())))


class System(abc.ABC):
    """A kind of plant, with its teacher, its camera and the score of its control.

    Everything is batched: whatever takes states takes any leading axes.

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

    extends: ClassVar[str] = "plant"

    name: str
    step_s: float
    force_limit_n: float
    state_names: ClassVar[tuple[str, ...]]
    state_units: ClassVar[tuple[str, ...]]
    action_shape: ClassVar[tuple[int, ...]] = ()
    mirror: ClassVar[float | tuple[float, ...]] = -1.0

    @abc.abstractmethod
    def simulation(self, devices: int, *, mass_scale: ArrayLike | None = None) -> Simulation:
        """``devices`` of them, at rest; ``mass_scale`` ``[n, 2]`` are factors on two masses each.

        Raises:
            UsageError: no devices, or factors that are not positive.
        """

    @abc.abstractmethod
    def advance(self, states: Floats, forces_n: Floats) -> Floats:
        """Exact equations of one control step: states ``[..., S]``, forces ``[..., *A]``."""

    @abc.abstractmethod
    def teacher(self) -> Teacher:
        """The controller to learn from: states ``[..., S]`` → forces ``[..., *A]`` in N."""

    @abc.abstractmethod
    def camera(self) -> Camera:
        """The camera that looks at it."""

    @abc.abstractmethod
    def in_band(self, states: Floats) -> Bools:
        """Score of a step: whether states ``[..., S]`` are where they should be, ``[...]``."""

    @abc.abstractmethod
    def cost(self, states: Floats, forces_n: Floats) -> Floats:
        """Quadratic cost of a step, capped; see :func:`hjepa_cli.core.plants.cost.stage_cost`."""

    def sideways(self, states: Floats, shift_px: ArrayLike) -> Floats:
        """States ``[..., S]`` whose pictures are those of ``states``, moved right by ``[...]`` px.

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
        """The same plant with a pole ``scale`` times as long.

        Raises:
            UsageError: it has none.
        """
        raise UsageError(
            f"conditions.pole_length = {scale:g}; plant {self.name} has no pole: leave it at 1"
        )

    @property
    def unstable_rate_rad_s(self) -> float:
        """λ, the sum of the unstable poles at rest [rad/s], from the exact equations."""
        still = np.zeros(len(self.state_names)), np.zeros(self.action_shape)
        return unstable_rate_rad_s(linearise(self.advance, *still)[0], self.step_s)

    @property
    def data_rate_limit_bits_per_s(self) -> float:
        """λ/ln 2: no controller stabilises it from fewer bit/s (data-rate theorem)."""
        return self.unstable_rate_rad_s / math.log(2)

    @property
    def force_signs(self) -> tuple[float, ...]:
        """:attr:`mirror` as one factor for each force."""
        return tuple(np.ravel(self.mirror).tolist())

    def no_force(self, devices: int) -> Floats:
        """Forces of ``devices`` devices that do nothing, ``[n, *A]``."""
        return np.zeros((devices, *self.action_shape))
