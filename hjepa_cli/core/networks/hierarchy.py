"""The hierarchy of predictors nests strides, in training and in the closed loop.

A packet at step k restarts all grids at k. Coarse waypoints lie at a = k, k + h, …; the
medium level fills a + m, a + 2m, … inside each gap, the low level l, 2l, … inside each m-step.
Actions are in units of the force limit everywhere in this file; *A is their shape at one step.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Protocol

import torch
from torch import Tensor

from hjepa_cli.config.checks import check_strides
from hjepa_cli.core.networks.predictors import Predictor


class Step(Protocol):
    """It takes one stride, as :meth:`Predictor.forward` does."""

    def __call__(
        self, z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor: ...


@dataclasses.dataclass(frozen=True)
class Strides:
    """The three levels take these strides, in control steps.

    Raises:
        UsageError: unless h is a multiple of m and m a multiple of l, all positive.
    """

    h: int
    m: int
    l: int

    def __post_init__(self) -> None:
        check_strides(self.h, self.m, self.l)


def rollout(predictor: Step, z: Tensor, actions: Tensor) -> Tensor:
    """Predict autoregressively: z [N, D] and actions [N, S, steps, *A] give [N, S + 1, D]."""
    states = [z]
    for stride in range(actions.shape[1]):
        states.append(predictor(states[-1], actions[:, stride]))
    return torch.stack(states, dim=1)


def fill_gap(predictor: Step, left: Tensor, right: Tensor, actions: Tensor) -> Tensor:
    """Interpolate inside one gap: the finer level walks from ``left`` towards the fixed ``right``.

    Embeddings [N, D] at both ends and actions [N, C, steps, *A], one row per sub-stride, give
    embeddings [N, C + 1, D] on the finer grid, both ends included.
    """
    count = actions.shape[1]
    states = [left]
    for index in range(count - 1):
        states.append(
            predictor(states[-1], actions[:, index], waypoint=right, remaining=count - index)
        )
    return torch.stack([*states, right], dim=1)


def plan_stride(
    act: Callable[[Tensor], Tensor],
    coarse: Step,
    medium: Step,
    low: Step,
    z: Tensor,
    strides: Strides,
    *,
    recompute_waypoint: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Play one coarse stride from its waypoint, the controller's only work inside a gap.

    The next waypoint is first predicted with the first action held; the finer levels then fill in
    embeddings and the actions that answer them. Where a held action leads far from where these
    actions lead, the finer levels were misled: so the waypoint is predicted again and the stride
    played once more. With what was played last, P^H predicts where the next stride starts.

    Args:
        act: a function from embeddings [N, D] to actions [N, *A].
        coarse, medium, low: P^H, P^M, P^L.
        z: waypoint embeddings [N, D].
        recompute_waypoint: ``False`` keeps the first coarse prediction, the paper's literal text.

    Returns:
        Actions [N, h, *A]; embeddings [N, h / l, D] on the finest grid they were taken at;
        the next waypoint [N, D].
    """
    h, m, l = strides.h, strides.m, strides.l
    first = act(z)

    def play(waypoint: Tensor, expected: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Fill the stride up to a waypoint; return the actions, and the embeddings they answer.

        P^M takes its strides to be under the actions ``expected``, if the stride was played
        before, otherwise under the action at their beginning, held.
        """
        at, actions, embeddings = z, [], []
        for begin in range(0, h, m):
            left, action = (h - begin) // m, act(at) if begin else first
            under = hold(action, m) if expected is None else expected[:, begin : begin + m]
            following = waypoint if left == 1 else medium(at, under, waypoint, left)
            for remaining in range(m // l, 0, -1):
                embeddings.append(at)
                actions.append(hold(action, l))
                if remaining > 1:
                    at = low(at, actions[-1], following, remaining)
                    action = act(at)
            at = following
        return torch.cat(actions, dim=1), torch.stack(embeddings, dim=1)

    waypoint = coarse(z, hold(first, h))
    actions, embeddings = play(waypoint)
    if recompute_waypoint:
        waypoint = coarse(z, actions)
        actions, embeddings = play(waypoint, actions)
        waypoint = coarse(z, actions)
    return actions, embeddings, waypoint


def hold(action: Tensor, steps: int) -> Tensor:
    """Repeat actions [N, *A] over ``steps`` control steps: [N, steps, *A]."""
    return action.unsqueeze(1).expand(-1, steps, *action.shape[1:])


def build_predictors(
    strides: Strides,
    embedding: int,
    hidden: int,
    *,
    all_actions: bool,
    residual: bool,
    forces: int = 1,
    mirror: Sequence[float] | None = None,
) -> dict[str, Predictor]:
    """Return the three levels and the flat baseline ``ts-jepa-1``, keyed as in the checkpoint.

    ``forces`` drive a device at every step; ``mirror`` as for :class:`Predictor`.
    """
    h, m, l = strides.h, strides.m, strides.l
    levels = {"high": (h, 0), "medium": (m, h // m), "low": (l, m // l), "flat": (1, 0)}
    return {
        name: Predictor(
            embedding,
            hidden,
            steps * forces if all_actions else forces,
            guided=distances > 0,
            distances=distances,
            residual=residual,
            mirror=mirror,
        )
        for name, (steps, distances) in levels.items()
    }
