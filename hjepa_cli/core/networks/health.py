"""These numbers tell the stage gates whether embeddings are alive and know the state.

Nothing here trains the encoder; docs/reference/metrics.md lists the healthy ranges.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def of_embeddings(
    train_z: Tensor,
    train_states: Tensor,
    test_z: Tensor,
    test_states: Tensor,
    names: Sequence[str],
) -> dict[str, Any]:
    """Return what every encoder is examined for, of :func:`probe_r2`'s embeddings and states."""
    return {
        "probe_r2": probe_r2(train_z, train_states, test_z, test_states, names),
        "effective_rank": effective_rank(test_z),
        "std": float(test_z.std(0).mean()),
    }


def probe_r2(
    train_z: Tensor,
    train_states: Tensor,
    test_z: Tensor,
    test_states: Tensor,
    names: Sequence[str],
) -> dict[str, float | None]:
    """Return the held-out R² of a linear least-squares probe from embeddings to each state.

    It is fitted on embeddings [N, D] and states [N, S] and tested on others; ``names`` are those
    of the S states. Of a state that is the same everywhere there is none: ``None``.
    """
    truth = test_states.double()
    residual = truth - read_probe(fit_probe(train_z, train_states), test_z)
    r2 = 1.0 - residual.square().sum(0) / (truth - truth.mean(0)).square().sum(0)
    varies = (truth != truth[0]).any(0)
    found = (value if known else None for value, known in zip(r2.tolist(), varies, strict=True))
    return dict(zip(names, found, strict=True))


def action_r2(
    train_z: Tensor, train_actions: Tensor, test_z: Tensor, test_actions: Tensor, steps: int
) -> float | None:
    """Return the held-out R² of reading a stride's mean action off the embeddings at its ends.

    It is the linear probe of inverse dynamics: embeddings [N, K, D], and actions [N, K, *A] from
    each to the next, of which ``steps`` make a stride. Actions that do not vary have none.
    """

    def ends(z: Tensor, actions: Tensor) -> tuple[Tensor, Tensor]:
        means = actions.unfold(1, steps, 1).mean(-1)[:, : z.shape[1] - steps]
        pairs = torch.cat([z[:, :-steps], z[:, steps:]], dim=-1)
        return pairs.flatten(0, 1), means.reshape(len(z) * means.shape[1], -1)

    (fit_pairs, fit_means), (pairs, means) = (
        ends(train_z, train_actions),
        ends(test_z, test_actions),
    )
    residual = means.double() - read_probe(fit_probe(fit_pairs, fit_means), pairs)
    spread = (means - means.mean(0)).double().square().sum()
    return float(1.0 - residual.square().sum() / spread) if spread > 0 else None


def fit_probe(z: Tensor, states: Tensor) -> Tensor:
    """Return weights [D + 1, S], float64, of least squares from embeddings [N, D] to [N, S]."""
    design = _with_intercept(z)
    # A tiny ridge keeps collapsed embeddings solvable; 1e-6 of the mean square moves no healthy R².
    gram = design.T @ design
    ridge = 1e-6 * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    weights: Tensor = torch.linalg.solve(gram + ridge, design.T @ states.double())
    return weights


def read_probe(weights: Tensor, z: Tensor) -> Tensor:
    """Return the states [N, S] that a probe reads from embeddings [N, D]."""
    return _with_intercept(z) @ weights


def effective_rank(z: Tensor) -> float:
    """Return exp of the entropy of the squared singular values of centred z [N, D], normalised."""
    energy = torch.linalg.svdvals((z - z.mean(0)).double()).square()
    share = energy / energy.sum().clamp_min(1e-30)
    return float(torch.exp(-(share * torch.log(share.clamp_min(1e-30))).sum()))


def action_sensitivity(
    predict: Callable[[Tensor, Tensor], Tensor],
    z: Tensor,
    z_next: Tensor,
    steps: int,
    action_shape: tuple[int, ...] = (),
) -> float:
    """Return mean ‖P(z, +u_max) − P(z, −u_max)‖ ÷ mean ‖z_{k+h} − z_k‖ over embeddings [N, D].

    Where several forces drive a device, it is the mean over them, one at a time.
    """
    spreads = []
    for force in torch.eye(math.prod(action_shape), dtype=z.dtype):
        full = force.reshape(1, 1, *action_shape).expand(len(z), steps, *action_shape)
        spreads.append((predict(z, full) - predict(z, -full)).norm(dim=-1).mean())
    spread = torch.stack(spreads).mean()
    return float(spread / (z_next - z).norm(dim=-1).mean().clamp_min(1e-12))


def nrmse(predicted: Tensor, truth: Tensor) -> float | None:
    """Return the root mean square error ÷ the root mean square of the truth, of equal shapes.

    Of a truth that is zero everywhere there is none: ``None``.
    """
    if not truth.any():
        return None
    return float((predicted - truth).square().mean().sqrt() / truth.square().mean().sqrt())


def _with_intercept(z: Tensor) -> Tensor:
    z = z.double()
    return torch.cat([z, torch.ones(len(z), 1, dtype=z.dtype)], dim=1)
