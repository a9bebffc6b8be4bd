"""The target encoder: an exponential moving average of the context encoder (paper eq. 5)."""

import copy

import torch
from torch import nn


class EmaTarget:
    """θ̄ ← η θ̄ + (1 − η) θ, equal at the start, without gradient; buffers follow too.

    The target stays in the online network's mode at construction, training: it normalises by the
    statistics of the batch, as the context encoder does on the same frames (ours). Its
    floating-point buffers (running statistics) are averaged like parameters all the same, others
    are copied, so that it can be evaluated too.
    """

    def __init__(self, online: nn.Module, decay: float) -> None:
        self.decay = decay
        self.module = copy.deepcopy(online)
        self.module.requires_grad_(False)

    @torch.no_grad()
    def update(self, online: nn.Module) -> None:
        """Move the target one step towards ``online``."""
        pairs = zip(self._state(self.module), self._state(online), strict=True)
        for mean, value in pairs:
            if mean.is_floating_point():
                mean.lerp_(value, 1.0 - self.decay)
            else:
                mean.copy_(value)

    @staticmethod
    def _state(module: nn.Module) -> list[torch.Tensor]:
        return [*module.parameters(), *module.buffers()]
