"""A control law may be data: the one that models learn and that their rivals play.

A teacher that is right with a packet at every step is slow where packets are sparse. What
``hjepa tune-law`` finds instead has two parts: one that turns a device quickly, and one that brings
it back slowly, of which no more than a cap is ever asked at once,

    u = −(clip(S x, ±c) + F x), clipped to the force limit.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from hjepa_cli.config.schema import ControlSettings
from hjepa_cli.core.arrays import Floats, finite
from hjepa_cli.core.plants.system import System, Teacher
from hjepa_cli.errors import DataError, UsageError


@dataclasses.dataclass(frozen=True, eq=False)
class CappedLaw:
    """The law u = −(clip(S x, ±c) + F x), clipped to the force limit.

    Attributes:
        slow: S [..., F, S], newton per unit of state; leading axes are those of many laws at once.
        fast: F [..., F, S].
        cap_n: c [..., F].
        force_limit_n: of the plant.
        action_shape: A of the plant, of F forces.
    """

    slow: Floats
    fast: Floats
    cap_n: Floats
    force_limit_n: float
    action_shape: tuple[int, ...]

    def __call__(self, states: ArrayLike) -> Floats:
        """Return forces_n [..., *A] of states [..., S]."""
        at = finite(states, "states")[..., None, :]
        # Sums of products, not matrix products: a state's force must not depend on its batch.
        slow_n, fast_n = (gains * at for gains in (self.slow, self.fast))
        asked_n = slow_n.sum(axis=-1).clip(-self.cap_n, self.cap_n) + fast_n.sum(axis=-1)
        forces_n = -asked_n.clip(-self.force_limit_n, self.force_limit_n)
        return np.asarray(forces_n.reshape(*forces_n.shape[:-1], *self.action_shape))


def control_law(kind: System, control: ControlSettings) -> Teacher:
    """Return the law that models of a plant learn: the settings', or the plant's own teacher.

    Raises:
        UsageError: the numbers are not as many as the plant has states and forces.
    """
    numbers = control.slow_gains, control.fast_gains, control.cap_n
    return _capped(kind, "", *numbers) if any(numbers) else kind.teacher()


def ceiling_law(kind: System, control: ControlSettings) -> Teacher:
    """Return the law of method ``ceiling``, which no actor has to learn.

    Raises:
        UsageError: there is none, or its numbers are not as many as they should be.
    """
    numbers = control.ceiling_slow_gains, control.ceiling_fast_gains, control.ceiling_cap_n
    if not any(numbers):
        raise UsageError(
            f"method 'ceiling' needs a law tuned for plant {kind.name}",
            hint=f"hjepa tune-law --plant {kind.name}, then --config its law.toml",
        )
    return _capped(kind, "ceiling_", *numbers)


def control_of(settings: Mapping[str, Any], where: object) -> ControlSettings:
    """Return the law in the settings of a dataset or a checkpoint; none in those without one.

    Raises:
        DataError: it is no law; the message names the file, ``where``.
    """
    try:
        return msgspec.convert(settings.get("control", {}), ControlSettings, strict=True)
    except (msgspec.ValidationError, AttributeError) as flaw:
        raise DataError(f"{where} holds no valid control law: {flaw}") from None


def _capped(
    kind: System,
    prefix: str,
    slow: tuple[float, ...],
    fast: tuple[float, ...],
    cap_n: tuple[float, ...],
) -> CappedLaw:
    states, forces = len(kind.state_names), len(kind.force_signs)
    for name, values, count in (
        ("slow_gains", slow, forces * states),
        ("fast_gains", fast, forces * states),
        ("cap_n", cap_n, forces),
    ):
        if len(values) != count:
            raise UsageError(
                f"control.{prefix}{name} has {len(values)} numbers; plant {kind.name} needs {count}",
                hint=f"hjepa tune-law --plant {kind.name}",
            )
    shape = forces, states
    gains = np.reshape(slow, shape), np.reshape(fast, shape)
    return CappedLaw(*gains, np.array(cap_n), kind.force_limit_n, kind.action_shape)
