"""Embeddings of pictures that are like nothing in training are flagged, and not acted on at once.

Two statistics of the monitoring of processes tell them by their principal components: Hotelling's
T², how far an embedding is from the mean among the strongest components, each by its own variance,
and Q, how much of it lies beside these. Each may exceed its limit in half of the false alarms that
are allowed; the limits are quantiles on held-out pictures. (J. E. Jackson and G. S. Mudholkar,
Control procedures for residuals associated with principal component analysis, 1979.)

What a device itself can see to be garbage it does not embed (:mod:`hjepa_cli.core.control.spoilt`):
an encoder that fits a picture to its background sees nothing unusual in an empty one.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Bools, Integers

KEPT_VARIANCE = 0.999  # of the embeddings' variance is in the strongest components
FROZEN_STEPS = 10  # after so many, not even a device at rest looks the same to the last bit


@dataclasses.dataclass(frozen=True, eq=False)
class Familiarity:
    """Tells embeddings that are like those of training from others.

    Attributes:
        mean: of embeddings [D].
        components: orthonormal rows [N, D].
        variances: of the coefficients [N].
        limits: of T² and of Q.
    """

    mean: Tensor
    components: Tensor
    variances: Tensor
    limits: tuple[float, float]

    def statistics(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return T² and Q [n] of embeddings [n, D]."""
        apart = z.double().cpu() - self.mean
        coefficients = apart @ self.components.T
        among = (coefficients**2 / self.variances).sum(1)
        return among, (apart**2).sum(1) - (coefficients**2).sum(1)

    def strange(self, z: Tensor) -> Bools:
        """Return which embeddings [n, D] are unlike those of training: bool [n]."""
        among, beside = self.statistics(z)
        familiar = (among <= self.limits[0]) & (beside <= self.limits[1])  # NaN is not
        return np.asarray((~familiar).numpy())


def fit_familiarity(training: Tensor, held_out: Tensor, false_alarm: float) -> Familiarity:
    """Fit to embeddings [n, D], and calibrate on others [m, D] to a share of false alarms."""
    z = training.double()
    mean = z.mean(0)
    variances, vectors = torch.linalg.eigh((z - mean).T @ (z - mean) / len(z))
    variances, rows = variances.flip(0), vectors.flip(1).T
    share = variances.cumsum(0) / variances.sum()
    count = int((share < KEPT_VARIANCE).sum()) + 1
    fitted = Familiarity(mean, rows[:count], variances[:count].clamp_min(1e-12), (0.0, 0.0))
    limits = (torch.quantile(of, 1 - false_alarm / 2) for of in fitted.statistics(held_out))
    among, beside = (float(limit) for limit in limits)
    return dataclasses.replace(fitted, limits=(among, beside))


class PacketCheck:
    """Keeps flagged packets of n devices back from a controller, but not too many in a row.

    Besides strange embeddings those are flagged that are those of the packet before, bit for bit,
    though time has passed: of a camera that is frozen.

    Attributes:
        now: of which devices a packet was flagged in this step [n].
        received, flagged: how many packets there were of each device, and how many flagged [n].
    """

    def __init__(self, familiarity: Familiarity, limit: int, devices: int) -> None:
        self._familiarity, self._limit = familiarity, limit
        self._in_row = np.zeros(devices, np.int64)
        self._last: Tensor | None = None
        self._heard_at = np.full(devices, -1)
        self._k = -1
        self.now = np.zeros(devices, bool)
        self.received, self.flagged = np.zeros((2, devices), np.int64)

    def pass_on(
        self, delivered: Bools, packets: Tensor | None, ages: Integers | None
    ) -> tuple[Bools, Tensor | None, Integers | None]:
        """Take what arrives in a step, and return what the controller shall act on.

        A device's first packet is passed on whatever is in it, and so is one after ``limit``
        flagged ones in a row: then the world has changed, and old predictions are worse. One that
        holds nothing, NaN, never is.
        """
        self._k += 1
        self.now[:] = False
        if packets is None:
            return delivered, packets, ages
        rows = np.flatnonzero(delivered)
        at = torch.from_numpy(rows)
        if self._last is None:
            self._last = packets.new_zeros(len(delivered), packets.shape[1])
        first = self._heard_at[rows] < 0
        same = (packets == self._last[at]).all(1).cpu().numpy()
        same &= ~first & (self._k - self._heard_at[rows] >= FROZEN_STEPS)
        flagged = self._familiarity.strange(packets) | same
        full = packets.isfinite().all(1).cpu().numpy()
        self._last[at], self._heard_at[rows[full]] = packets, self._k
        self._in_row[rows] = np.where(flagged, self._in_row[rows] + 1, 0)
        self.now[rows] = flagged
        self.received[rows] += 1
        self.flagged[rows] += flagged
        kept = (~flagged | first | (self._in_row[rows] > self._limit)) & full
        passed = np.zeros_like(delivered)
        passed[rows[kept]] = True
        ages = None if ages is None else ages[kept]
        return passed, packets[torch.from_numpy(kept)] if kept.any() else None, ages
