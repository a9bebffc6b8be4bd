"""Two levels that disagree about where a device is tell how uncertain it is, without a packet.

The hierarchy reaches the same step by different strides: P^H in one of h steps, the predictor of
stride 1 in h of one. Played with the same forces from the same packet they drift apart as their
models err, and the drift d = |C(z̃) − C(ẑ)| ÷ the force range is known without a look at the
device. The value that the growth table has for a device's age is scaled by it:

    f(A, d) = f(A) (d / d̄(A))^(2β),

with d̄(A) the geometric mean over devices and β the slope of ln |error| over ln d at equal ages.
β = 0 is the growth table itself.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.controllers import StrideController
from hjepa_cli.core.control.error_growth import ErrorGrowthTable, conformal_growth
from hjepa_cli.core.control.force_error import control_error

SMALLEST = 1e-5  # of the force range: levels that agree better have nothing to tell


class TwoLevels:
    """Plays strides of P^H with a controller, and the level of stride 1 beside it.

    That one, ``step``, goes from embeddings [n, D] under forces_n [n, *A] to embeddings, and plays
    no force; the actor ``act`` would answer embeddings [n, D] with forces_n [n, *A].
    """

    def __init__(
        self,
        controller: StrideController,
        step: Callable[[Tensor, Tensor], Tensor],
        act: Callable[[Tensor], Tensor],
        force_limit_n: float,
    ) -> None:
        self._controller, self._step, self._act = controller, step, act
        self._limit_n = force_limit_n
        self._beside = torch.zeros(0, 0)
        self._apart = np.zeros(0)

    @torch.inference_mode()
    def act(self, delivered: Bools, packets: Any, ages: Integers | None = None) -> Floats:
        """Return the controller's forces [n, *A], and let the second level follow them."""
        forces_n = self._controller.act(delivered, packets, ages)
        if not len(self._apart):
            self._apart = np.zeros(len(delivered))
        taken, (starts, _, _) = self._controller.taken, self._controller.belief
        if taken.any():
            if not len(self._beside):
                self._beside = torch.zeros_like(starts)
            rows = torch.from_numpy(taken)
            self._beside[rows] = starts[rows]  # the packets, at the present
            self._apart[taken] = 0.0
        if not len(self._beside):
            return forces_n  # late packets: nobody has been heard yet
        self._beside = self._step(self._beside, torch.from_numpy(forces_n).float())
        over, reached = self._controller.reached
        if over.any():
            rows = torch.from_numpy(np.flatnonzero(over))
            forces = [self._act(z[rows]).float().cpu().numpy() for z in (reached, self._beside)]
            apart = control_error(forces[0], forces[1], self._limit_n)
            self._apart[over] = apart.reshape(len(rows), -1).mean(axis=1)
        return forces_n

    def planned_n(self) -> Floats:
        """Return the controller's forces [n, *A] of the coming step if no packet comes."""
        return self._controller.planned_n()

    def ahead_n(self) -> Floats:
        """Return what the controller plans [n, L, *A]."""
        return self._controller.ahead_n()

    @property
    def stride_steps(self) -> int:
        """Return what the controller's strides take."""
        return self._controller.stride_steps

    @property
    def moves_on(self) -> bool:
        """Return whether the controller can move late packets on."""
        return self._controller.moves_on

    @property
    def apart(self) -> Floats:
        """Return how far the levels were apart when each device's last stride ended: d [n]."""
        return self._apart


@dataclasses.dataclass(frozen=True, eq=False)
class LevelDisagreement:
    """Scales a growth table f(A) by how far each device's levels disagree.

    ``mean_apart`` holds d̄(1) … d̄(A_max); the ``exponent`` β lies in 0 … 1.
    """

    growth: ErrorGrowthTable
    mean_apart: Floats
    exponent: float

    def relative_growth(self, age: ArrayLike, apart: Floats) -> Floats:
        """Return f(A, d) ÷ f(A) of devices at ages A ≥ 1 whose levels are d apart."""
        place = np.minimum(np.asarray(age, np.int64), len(self.mean_apart)) - 1
        relative = np.maximum(apart, SMALLEST) / self.mean_apart[place]
        return np.asarray(relative ** (2.0 * self.exponent))


def calibrate_levels(ages: Sequence[int], errors: Floats, apart: Floats) -> LevelDisagreement:
    """Fit d̄ and β on half of the devices, and the growth table of what is left on the other half.

    So the split-conformal promise holds for f(A, d): a new device of the same kind stays below
    √f(A, d) with the table's probability. Arguments are those of
    :func:`~hjepa_cli.core.control.error_growth.conformal_growth`, and d of the same devices at the
    same ages, ``apart`` [n, G].
    """
    half = len(errors) // 2
    d = np.log(np.maximum(apart, SMALLEST))
    error = np.log(np.maximum(errors, SMALLEST))
    centre = d[:half].mean(axis=0)
    spread, met = d[:half] - centre, error[:half] - error[:half].mean(axis=0)
    exponent = float(np.clip((spread * met).sum() / max((spread**2).sum(), 1e-12), 0.0, 1.0))
    mean_apart = np.exp(np.interp(np.arange(1, ages[-1] + 1), ages, centre))
    scaled = errors[half:] / np.exp(exponent * (d[half:] - centre))
    return LevelDisagreement(conformal_growth(ages, scaled), mean_apart, exponent)
