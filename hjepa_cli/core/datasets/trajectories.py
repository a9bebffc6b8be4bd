"""Trajectories train networks: the teacher drives, exploration shows what a force does."""

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import CollectSettings, Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.datasets.dataset import Trajectories
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.plants.named import plant

STREAM = 1  # this stage's branch of the seed tree
SPLITS = ("train", "test", "clean")


def split_sizes(collect: CollectSettings) -> dict[str, tuple[int, int]]:
    """Return trajectories and control steps of every split."""
    return {
        "train": (collect.trajectories, collect.steps),
        "test": (collect.test_trajectories, collect.steps),
        "clean": (collect.clean_trajectories, collect.clean_steps),
    }


def generate(settings: Settings, split: str, rows: range | None = None) -> Trajectories:
    """Simulate a split, or ``rows`` of it, all trajectories at once; frames are not rendered.

    One step without force leads from the drawn state to k = 0, because the camera needs a frame
    before it. The applied force is the teacher's plus exploration, clipped; the label is the
    teacher's alone. ``clean`` has no exploration, and devices as ``conditions`` have them.
    Trajectory i does not depend on how many there are.
    """
    kind, clean = plant(settings.plant), split == "clean"
    size, steps = split_sizes(settings.collect)[split]
    indices = range(size) if rows is None else rows
    streams = (generator(settings.seed, STREAM, SPLITS.index(split), i) for i in indices)
    shape = (steps, *kind.action_shape)
    draws = [_draw(settings.collect, random, shape, clean) for random in streams]
    initial, exploration_n = (np.stack(parts) for parts in zip(*draws, strict=True))
    count = len(initial)

    # Methods are measured on clean rollouts.
    moved = actual_plant(settings.plant, settings.conditions) if clean else kind
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


def _draw(
    collect: CollectSettings, random: np.random.Generator, shape: tuple[int, ...], clean: bool
) -> tuple[Floats, Floats]:
    """Draw one trajectory's initial state ``[S]`` and piecewise constant pushes ``[steps, *A]``."""
    half_widths = np.array(collect.half_widths)
    initial = random.uniform(-1, 1, half_widths.size) * half_widths
    if clean:
        return initial, np.zeros(shape)
    (steps, *action), hold = shape, collect.exploration_hold_steps
    pushes_n = random.normal(0.0, collect.exploration_n, (-(-steps // hold), *action))
    return initial, np.repeat(pushes_n, hold, axis=0)[:steps]
