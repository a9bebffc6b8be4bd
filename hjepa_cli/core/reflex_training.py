"""What reflexes learn from: the teacher's plans, by the age of the packet that they start from."""

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn

from hjepa_cli.core.reflex import Reflex
from hjepa_cli.core.system import Floats, System

EXPLORATION_KEY = 0x9E


@dataclasses.dataclass(frozen=True, eq=False)
class Plans:
    """What follows a packet, step by step.

    Attributes:
        teacher: the teacher's forces ÷ force limit [N, L, *A] at the ages 0 … L − 1.
        sent: the forces ÷ force limit that were applied [N, L, *A].
    """

    teacher: Tensor
    sent: Tensor


def follow(kind: System, states: Floats, steps: int, pushes_n: Floats | None = None) -> Plans:
    """Let the teacher drive on from some states, without noise.

    Args:
        kind: the plant.
        states: of the packets [N, S].
        steps: L.
        pushes_n: exploration added to the teacher's forces [N, L, *A]; none by default.
    """
    act, limit_n = kind.teacher(), kind.force_limit_n
    teacher, sent = np.empty((2, len(states), steps, *kind.action_shape), np.float32)
    for age in range(steps):
        forces_n = np.clip(act(states), -limit_n, limit_n)
        teacher[:, age] = forces_n / limit_n
        if pushes_n is not None:
            forces_n = np.clip(forces_n + pushes_n[:, age], -limit_n, limit_n)
        sent[:, age] = forces_n / limit_n
        # ±50 is where the loop clips states too: a lost pole must not overflow.
        states = np.clip(kind.advance(states, forces_n), -50.0, 50.0)
    return Plans(torch.from_numpy(teacher), torch.from_numpy(sent))


def pushes(
    kind: System,
    count: int,
    steps: int,
    *,
    exploration_n: float,
    hold_steps: int,
    generator: np.random.Generator,
) -> Floats:
    """Exploration as ``collect`` makes it: forces [count, steps, *A], constant for a while each."""
    held = -(-steps // hold_steps)
    drawn_n = generator.normal(0.0, exploration_n, (count, held, *kind.action_shape))
    return np.repeat(drawn_n, hold_steps, axis=1)[:, :steps]


def reflex_loss(
    network: Reflex,
    z: Tensor,
    plans: Plans,
    *,
    packets: int,
    ages: int,
    generator: np.random.Generator,
) -> Tensor:
    """Mean squared error of forces on random packets at random ages.

    Args:
        z: embeddings of the packets [N, D].
        plans: what follows them, of at least A + H steps.
        packets: drawn.
        ages: drawn for each, from 0 to A.
        generator: of both.
    """
    rows = torch.from_numpy(generator.integers(len(z), size=packets)).repeat_interleave(ages)
    age = torch.from_numpy(generator.integers(network.longest_age + 1, size=packets * ages))
    ahead = age[:, None] + torch.arange(network.shape[0])
    labels = plans.teacher[rows[:, None], ahead]
    sent = None
    if network.sees_forces:
        past = torch.arange(network.longest_age) < age[:, None]
        sent = plans.sent[rows, : network.longest_age]
        sent = sent * past.reshape(*past.shape, *[1] * (sent.dim() - 2))
    forces = network(z[rows], age, sent)
    return nn.functional.mse_loss(forces.float(), labels)
