"""How fast a controller's error grows while no packet arrives, and what a packet is worth then.

f(A) is a table over the age A = 1 … A_max of the newest sample: the squared error of the force,
|C(z̃) − C(z)| ÷ 40 N, that a share p of devices stays below. The quantile is split-conformal, so a
new device of the same kind stays below it with probability p whatever the distribution; the table
is made monotone from below, so that it keeps that promise.
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
class Growth:
    """f over ages: 0 at age 0, constant beyond the last.

    Attributes:
        table: f(1) … f(A_max), not falling.
    """

    table: Floats

    def at(self, age: ArrayLike) -> Floats:
        """f(A) for ages ≥ 1."""
        return np.asarray(self.table[self._place(age)])

    def index(self, age: ArrayLike) -> Floats:
        """Whittle's index with certain success: A f(A + 1) − Σ_{j=1..A} f(j); not falling in A."""
        age = np.asarray(age, np.int64)
        place = self._place(age)
        # Beyond the table f stays at its last value, and the index with it.
        spent = np.cumsum(self.table)[place]
        return np.asarray((place + 1) * self.table[self._place(age + 1)] - spent)

    def _place(self, age: ArrayLike) -> NDArray[np.int64]:
        return np.minimum(np.asarray(age, np.int64), len(self.table)) - 1


def conformal_growth(ages: Sequence[int], errors: Floats, coverage: float = COVERAGE) -> Growth:
    """Calibrate a growth table on held-out devices.

    Args:
        ages: ascending ages ≥ 1 [G] that errors were measured at; in between f is interpolated.
        errors: absolute errors [n, G] of n devices without a packet since age 0.
        coverage: p; the rank ⌈(n + 1) p⌉ of n errors is the split-conformal quantile.

    Raises:
        UsageError: fewer devices than p needs.
    """
    count = len(errors)
    rank = math.ceil((count + 1) * coverage)
    if rank > count:
        raise UsageError(
            f"{count} devices cannot calibrate a quantile of {coverage:g}; "
            f"use {math.ceil(coverage / (1 - coverage) - 1e-9)} or more"
        )
    quantile = np.sort(errors, axis=0)[rank - 1]
    monotone = np.maximum.accumulate(quantile)  # pooling ages would lower some of them
    every = np.arange(1, ages[-1] + 1)
    return Growth(np.interp(every, [0, *ages], [0.0, *monotone]) ** 2)


def periodic_cost(schedule: Sequence[int], costs: Sequence[Floats]) -> float:
    """Mean cost per slot of loops that share one channel by a schedule repeated forever.

    Args:
        schedule: which loop sends in each slot of a period.
        costs: per loop, its cost in a slot by the age of its newest sample, from age 0 on.

    Returns:
        Sum over loops of the mean cost; ∞ where a loop never sends or an age leaves its table.
    """
    period, total = len(schedule), 0.0
    for loop, table in enumerate(costs):
        turns = [slot for slot in range(period) if schedule[slot] == loop]
        if not turns:
            return math.inf
        ages = [min((slot - turn) % period for turn in turns) for slot in range(period)]
        if max(ages) >= len(table):
            return math.inf
        total += sum(float(table[age]) for age in ages) / period
    return total
