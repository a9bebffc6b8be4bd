"""One predictor P: an embedding and the actions of its stride in, the embedding a stride later out.

The same network serves all levels (paper eqs. 6, 8, 9): P^H sees z and the stride's actions; P^M
and P^L also see the coarser prediction they interpolate towards.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.core.networks.symmetry import (
    MirrorLinear,
    Signs,
    Twins,
    embedding_signs,
    force_signs,
)


class Predictor(nn.Module):
    """MLP with one hidden layer (paper: 1024 → 256), embeddings of length √D in and out.

    Args:
        embedding: D.
        hidden: width of the hidden layer.
        actions: number of action inputs: the forces of every step of the stride, or those of one
            where a held action stands for all of them (the paper's literal reading).
        anchored: the coarser prediction at the end of the gap is an input too (P^M, P^L).
        distances: how many sub-strides a gap has; more than two make the remaining distance vary,
            and then it is an input.
        residual: predict the change from the input embedding (anchored: from the linear
            interpolation towards the anchor) instead of the embedding itself.
        mirror: what a mirror does to the forces of a step, a factor for each; then the prediction
            from reflected inputs is the reflected one. ``None``: an ordinary network.
    """

    def __init__(
        self,
        embedding: int,
        hidden: int,
        actions: int,
        *,
        anchored: bool = False,
        distances: int = 1,
        residual: bool = True,
        mirror: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.actions, self.anchored, self.residual = actions, anchored, residual
        self.sees_distance = anchored and distances > 2
        inputs = embedding * (2 if anchored else 1) + actions + int(self.sees_distance)
        self.hidden: nn.Module = nn.Linear(inputs, hidden)
        self.output: nn.Module = nn.Linear(hidden, embedding)
        if mirror is not None:
            z = embedding_signs(embedding)
            signs = z + force_signs(mirror) * (actions // len(mirror))
            signs += (z if anchored else ()) + ((1, 1.0),) * self.sees_distance
            self.hidden = MirrorLinear(Signs(signs), Twins(hidden))
            self.output = MirrorLinear(Twins(hidden), Signs(z))
        if residual:
            for parameter in self.output.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self, z: Tensor, actions: Tensor, anchor: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        """Predict one stride ahead.

        Args:
            z: embeddings [N, D] at the start of the stride.
            actions: [N, steps, *A] in units of the force limit; only the first ``self.actions``
                numbers are read, so a held-action predictor takes the stride's first action.
            anchor: coarser prediction [N, D] at the end of the gap, for anchored predictors.
            remaining: sub-strides left to the anchor, counted from z (1 would be the anchor).

        Returns:
            Embeddings [N, D] of length √D.
        """
        inputs = [z, actions.flatten(1)[:, : self.actions]]
        start = z
        if self.anchored:
            assert anchor is not None, "an anchored predictor needs its anchor"
            inputs.append(anchor)
            start = z + (anchor - z) / remaining
            if self.sees_distance:
                inputs.append(torch.full_like(z[..., :1], 1.0 / remaining))
        # In float32 from here on: lengths and cosines of rollouts do not survive bfloat16.
        change: Tensor = self.output(torch.relu(self.hidden(torch.cat(inputs, dim=-1)))).float()
        return normalise(start + change if self.residual else change)
