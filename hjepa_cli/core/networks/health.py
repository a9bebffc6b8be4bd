"""Is the representation alive, and does it know the state? The numbers behind the stage gates.

All functions take plain float tensors; nothing here trains the encoder (docs/metrics.md lists the
healthy ranges).
"""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor


def probe_r2(
    train_z: Tensor,
    train_states: Tensor,
    test_z: Tensor,
    test_states: Tensor,
    names: Sequence[str],
) -> dict[str, float]:
    """Held-out R² of a linear least-squares probe from embeddings to each state.

    Args:
        train_z, test_z: embeddings [N, D] and [N', D].
        train_states, test_states: [N, S] and [N', S].
        names: of the S states.
    """
    truth = test_states.double()
    residual = truth - read_probe(fit_probe(train_z, train_states), test_z)
    r2 = 1.0 - residual.square().sum(0) / (truth - truth.mean(0)).square().sum(0)
    return dict(zip(names, r2.tolist(), strict=True))


def fit_probe(z: Tensor, states: Tensor) -> Tensor:
    """Linear least squares from embeddings [N, D] to states [N, S]: weights [D + 1, S], float64."""
    design = _with_intercept(z)
    # A tiny ridge keeps collapsed embeddings solvable; 1e-6 of the mean square moves no healthy R².
    gram = design.T @ design
    ridge = 1e-6 * gram.diagonal().mean() * torch.eye(len(gram), dtype=gram.dtype)
    weights: Tensor = torch.linalg.solve(gram + ridge, design.T @ states.double())
    return weights


def read_probe(weights: Tensor, z: Tensor) -> Tensor:
    """States [N, S] that a probe reads from embeddings [N, D]."""
    return _with_intercept(z) @ weights


def effective_rank(z: Tensor) -> float:
    """exp of the entropy of the normalised squared singular values of centred z [N, D]."""
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
    """mean ‖P(z, +u_max) − P(z, −u_max)‖ ÷ mean ‖z_{k+h} − z_k‖ over embeddings [N, D].

    Where several forces drive a device, the mean over them, one at a time.
    """
    spreads = []
    for force in torch.eye(math.prod(action_shape), dtype=z.dtype):
        full = force.reshape(1, 1, *action_shape).expand(len(z), steps, *action_shape)
        spreads.append((predict(z, full) - predict(z, -full)).norm(dim=-1).mean())
    spread = torch.stack(spreads).mean()
    return float(spread / (z_next - z).norm(dim=-1).mean().clamp_min(1e-12))


def nrmse(predicted: Tensor, truth: Tensor) -> float:
    """Root mean square error ÷ root mean square of the truth, over all of two equal shapes."""
    return float((predicted - truth).square().mean().sqrt() / truth.square().mean().sqrt())


def _with_intercept(z: Tensor) -> Tensor:
    z = z.double()
    return torch.cat([z, torch.ones(len(z), 1, dtype=z.dtype)], dim=1)
