"""Training minimises these losses of tensors."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.hierarchy import Step
from hjepa_cli.core.networks.symmetry import (
    MirrorLinear,
    Signs,
    Twins,
    embedding_signs,
    force_signs,
)


def cosine_loss(predicted: Tensor, target: Tensor) -> Tensor:
    """Return 1 − cos(z̃, sg(z)), averaged over all leading axes; inputs [..., D].

    The paper prints arg min of the cosine itself (eq. 7), a sign slip.
    """
    return 1.0 - cosine_similarity(predicted, target).mean()


def cosine_similarity(predicted: Tensor, target: Tensor) -> Tensor:
    """Return cos(z̃, sg(z)) [...] of embeddings [..., D]; no gradient reaches the target."""
    return F.cosine_similarity(predicted, target.detach(), dim=-1)


def rollout_loss(
    predictor: Step, z: Tensor, targets: Tensor, actions: Tensor, starts: Tensor, horizon: int
) -> Tensor:
    """Return the cosine loss of autoregressive rollouts from many starts.

    Args:
        predictor: one stride per call.
        z, targets: embeddings to start from and to reach [B, F, D], frames one stride apart.
        actions: [B, F − 1, steps, *A], ``actions[:, f]`` lead from frame f to f + 1.
        starts: ascending frame indices [S] to start from, the same for all B.
        horizon: strides to roll out; a start stops early where the window ends.

    Returns:
        Mean over rollout steps of the mean loss of the starts still running.
    """
    frames, width = z.shape[1], z.shape[2]
    state = z[:, starts]
    predicted, reached = [], []
    for step in range(horizon):
        running = int((starts + step + 1 < frames).sum())
        if running == 0:
            break
        now = starts[:running] + step
        state = predictor(
            state[:, :running].reshape(-1, width), actions[:, now].flatten(0, 1)
        ).reshape(-1, running, width)
        predicted.append(state)
        reached.append(targets[:, now + 1])
    # One loss over all steps, split afterwards: many small losses cost a fifth of the training.
    similarity = cosine_similarity(torch.cat(predicted, dim=1), torch.cat(reached, dim=1))
    by_step = torch.split(similarity, [state.shape[1] for state in predicted], dim=1)
    return 1.0 - torch.stack([step.mean() for step in by_step]).mean()


class InverseDynamics(nn.Module):
    """It tells which action led from z_k to z_{k+h}: the auxiliary task needs no state.

    It makes the encoder keep what actions change, the velocities above all (ours; it turned the
    recipe from useless to better than supervised, see docs/LOG.md). It is used in training only.
    """

    def __init__(
        self,
        embedding: int,
        hidden: int = 256,
        *,
        forces: int = 1,
        mirror: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        linear: list[nn.Module] = [nn.Linear(2 * embedding, hidden), nn.Linear(hidden, forces)]
        if mirror is not None:
            z, units = embedding_signs(embedding), Twins(2 * hidden)
            played = Signs(force_signs(mirror))
            linear = [MirrorLinear(Signs(z + z), units), MirrorLinear(units, played)]
        self.layers = nn.Sequential(linear[0], nn.ReLU(), linear[1])

    def loss(self, z: Tensor, z_next: Tensor, action: Tensor) -> Tensor:
        """Return the mean squared error of the action, in units of half the force limit.

        Embeddings [N, D] are a stride apart; ``action`` [N, *A] is the stride's mean applied one,
        in units of the force limit.
        """
        predicted = self.layers(torch.cat([z, z_next], dim=-1)).reshape(action.shape)
        return F.mse_loss(predicted, 2.0 * action)
