"""Trajectories for training: the teacher drives, exploration teaches what an action does (spec §2)."""

import numpy as np

from hjepa_cli.core.plant import CartPoles, plant
from hjepa_cli.core.policy import teacher
from hjepa_cli.core.seeding import generator
from hjepa_cli.settings import Settings
from hjepa_cli.storage.datasets import Trajectories

STREAM = 1  # this stage's branch of the seed tree
SPLITS = ("train", "test", "clean")


def split_sizes(settings: Settings) -> dict[str, tuple[int, int]]:
    """Trajectories and control steps of every split."""
    options = settings.collect
    return {
        "train": (options.trajectories, options.steps),
        "test": (options.test_trajectories, options.steps),
        "clean": (options.clean_trajectories, options.clean_steps),
    }


def generate(settings: Settings, split: str) -> Trajectories:
    """Simulate one split, all its trajectories at once; frames are not rendered.

    Trajectory i has its own generator, so it does not depend on how many there are. One step
    without force leads to k = 0, because the camera needs a frame before it. The applied force is
    the teacher's plus piecewise-constant exploration, clipped; the label is the teacher's alone.
    ``clean`` has no exploration.
    """
    options, kind = settings.collect, plant(settings.plant)
    count, steps = split_sizes(settings)[split]
    streams = [generator(settings.seed, STREAM, SPLITS.index(split), i) for i in range(count)]
    ranges = np.array(
        [options.x_m, options.x_dot_m_s, options.theta_rad, options.theta_dot_rad_s]
    )
    start = np.stack([stream.uniform(-ranges, ranges) for stream in streams])
    holds = -(-steps // options.exploration_hold_steps)
    pushes = np.stack([stream.normal(0.0, options.exploration_n, holds) for stream in streams])
    exploration = np.repeat(pushes, options.exploration_hold_steps, axis=1)[:, :steps]
    if split == "clean":
        exploration = np.zeros_like(exploration)

    act, limit = teacher(kind), kind.force_limit_n
    poles = CartPoles(kind, count)
    poles.states = start
    states = np.empty((count, steps + 1, 4))
    applied, labels = np.empty((count, steps)), np.empty((count, steps))
    states[:, 0] = poles.states
    poles.step(np.zeros(count))
    for k in range(steps):
        states[:, k + 1] = poles.states
        labels[:, k] = act(states[:, k + 1])
        applied[:, k] = np.clip(labels[:, k] + exploration[:, k], -limit, limit)
        poles.step(applied[:, k])
    return Trajectories(*(array.astype(np.float32) for array in (states, applied, labels)))
