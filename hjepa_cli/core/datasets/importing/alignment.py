"""Inverse dynamics tell which action leads from which picture to which.

A picture, the one before it and the two after it show how the motion changes between picture j and
picture j + 1, so the action that did that is read off them best. Actions of other rows are read off
the same pictures; the row that fits best is where the action belongs. A law that sees the pictures
makes neighbouring actions look alike, so the test decides only where one fits clearly better.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants.resizing import area_means

WIDEST = 3  # rows, of an offset that is looked for
SIDES_PX = (16, 32)  # pictures are made as small for the test
COMPONENTS = 24  # of pictures, and of their differences
FEATURES = 384  # random ones
FOLDS = 4
CLEARLY = 0.85  # of the error that is left at the stated offset
KEY = 0xA116
RIDGE = 1e-2


@dataclasses.dataclass(frozen=True)
class Verdict:
    """It says which offset fits best.

    Attributes:
        r2: held-out R² of the action, by offset relative to the stated one.
        best: the one with the largest.
        clear: whether it fits clearly better than the stated one.
    """

    r2: dict[int, float]
    best: int
    clear: bool


def judge(frames: Sequence[Pixels], actions: Sequence[Floats]) -> Verdict | None:
    """Compare offsets on some trajectories.

    Args:
        frames: of each, uint8 [R, H, W, C].
        actions: of each, [R, A]; row j is said to lead from picture j to j + 1.

    Returns:
        The verdict; ``None`` where there are too few rows, or actions do not vary.
    """
    small = [_small(some) for some in frames]
    reach = WIDEST + 2
    windows, targets, groups = [], [], []
    for number, (pictures, moved) in enumerate(zip(small, actions, strict=True)):
        at = np.arange(reach, len(pictures) - reach)
        windows += [pictures[at[:, None] + np.arange(-1, 3)]]
        targets += [moved[at[:, None] + np.arange(-WIDEST, WIDEST + 1)]]
        groups += [np.full(len(at), number)]
    x, y, group = (np.concatenate(parts) for parts in (windows, targets, groups))
    if len(x) < 4 * COMPONENTS or not y.std(axis=(0, 1)).all():
        return None
    if len(small) < FOLDS:
        group = np.arange(len(x)) * FOLDS // len(x)
    features = _features(x)
    errors = np.zeros(2 * WIDEST + 1)
    flat = y.reshape(len(y), -1)
    spread = ((flat - flat.mean(axis=0)) ** 2).reshape(y.shape).sum(axis=0)
    left = np.zeros_like(spread)
    for fold in range(FOLDS):
        test = group % FOLDS == fold
        weights = _ridge(features[~test], flat[~test] - flat[~test].mean(axis=0))
        miss = flat[test] - flat[~test].mean(axis=0) - features[test] @ weights
        left += (miss**2).reshape(-1, *y.shape[1:]).sum(axis=0)
    errors = (left / spread).mean(axis=-1)
    best = int(np.argmin(errors)) - WIDEST
    stated = errors[WIDEST]
    r2 = {offset - WIDEST: float(1 - error) for offset, error in enumerate(errors)}
    return Verdict(r2, best, bool(errors.min() < CLEARLY * stated))


def _small(frames: Pixels) -> Floats:
    """Return pictures [R, P] as small grey ones."""
    grey = frames.astype(np.float32).mean(axis=-1)
    height, width = (min(side, most) for side, most in zip(grey.shape[1:], SIDES_PX, strict=True))
    return np.asarray(area_means(area_means(grey, 1, height), 2, width), float).reshape(
        len(frames), -1
    )


def _features(windows: Floats) -> Floats:
    """Return features [N, F] of windows of four pictures [N, 4, P]: linear ones and random ones."""
    now = _components(windows[:, 1])
    moves = np.diff(windows, axis=1)
    change = _components(moves.reshape(-1, moves.shape[-1])).reshape(len(windows), -1)
    linear = np.concatenate([now, change], axis=1)
    linear = linear / (linear.std(axis=0) + 1e-9)
    draws = generator(0, KEY)
    mixed = linear @ draws.standard_normal((linear.shape[1], FEATURES)) / linear.shape[1] ** 0.5
    random = np.maximum(mixed + draws.standard_normal(FEATURES), 0)
    found = np.concatenate([linear, random], axis=1)
    return np.asarray(found - found.mean(axis=0))


def _components(values: Floats) -> Floats:
    """Return the principal components [N, K] of rows [N, P]."""
    centred = values - values.mean(axis=0)
    _, vectors = np.linalg.eigh(centred.T @ centred)
    return np.asarray(centred @ vectors[:, ::-1][:, :COMPONENTS])


def _ridge(x: Floats, y: Floats) -> Floats:
    gram = x.T @ x
    return np.asarray(
        np.linalg.solve(gram + RIDGE * np.trace(gram) / len(gram) * np.eye(len(gram)), x.T @ y)
    )
