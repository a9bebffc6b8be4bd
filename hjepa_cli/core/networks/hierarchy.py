"""The hierarchy of predictors: how strides nest, in training and in the closed loop.

Notation: a packet at step k restarts all grids at k. Coarse anchors lie at a = k, k + h, …; the
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
    """What the schemes below ask of a predictor (see :class:`Predictor`)."""

    def __call__(
        self, z: Tensor, actions: Tensor, anchor: Tensor | None = None, remaining: int = 1
    ) -> Tensor: ...


@dataclasses.dataclass(frozen=True)
class Strides:
    """Strides of the three levels in control steps.

    Raises:
        UsageError: unless h is a multiple of m and m a multiple of l, all positive.
    """

    h: int
    m: int
    l: int

    def __post_init__(self) -> None:
        check_strides(self.h, self.m, self.l)


def rollout(predictor: Step, z: Tensor, actions: Tensor) -> Tensor:
    """Autoregressive prediction: z [N, D], actions [N, S, steps, *A] → [N, S + 1, D], z first."""
    states = [z]
    for stride in range(actions.shape[1]):
        states.append(predictor(states[-1], actions[:, stride]))
    return torch.stack(states, dim=1)


def fill_gap(predictor: Step, left: Tensor, right: Tensor, actions: Tensor) -> Tensor:
    """Interpolate inside one gap: the finer level walks from ``left`` towards the fixed ``right``.

    Args:
        predictor: the finer level's step.
        left, right: embeddings [N, D] at both ends of the gap.
        actions: [N, C, steps, *A], one row per sub-stride.

    Returns:
        Embeddings [N, C + 1, D] on the finer grid, both ends included.
    """
    count = actions.shape[1]
    states = [left]
    for index in range(count - 1):
        states.append(
            predictor(states[-1], actions[:, index], anchor=right, remaining=count - index)
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
    recompute_anchor: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Play one coarse stride from its anchor, the controller's only work inside a gap.

    The next anchor is first predicted with the first action held; the finer levels then fill in
    embeddings and the actions that answer them. Where a held action leads far from where these
    actions lead, the finer levels were misled: so the anchor is predicted again and the stride
    played once more. With what was played last, P^H predicts where the next stride starts.

    Args:
        act: embeddings [N, D] → actions [N, *A].
        coarse, medium, low: P^H, P^M, P^L.
        z: anchor embeddings [N, D].
        strides: (h, m, l).
        recompute_anchor: ``False`` keeps the first coarse prediction (the paper's literal reading).

    Returns:
        Actions [N, h, *A]; embeddings [N, h / l, D] on the finest grid they were taken at;
        the next anchor [N, D].
    """
    first = act(z)
    anchor = coarse(z, hold(first, strides.h))
    actions, embeddings = play_stride(act, medium, low, z, anchor, first, strides)
    if recompute_anchor:
        anchor = coarse(z, actions)
        actions, embeddings = play_stride(act, medium, low, z, anchor, first, strides, actions)
        anchor = coarse(z, actions)
    return actions, embeddings, anchor


def play_stride(
    act: Callable[[Tensor], Tensor],
    medium: Step,
    low: Step,
    z: Tensor,
    anchor: Tensor,
    first: Tensor,
    strides: Strides,
    expected: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Fill the stride between two anchors: embeddings, and the actions that answer them.

    Args:
        act, medium, low, strides: as for :func:`plan_stride`.
        z, anchor: embeddings [N, D] at both ends.
        first: action [N, *A] that answers ``z``.
        expected: actions [N, h, *A] of the stride, if it was played before: P^M takes its strides
            to be under these, otherwise under the action at their beginning, held.

    Returns:
        Actions [N, h, *A]; embeddings [N, h / l, D].
    """
    h, m, l = strides.h, strides.m, strides.l
    actions, embeddings = [], []
    for begin in range(0, h, m):
        left, action = (h - begin) // m, act(z) if begin else first
        under = hold(action, m) if expected is None else expected[:, begin : begin + m]
        z_next = anchor if left == 1 else medium(z, under, anchor, left)
        for remaining in range(m // l, 0, -1):
            embeddings.append(z)
            actions.append(hold(action, l))
            if remaining > 1:
                z = low(z, actions[-1], z_next, remaining)
                action = act(z)
        z = z_next
    return torch.cat(actions, dim=1), torch.stack(embeddings, dim=1)


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
    """The three levels and the flat baseline ``ts-jepa-1``, keyed as in the checkpoint.

    ``forces`` drive a device at every step; ``mirror`` as for :class:`Predictor`.
    """
    h, m, l = strides.h, strides.m, strides.l

    def level(steps: int, **anchoring: int) -> Predictor:
        return Predictor(
            embedding,
            hidden,
            steps * forces if all_actions else forces,
            anchored=bool(anchoring),
            residual=residual,
            mirror=mirror,
            **anchoring,
        )

    return {
        "high": level(h),
        "medium": level(m, distances=h // m),
        "low": level(l, distances=m // l),
        "flat": level(1),
    }
