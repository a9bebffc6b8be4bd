"""Trajectories for training: the teacher drives, exploration shows what a force does."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.plant import CartPoles, plant
from hjepa_cli.core.policy import teacher
from hjepa_cli.core.seeding import generator
from hjepa_cli.settings import CollectSettings, Settings
from hjepa_cli.storage.datasets import Trajectories

Floats = NDArray[np.float64]

STREAM = 1  # this stage's branch of the seed tree
SPLITS = ("train", "test", "clean")


def split_sizes(settings: Settings) -> dict[str, tuple[int, int]]:
    """Return trajectories and control steps of every split."""
    options = settings.collect
    return {
        "train": (options.trajectories, options.steps),
        "test": (options.test_trajectories, options.steps),
        "clean": (options.clean_trajectories, options.clean_steps),
    }


def generate(settings: Settings, split: str, rows: range | None = None) -> Trajectories:
    """Simulate one split or some of it, all trajectories at once; frames are not rendered.

    One step without force leads from the drawn state to k = 0, because the camera needs a frame
    before it. The applied force is the teacher's plus exploration, clipped; the label is the
    teacher's alone. ``clean`` has no exploration.

    Args:
        settings: plant, seed and ``collect``.
        split: one of :data:`SPLITS`.
        rows: which trajectories; all by default.

    Returns:
        N trajectories of T steps. Trajectory i does not depend on how many there are.
    """
    kind = plant(settings.plant)
    size, steps = split_sizes(settings)[split]
    rows = range(size) if rows is None else rows
    count = len(rows)
    draws = [_draw(settings, split, i, steps) for i in rows]
    initial, exploration_n = (np.stack(parts) for parts in zip(*draws, strict=True))

    force_n = teacher(kind)
    poles = CartPoles(kind, count)
    poles.states = initial
    states = np.empty((count, steps + 1, 4))
    applied_n, teacher_n = np.empty((count, steps)), np.empty((count, steps))
    states[:, 0] = initial
    poles.step(np.zeros(count))
    for k in range(steps):
        states[:, k + 1] = poles.states
        teacher_n[:, k] = force_n(states[:, k + 1])
        applied_n[:, k] = teacher_n[:, k] + exploration_n[:, k]
        applied_n[:, k] = applied_n[:, k].clip(-kind.force_limit_n, kind.force_limit_n)
        poles.step(applied_n[:, k])
    return Trajectories(*(array.astype(np.float32) for array in (states, applied_n, teacher_n)))


def _draw(settings: Settings, split: str, index: int, steps: int) -> tuple[Floats, Floats]:
    """Draw one trajectory's initial state ``[4]`` and its piecewise constant pushes ``[steps]``."""
    options = settings.collect
    random = generator(settings.seed, STREAM, SPLITS.index(split), index)
    initial = random.uniform(-1, 1, 4) * _half_widths(options)
    if split == "clean":
        return initial, np.zeros(steps)
    pushes_n = random.normal(
        0.0, options.exploration_n, -(-steps // options.exploration_hold_steps)
    )
    return initial, np.repeat(pushes_n, options.exploration_hold_steps)[:steps]


def _half_widths(options: CollectSettings) -> Floats:
    return np.array([options.x_m, options.x_dot_m_s, options.theta_rad, options.theta_dot_rad_s])
