"""Reflexes learn from the teacher's plans, by the age of the packet that they start from."""

import dataclasses

import numpy as np
import torch
from torch import Tensor, nn

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.networks.reflex import Reflex
from hjepa_cli.core.plants.system import System, Teacher


@dataclasses.dataclass(frozen=True, eq=False)
class Plans:
    """These forces ÷ force limit [N, L, *A] follow packets, at the ages 0 … L − 1.

    ``teacher`` are the teacher's, ``sent`` those that were applied: the same without exploration.
    """

    teacher: Tensor
    sent: Tensor


def follow(
    kind: System,
    act: Teacher,
    states: Floats,
    steps: int,
    *,
    sides: Floats | None = None,
    pushes_n: Floats | None = None,
) -> Plans:
    """Let a law drive on from some states, without noise.

    Args:
        kind: the plant.
        act: the law.
        states: of the packets [N, S].
        steps: L.
        sides: factors on the forces [N, F], where pictures show these states mirrored.
        pushes_n: exploration added to the teacher's forces [N, L, *A]; none by default.
    """
    limit_n = kind.force_limit_n
    teacher = np.empty((len(states), steps, *kind.action_shape), np.float32)
    sent = teacher if pushes_n is None else np.empty_like(teacher)
    side = 1.0 if sides is None else sides.reshape(len(states), *kind.action_shape)
    for age in range(steps):
        forces_n = np.clip(act(states), -limit_n, limit_n)
        teacher[:, age] = side * forces_n / limit_n
        if pushes_n is not None:
            forces_n = np.clip(forces_n + pushes_n[:, age], -limit_n, limit_n)
            sent[:, age] = side * forces_n / limit_n
        # Clipped as in the loop: a lost pole must not overflow.
        states = np.clip(kind.advance(states, forces_n), -STATE_LIMIT, STATE_LIMIT)
    taught = torch.from_numpy(teacher)
    return Plans(taught, taught if pushes_n is None else torch.from_numpy(sent))


def pushes(
    kind: System,
    count: int,
    steps: int,
    *,
    exploration_n: float,
    hold_steps: int,
    generator: np.random.Generator,
) -> Floats:
    """Explore as ``collect`` does: return forces [count, steps, *A], constant for a while each."""
    held = -(-steps // hold_steps)
    drawn_n = generator.normal(0.0, exploration_n, (count, held, *kind.action_shape))
    return np.repeat(drawn_n, hold_steps, axis=1)[:, :steps]


def draw(
    network: Reflex, count: int, packets: int, ages: int, generator: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return rows of random packets [B] of ``count``, and ages [B, J], from 0 to the longest."""
    rows = generator.integers(count, size=packets)
    drawn = generator.integers(network.longest_age + 1, size=(packets, ages))
    return torch.from_numpy(rows), torch.from_numpy(drawn)


def reflex_loss(network: Reflex, z: Tensor, plans: Plans, rows: Tensor, ages: Tensor) -> Tensor:
    """Return the mean squared error of the forces of a batch, as :func:`draw` makes it.

    ``z`` are the embeddings of all packets [N, D]; ``plans`` follow them for A + H steps at least.
    """
    ahead = ages[..., None] + torch.arange(network.shape[0])
    labels = plans.teacher[rows[:, None, None], ahead]
    sent = None
    if network.sees_forces:
        past = torch.arange(network.longest_age) < ages[..., None]
        sent = plans.sent[rows, None, : network.longest_age]
        sent = (sent * past.reshape(*past.shape, *[1] * (sent.dim() - 3))).to(z.device)
    forces = network(z[rows.to(z.device)], ages.to(z.device), sent)
    return nn.functional.mse_loss(forces.float(), labels.to(z.device))
