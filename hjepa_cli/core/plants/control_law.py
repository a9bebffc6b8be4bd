"""A control law may be data: the one that models learn and that their rivals play.

A teacher that is right with a packet at every step is slow where packets are sparse. The law that
``hjepa tune-law`` finds instead is linear, u = −K x, clipped to the force limit.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.config.schema import ControlSettings
from hjepa_cli.core.arrays import Floats, finite
from hjepa_cli.core.plants.linear import linearise
from hjepa_cli.core.plants.system import System, Teacher
from hjepa_cli.errors import DataError, UsageError


@dataclasses.dataclass(frozen=True, eq=False)
class LinearLaw:
    """The law u = −K x, clipped to the force limit.

    Attributes:
        gains_n: K [..., F, S], newton per unit of state; leading axes are those of many laws, which
            broadcast with those of the states.
        force_limit_n: of the plant.
        action_shape: A of the plant, of F forces.
    """

    gains_n: Floats
    force_limit_n: float
    action_shape: tuple[int, ...]

    def __call__(self, states: ArrayLike) -> Floats:
        """Return forces_n [..., *A] of states [..., S]."""
        # A sum of products, not a matrix product: a state's force must not depend on its batch.
        forces_n = -(self.gains_n * finite(states, "states")[..., None, :]).sum(axis=-1)
        forces_n = forces_n.clip(-self.force_limit_n, self.force_limit_n)
        return np.asarray(forces_n.reshape((*forces_n.shape[:-1], *self.action_shape)))


def control_law(kind: System, control: ControlSettings) -> Teacher:
    """Return the law that models of a plant learn: the settings', or the plant's own teacher.

    Raises:
        UsageError: the gains are not as many as the plant has states and forces.
    """
    return _linear(kind, "gains_n", control.gains_n) if control.gains_n else kind.teacher()


def ceiling_law(kind: System, control: ControlSettings) -> Teacher:
    """Return the law of method ``ceiling``, which no actor has to learn.

    Raises:
        UsageError: there is none, or its gains are not as many as they should be.
    """
    if not control.ceiling_gains_n:
        raise UsageError(
            f"method 'ceiling' needs a law tuned for plant {kind.name}",
            hint=f"hjepa tune-law --plant {kind.name}, then --config its law.toml",
        )
    return _linear(kind, "ceiling_gains_n", control.ceiling_gains_n)


def control_of(settings: Mapping[str, Any], where: object) -> ControlSettings:
    """Return the law in the settings of a dataset or a checkpoint; none in those without one.

    Raises:
        DataError: it is no law; the message names the file, ``where``.
    """
    try:
        return msgspec.convert(settings.get("control", {}), ControlSettings, strict=True)
    except (msgspec.ValidationError, AttributeError) as flaw:
        raise DataError(f"{where} holds no valid control law: {flaw}") from None


def check_stable(kind: System, gains_n: Floats, key: str) -> None:
    """Raise UsageError unless a law K [F, S] holds a plant at rest, heard at every step."""
    if flaw := instability(kind, gains_n):
        hint = f"hjepa tune-law --plant {kind.name}"
        raise UsageError(f"{key} {flaw}", hint=hint, key=key)


def instability(kind: System, gains_n: Floats) -> str | None:
    """Say how a law K [F, S], heard at every step, fails to hold a plant at rest, if it does."""
    states = len(kind.state_names)
    a, b = linearise(kind.advance, np.zeros(states), np.zeros(kind.action_shape))
    growth = np.abs(np.linalg.eigvals(a - b @ gains_n)).max()
    if growth < 1:
        return None
    return (
        f"does not hold plant {kind.name}: near rest a deviation grows by a factor of "
        f"{growth:.4f} a step"
    )


def _linear(kind: System, key: str, gains_n: tuple[float, ...]) -> LinearLaw:
    forces, states = len(kind.force_signs), len(kind.state_names)
    if len(gains_n) != forces * states:
        raise UsageError(
            f"control.{key} has {len(gains_n)} numbers; plant {kind.name} needs {forces * states}, "
            f"one for each of {', '.join(kind.state_names)}" + (" and force" if forces > 1 else ""),
            hint=f"hjepa tune-law --plant {kind.name}",
            key=f"control.{key}",
        )
    gains = np.reshape(gains_n, (forces, states))
    check_stable(kind, gains, f"control.{key}")
    return LinearLaw(gains, kind.force_limit_n, kind.action_shape)
