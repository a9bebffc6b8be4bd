"""A controller's error grows while no packet arrives: this measures it, and a packet's worth then.

f(A) is a table over the age A = 1 … A_max of the newest sample: the squared error of the force,
|C(z̃) − C(z)| ÷ the force range, that a share p of devices stays below. The quantile is
split-conformal, so a new device of the same kind stays below it with probability p whatever the
distribution; the table is made monotone from below, so that it keeps that promise.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.arrays import Floats
from hjepa_cli.errors import UsageError

COVERAGE = 0.9


@dataclasses.dataclass(frozen=True, eq=False)
class ErrorGrowthTable:
    """Tabulates f over ages: 0 at age 0, constant beyond the last.

    Attributes:
        table: f(1) … f(A_max), not falling.
    """

    table: Floats

    def at(self, age: ArrayLike) -> Floats:
        """Return f(A) for ages A ≥ 1."""
        return np.asarray(self.table[self._place(age)])

    def index(self, age: ArrayLike) -> Floats:
        """Return Whittle's index with certain success, A f(A + 1) − Σ_{j=1..A} f(j).

        It does not fall in A.
        """
        age = np.asarray(age, np.int64)
        place = self._place(age)
        # Beyond the table f stays at its last value, and the index with it.
        spent = np.cumsum(self.table)[place]
        return np.asarray((place + 1) * self.table[self._place(age + 1)] - spent)

    def _place(self, age: ArrayLike) -> NDArray[np.int64]:
        return np.minimum(np.asarray(age, np.int64), len(self.table)) - 1


def conformal_growth(
    ages: Sequence[int], errors: Floats, coverage: float = COVERAGE
) -> ErrorGrowthTable:
    """Calibrate a growth table on n held-out devices without a packet since age 0.

    Args:
        ages: ascending ages ≥ 1 [G] that errors were measured at; in between f is interpolated.
        errors: absolute errors [n, G].
        coverage: p; the rank ⌈(n + 1) p⌉ of n errors is the split-conformal quantile.

    Raises:
        UsageError: fewer devices than p needs.
    """
    count = len(errors)
    rank = math.ceil((count + 1) * coverage - 1e-9)  # a whole number up to rounding is that one
    if rank > count:
        raise UsageError(
            f"{count} devices cannot calibrate a quantile of {coverage:g}; "
            f"use {math.ceil(coverage / (1 - coverage) - 1e-9)} or more"
        )
    quantile = np.sort(errors, axis=0)[rank - 1]
    monotone = np.maximum.accumulate(quantile)  # pooling ages would lower some of them
    every = np.arange(1, ages[-1] + 1)
    return ErrorGrowthTable(np.interp(every, [0, *ages], [0.0, *monotone]) ** 2)
