"""Trajectories for training: the teacher drives, exploration shows what a force does."""

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.datasets.dataset import Trajectories
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.plants.named import plant

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
    """Simulate a split, or ``rows`` of it, all trajectories at once; frames are not rendered.

    One step without force leads from the drawn state to k = 0, because the camera needs a frame
    before it. The applied force is the teacher's plus exploration, clipped; the label is the
    teacher's alone. ``clean`` has no exploration, and devices as ``conditions`` have them.
    Trajectory i does not depend on how many there are.
    """
    kind = plant(settings.plant)
    size, steps = split_sizes(settings)[split]
    draws = [_draw(settings, split, i, steps) for i in (range(size) if rows is None else rows)]
    initial, exploration_n = (np.stack(parts) for parts in zip(*draws, strict=True))
    count = len(initial)

    moved = actual_plant(settings) if split == "clean" else kind  # what methods are measured on
    force_n, simulation = kind.teacher(), moved.simulation(count)
    simulation.states = initial
    states = np.empty((count, steps + 1, len(kind.state_names)))
    applied_n, teacher_n = np.empty((2, count, steps, *kind.action_shape))
    states[:, 0] = initial
    simulation.step(kind.no_force(count))
    for k in range(steps):
        states[:, k + 1] = simulation.states
        teacher_n[:, k] = force_n(states[:, k + 1])
        applied_n[:, k] = teacher_n[:, k] + exploration_n[:, k]
        applied_n[:, k] = applied_n[:, k].clip(-kind.force_limit_n, kind.force_limit_n)
        simulation.step(applied_n[:, k])
    return Trajectories(*(array.astype(np.float32) for array in (states, applied_n, teacher_n)))


def _draw(settings: Settings, split: str, index: int, steps: int) -> tuple[Floats, Floats]:
    """Draw one trajectory's initial state ``[S]`` and piecewise constant pushes ``[steps, *A]``."""
    options, shape = settings.collect, plant(settings.plant).action_shape
    random = generator(settings.seed, STREAM, SPLITS.index(split), index)
    half_widths = np.array(options.half_widths)
    initial = random.uniform(-1, 1, half_widths.size) * half_widths
    if split == "clean":
        return initial, np.zeros((steps, *shape))
    hold = options.exploration_hold_steps
    pushes_n = random.normal(0.0, options.exploration_n, (-(-steps // hold), *shape))
    return initial, np.repeat(pushes_n, hold, axis=0)[:steps]
