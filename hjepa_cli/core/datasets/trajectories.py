"""Trajectories train networks: a law drives, exploration shows what a force does."""

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import CollectSettings, Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.datasets.dataset import Trajectories
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.plants.control_law import control_law
from hjepa_cli.core.plants.named import plant

STREAM = 1  # this stage's branch of the seed tree
# Trajectories that a tuned law drives: how far from rest they start and how wrong the belief is
# that it goes by, ÷ the half widths of other starts, and when a packet comes, ÷ belief_steps.
START, BELIEF, PACKET = 0.5, 0.3, (0.25, 1.0)
SPLITS = ("train", "test", "clean")


def split_sizes(settings: Settings) -> dict[str, tuple[int, int]]:
    """Return trajectories and control steps of every split.

    A tuned law drives as many in training as the plant's own teacher.
    """
    collect, laws = settings.collect, 2 if settings.control.gains_n else 1
    return {
        "train": (laws * collect.trajectories, collect.steps),
        "test": (collect.test_trajectories, collect.steps),
        "clean": (collect.clean_trajectories, collect.clean_steps),
    }


def generate(settings: Settings, split: str, rows: range | None = None) -> Trajectories:
    """Simulate a split, or ``rows`` of it, all trajectories at once; frames are not rendered.

    One step without force leads from the drawn state to k = 0, because the camera needs a frame
    before it. The applied force is the law's plus exploration, clipped; the label is the law's
    alone, in the true state. ``clean`` has no exploration, and devices as ``conditions`` have them.
    Trajectory i does not depend on how many there are.

    A tuned law is quick to bring a device to rest, which leaves little to see, and throws devices
    about that are far from it. Where there is one, the plant's own teacher drives every second
    trajectory. The law drives the others, from nearer starts, and from a belief that is wrong until
    a packet comes: forces that do not fit the state are what a controller plays in closed loop.
    """
    kind, clean = plant(settings.plant), split == "clean"
    size, steps = split_sizes(settings)[split]
    indices = range(size) if rows is None else rows
    streams = (generator(settings.seed, STREAM, SPLITS.index(split), i) for i in indices)
    shape = (steps, *kind.action_shape)
    draws = [_draw(settings.collect, random, shape, clean) for random in streams]
    initial, exploration_n, wrong, packet = (np.stack(parts) for parts in zip(*draws, strict=True))
    count = len(initial)

    # Methods are measured on clean rollouts.
    moved = actual_plant(settings.plant, settings.conditions) if clean else kind
    law_n, own_n = control_law(kind, settings.control), kind.teacher()
    simulation = moved.simulation(count)
    by_law = np.zeros(count, bool)
    if settings.control.gains_n and not clean:
        by_law = np.arange(indices.start, indices.stop) % 2 == 0
    initial[by_law] *= START
    if driven := by_law.sum():
        believed = kind.advance(initial[by_law] + wrong[by_law], kind.no_force(driven))
    simulation.states = initial
    states = np.empty((count, steps + 1, len(kind.state_names)))
    applied_n, teacher_n = np.empty((2, count, steps, *kind.action_shape))
    states[:, 0] = initial
    simulation.step(kind.no_force(count))
    for k in range(steps):
        states[:, k + 1] = simulation.states
        teacher_n[:, k] = driven_n = law_n(states[:, k + 1])
        if driven:
            driven_n = np.array(own_n(states[:, k + 1]))
            heard = k == packet[by_law]
            believed[heard] = states[by_law][heard, k + 1]
            driven_n[by_law] = law_n(believed)
        applied_n[:, k] = driven_n + exploration_n[:, k]
        applied_n[:, k] = applied_n[:, k].clip(-kind.force_limit_n, kind.force_limit_n)
        if driven:
            believed = kind.advance(believed, applied_n[by_law, k])
        simulation.step(applied_n[:, k])
    return Trajectories(*(array.astype(np.float32) for array in (states, applied_n, teacher_n)))


def driven_by_teacher(settings: Settings) -> slice:
    """Return which trajectories of training the plant's own teacher drives."""
    return slice(1, None, 2) if settings.control.gains_n else slice(None)


def _draw(
    collect: CollectSettings, random: np.random.Generator, shape: tuple[int, ...], clean: bool
) -> tuple[Floats, Floats, Floats, int]:
    """Draw one trajectory's initial state [S] and piecewise constant pushes [steps, *A].

    And what only a tuned law has: how wrong its belief [S] starts, and the step that tells it.
    """
    half_widths = np.array(collect.half_widths)
    initial = random.uniform(-1, 1, half_widths.size) * half_widths
    (steps, *action), hold = shape, collect.exploration_hold_steps
    if clean:
        return initial, np.zeros(shape), np.zeros_like(initial), 0
    pushes_n = random.normal(0.0, collect.exploration_n, (-(-steps // hold), *action))
    wrong = BELIEF * random.uniform(-1, 1, half_widths.size) * half_widths
    packet = int(collect.belief_steps * random.uniform(*PACKET))
    return initial, np.repeat(pushes_n, hold, axis=0)[:steps], wrong, packet
