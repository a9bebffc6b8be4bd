"""Inverse dynamics tell which action leads from which picture to which.

A picture, the one before it and the two after it show how the motion changes between picture j and
picture j + 1, so the action that did that is read off them best. Actions of other rows are read off
the same pictures; the row that fits best is where the action belongs. A law that sees the pictures
makes neighbouring actions look alike. So does a plant whose speed changes at once, or only after
the step: four pictures show two of its actions whole. Three would not, and see too little where
forces move things by hundredths of a pixel. So the test decides only where one row fits clearly
better and the stated one does not fit about as well.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Floats, Pixels

WIDEST = 3  # rows, of an offset that is looked for
DEGREE = 4  # of the moments of a picture, in all
FEATURES = 128  # random ones
FOLDS = 4
CLEARLY = 0.85  # of the error that is left at the stated offset
ALIKE = 0.75  # of the best R²: rows from there on fit about as well
LEAST_R2 = 0.05  # below, pictures do not show any action
KEY = 0xA116
RIDGES = (1e-6, 1e-4, 1e-2, 1.0)
LEAST_ROWS = 200
TINY = 1e-9


@dataclasses.dataclass(frozen=True)
class Verdict:
    """It says which offset fits best.

    Attributes:
        r2: held-out R² of the action, by offset relative to the stated one.
        best: the one with the largest.
        clear: whether it fits clearly better than the stated one, and than those around it.
    """

    r2: dict[int, float]
    best: int
    clear: bool

    @property
    def alike(self) -> list[int]:
        """Return the offsets that fit about as well as the best one."""
        return [offset for offset, r2 in self.r2.items() if r2 >= ALIKE * self.r2[self.best]]


def judge(frames: Sequence[Pixels], actions: Sequence[Floats]) -> Verdict | None:
    """Compare offsets on some trajectories.

    Args:
        frames: of each, uint8 [R, H, W, C].
        actions: of each, [R, A]; row j is said to lead from picture j to j + 1.

    Returns:
        The verdict; ``None`` where there are too few rows, or actions do not vary.
    """
    small = [_moments(some) for some in frames]
    reach = WIDEST + 2
    windows, targets, groups = [], [], []
    for number, (pictures, moved) in enumerate(zip(small, actions, strict=True)):
        at = np.arange(reach, len(pictures) - reach)
        windows += [pictures[at[:, None] + np.arange(-1, 3)]]
        targets += [moved[at[:, None] + np.arange(-WIDEST, WIDEST + 1)]]
        groups += [np.full(len(at), number)]
    x, y, group = (np.concatenate(parts) for parts in (windows, targets, groups))
    if len(x) < LEAST_ROWS or not y.std(axis=(0, 1)).all():
        return None
    if len(small) < FOLDS:
        group = np.arange(len(x)) * FOLDS // len(x)
    features = _features(x)
    flat = y.reshape(len(y), -1)
    spread = ((flat - flat.mean(axis=0)) ** 2).reshape(y.shape).sum(axis=0)
    left = np.zeros_like(spread)
    for fold in range(FOLDS):
        test = group % FOLDS == fold
        weights = _ridge(features[~test], flat[~test] - flat[~test].mean(axis=0))
        miss = flat[test] - flat[~test].mean(axis=0) - features[test] @ weights
        left += (miss**2).reshape(-1, *y.shape[1:]).sum(axis=0)
    return decided((left / spread).mean(axis=-1), left.sum(axis=-1))


def decided(errors: Floats, plain: Floats) -> Verdict:
    """Return the verdict on what is left at each offset, as a share of the spread and in all."""
    place = int(np.argmin(errors))
    # A peak, whether or not actions fade from the first rows of an episode to its last.
    peak = 0 < place < 2 * WIDEST and place == int(np.argmin(plain))
    fits, stated = 1 - errors[place], 1 - errors[WIDEST]
    apart = errors[place] < CLEARLY * errors[WIDEST] and stated < ALIKE * fits
    r2 = {offset - WIDEST: float(1 - error) for offset, error in enumerate(errors)}
    return Verdict(r2, place - WIDEST, bool(peak and apart and fits >= LEAST_R2))


def _moments(frames: Pixels) -> Floats:
    """Return Legendre moments [R, M] of pictures, up to a total degree.

    Those of first order are where things are: linear in their place, however little they move.
    """
    grey = frames.astype(np.float32).mean(axis=-1)
    bases = [
        np.polynomial.legendre.legvander(np.linspace(-1, 1, side), DEGREE)
        for side in grey.shape[1:]
    ]
    down, across = np.indices((DEGREE + 1, DEGREE + 1)).reshape(2, -1)
    kept = down + across <= DEGREE
    moments = np.einsum("rhw,hi,wj->rij", grey, *bases, optimize=True)
    return np.asarray(moments[:, down[kept], across[kept]], dtype=np.float64)


def _features(windows: Floats) -> Floats:
    """Return features [N, F] of windows of four pictures [N, 4, M]: linear ones and random ones."""
    parts = [windows[:, 1], *np.diff(windows, axis=1).transpose(1, 0, 2)]
    linear = np.concatenate(parts, axis=1)
    linear = (linear - linear.mean(axis=0)) / (linear.std(axis=0) + TINY)
    draws = generator(0, KEY)
    mixed = linear @ draws.standard_normal((linear.shape[1], FEATURES)) / linear.shape[1] ** 0.5
    random = np.maximum(mixed + draws.standard_normal(FEATURES), 0)
    return np.concatenate([linear, random - random.mean(axis=0)], axis=1)


def _ridge(x: Floats, y: Floats) -> Floats:
    """Return weights [F, A] of least squares, of the ridge that leaves the least held out."""
    half = np.arange(len(x)) % 2 == 0
    tried = []
    for ridge in RIDGES:
        miss = y[~half] - x[~half] @ _solved(x[half], y[half], ridge)
        tried.append(((miss**2).sum(), ridge))
    return _solved(x, y, min(tried)[1])


def _solved(x: Floats, y: Floats, ridge: float) -> Floats:
    gram = x.T @ x
    damped = gram + ridge * np.trace(gram) / len(gram) * np.eye(len(gram))
    return np.asarray(np.linalg.solve(damped, x.T @ y))
