"""Scores of the closed loop become ratios, intervals and tolerances here.

There are N devices, P curve points and B bootstrap replicates. Intervals are percentile intervals
of a bootstrap over devices; the same devices are drawn for a method and for its reference, so what
both share (a hard start, a gust) cancels.
"""

import math

import numpy as np
from scipy import special

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Floats
from hjepa_cli.errors import NumericalError

TAILS = (0.025, 0.975)  # of a 95 % interval
_BOOTSTRAP_KEY = 0xB007


def bootstrap_weights(samples: int, replicates: int, seed: int) -> Floats:
    """Return each sample's share of each bootstrap replicate: [B, N], rows sum to 1.

    ``weights @ values`` is then the mean of every replicate.
    """
    drawn = generator(seed, _BOOTSTRAP_KEY, samples).integers(samples, size=(replicates, samples))
    offsets = np.arange(replicates)[:, None] * samples
    counts = np.bincount((drawn + offsets).ravel(), minlength=replicates * samples)
    return counts.reshape(replicates, samples) / samples


def interval(replicates: Floats) -> Floats:
    """Return the 95 % percentile interval [2, ...] over the first axis of [B, ...].

    Order statistics are taken as they are, so that infinite replicates (no crossing) stay infinite.
    Undefined replicates (see :func:`ratio`) are left out.
    """
    quantile = np.nanquantile if np.isnan(replicates).any() else np.quantile  # the latter is faster
    return quantile(replicates, TAILS, axis=0, method="inverted_cdf")


def mean_interval(values: Floats, weights: Floats) -> Floats:
    """Return the interval [2, ...] of the mean of values [N, ...] with weights [B, N]."""
    return interval(np.tensordot(weights, values, axes=1))


def student_interval(values: Floats) -> Floats:
    """Return Student's 95 % interval [2, ...] of the mean over axis 0 of [n, ...], n > 1."""
    count = len(values)
    half = special.stdtrit(count - 1, TAILS[1]) * values.std(axis=0, ddof=1) / math.sqrt(count)
    return np.asarray(values.mean(axis=0) + np.multiply.outer((-1.0, 1.0), half))


def ratio(values: Floats, reference: Floats, weights: Floats | None = None) -> Floats:
    """Return the mean of values [..., N] ÷ the mean of a reference [N] on the same devices.

    It is [...], or [B, ...] with bootstrap weights [B, N], and then NaN in replicates that drew a
    reference of 0.

    Raises:
        NumericalError: the reference is 0.
    """
    mean = reference_mean(reference)
    if weights is None:
        return np.asarray(values.mean(axis=-1) / mean)
    means = weights @ reference
    means = np.where(means == 0, np.nan, means).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(np.moveaxis(values @ weights.T, -1, 0) / means)


def reference_mean(reference: Floats) -> float:
    """Return the mean that scores are normalised by.

    Raises:
        NumericalError: it is 0, and a normalised score nothing.
    """
    mean = float(reference.mean())
    if mean == 0:
        raise NumericalError(
            f"the teacher itself is never inside the band with any of {len(reference)} devices: "
            "there is nothing to normalise scores by",
            hint="start nearer or drive longer: protocol.x_m, protocol.theta_rad, protocol.steps",
        )
    return mean


def first_crossing(gaps: Floats, scores: Floats, acceptable: float, *, log: bool) -> Floats:
    """Return where each curve first falls below ``acceptable``, interpolated between its points.

    Args:
        gaps: ascending mean gaps between packets [P], in steps.
        scores: [..., P]; an undefined one (NaN) is not acceptable.
        log: interpolate linearly in ln gap (= -ln p, delivery) instead of in the gap.

    Returns:
        Gaps [...]; -inf where the first point is below already, +inf where no point is.
    """
    x = np.log(gaps) if log else np.asarray(gaps, dtype=np.float64)
    scores = np.where(np.isnan(scores), -np.inf, scores)
    below = scores < acceptable
    right = np.argmax(below, axis=-1)
    left = np.maximum(right - 1, 0)
    y_left, y_right = (
        np.take_along_axis(scores, i[..., None], axis=-1)[..., 0] for i in (left, right)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = x[left] + (x[right] - x[left]) * (y_left - acceptable) / (y_left - y_right)
    if log:
        crossing = np.exp(crossing)
    crossing = np.where(right == 0, -np.inf, crossing)
    return np.where(below.any(axis=-1), crossing, np.inf)
