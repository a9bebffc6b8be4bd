"""A predictor P maps an embedding and the actions of its stride to the embedding a stride later.

The same network serves all levels (paper eqs. 6, 8, 9): P^H sees z and the stride's actions; P^M
and P^L also see the coarser prediction they interpolate towards.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.core.networks.symmetry import embedding_signs, force_signs, linear_layers


class Predictor(nn.Module):
    """This MLP has one hidden layer (paper: 1024 → 256); embeddings have length √D, in and out.

    Args:
        embedding, hidden: D, and the width of the hidden layer.
        actions: number of action inputs: the forces of every step of the stride, or those of one
            where a held action stands for all of them (the paper's literal reading).
        guided: the coarser prediction at the end of the gap is an input too (P^M, P^L).
        distances: how many sub-strides a gap has; more than two make the remaining distance vary,
            and then it is an input.
        residual: predict the change from the input embedding (guided: from the linear
            interpolation towards the waypoint) instead of the embedding itself.
        mirror: what a mirror does to the forces of a step, a factor for each; then the prediction
            from reflected inputs is the reflected one. ``None``: an ordinary network.
    """

    def __init__(
        self,
        embedding: int,
        hidden: int,
        actions: int,
        *,
        guided: bool = False,
        distances: int = 1,
        residual: bool = True,
        mirror: Sequence[float] | None = None,
    ) -> None:
        super().__init__()
        self.actions, self.guided, self.residual = actions, guided, residual
        self.sees_distance = guided and distances > 2
        z = embedding_signs(embedding)
        signs = z + force_signs(mirror or (1.0,)) * (actions // len(mirror or (1.0,)))
        signs += (z if guided else ()) + ((1, 1.0),) * self.sees_distance
        self.hidden, self.output = linear_layers(signs, hidden, z, mirrored=mirror is not None)
        if residual:
            for parameter in self.output.parameters():
                nn.init.zeros_(parameter)

    def forward(
        self, z: Tensor, actions: Tensor, waypoint: Tensor | None = None, remaining: int = 1
    ) -> Tensor:
        """Return the embeddings [N, D] of length √D one stride ahead of z [N, D].

        Args:
            actions: [N, steps, *A] in units of the force limit; only the first ``self.actions``
                numbers are read, so a held-action predictor takes the stride's first action.
            waypoint: coarser prediction [N, D] at the end of the gap, for guided predictors.
            remaining: sub-strides left to the waypoint, counted from z (1 would be the waypoint).
        """
        inputs = [z, actions.flatten(1)[:, : self.actions]]
        start = z
        if self.guided:
            assert waypoint is not None, "a guided predictor needs its waypoint"
            inputs.append(waypoint)
            start = z + (waypoint - z) / remaining
            if self.sees_distance:
                inputs.append(torch.full_like(z[..., :1], 1.0 / remaining))
        # In float32 from here on: lengths and cosines of rollouts do not survive bfloat16.
        change: Tensor = self.output(torch.relu(self.hidden(torch.cat(inputs, dim=-1)))).float()
        return normalise(start + change if self.residual else change)
