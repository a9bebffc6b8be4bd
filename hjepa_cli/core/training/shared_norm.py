"""Batch norm works on a batch that is spread over several processes.

torch's own does so on GPUs only (``SyncBatchNorm`` refuses CPU tensors).
"""

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from hjepa_cli.core.networks.symmetry import TwinsAsOne
from hjepa_cli.core.training.ranks import summed


class SharedBatchNorm(_BatchNorm):
    """:class:`torch.nn.BatchNorm1d` and ``2d`` take the batches of all processes together."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise [N, C, …] per channel; the same as batch norm of all N of all processes."""
        if not self.training:
            return super().forward(x)
        values = x.float()
        axes = [axis for axis in range(x.dim()) if axis != 1]
        shape = [1, -1, *[1] * (x.dim() - 2)]
        mean, variance, unbiased = _moments(values, axes)
        assert self.momentum is not None and self.num_batches_tracked is not None
        assert self.running_mean is not None and self.running_var is not None
        with torch.no_grad():
            self.running_mean.lerp_(mean, self.momentum)
            self.running_var.lerp_(unbiased, self.momentum)
            self.num_batches_tracked += 1
        y = (values - mean.view(shape)) * (variance + self.eps).rsqrt().view(shape)
        if self.affine:
            y = y * self.weight.view(shape) + self.bias.view(shape)
        return y.to(x.dtype)

    def _check_input_dim(self, x: Tensor) -> None:
        """Accept both dimensions."""


class SharedTwinNorm(TwinsAsOne, SharedBatchNorm):
    """It does the same for twins, as :class:`~hjepa_cli.core.networks.symmetry.MirrorNorm2d`."""


def _moments(values: Tensor, axes: list[int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, variance and unbiased variance [C] over all processes, in one message.

    They are computed in float64: the second moment is large beside what is left of it.
    """
    variance, mean = torch.var_mean(values, axes, correction=0)
    mean, variance = mean.double(), variance.double()
    count = values.numel() // values.shape[1]
    here = torch.cat([mean, variance + mean.square(), mean.new_ones(1)])
    first, second, total = torch.split(summed(count * here), [len(mean), len(mean), 1])
    mean = first / total
    variance = second / total - mean.square()
    return mean.float(), variance.float(), (variance * total / (total - 1)).float()


def share_statistics(module: nn.Module) -> None:
    """Turn all batch norms inside ``module`` into shared ones: same names, same tensors."""
    for name, child in module.named_children():
        if isinstance(child, _BatchNorm):
            kind = SharedTwinNorm if isinstance(child, TwinsAsOne) else SharedBatchNorm
            shared = kind(child.num_features, child.eps, child.momentum, child.affine)
            shared.load_state_dict(child.state_dict())
            setattr(module, name, shared.train(child.training))
        else:
            share_statistics(child)
