"""These networks commute with a mirror: what they see mirrored, they do mirrored.

A picture flipped left to right shows the plant in its mirrored state, and mirrored forces move that
one mirrored. The layers here obey this exactly, whatever their weights: nothing that was learned
on one side has to be learned again on the other, and an upright pole, its own mirror image, gets
no force at all. Data that is merely flipped at random teaches this only roughly, and the rest is a
bias that pushes on while no packet arrives (docs/LOG.md).

A mirror does one of two things to a vector. To ``Signs`` it gives or takes minus signs: embeddings,
of which the first half is even and the second odd, and forces. Of ``Twins`` it swaps the two
halves: hidden units, and the channels of feature maps, which are flipped as well. Nonlinearities
act on twins only. A linear map that commutes with the mirror maps even parts to even ones and odd
parts to odd ones, each on its own (Schur's lemma), at half the multiplications of an arbitrary map.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.modules.batchnorm import _BatchNorm

HALF = 0.5**0.5


Runs = tuple[tuple[int, float], ...]
"""Signs of consecutive values: how many a mirror multiplies by 1 or −1; then the next ones."""


def embedding_signs(embedding: int) -> Runs:
    """Return the signs of an embedding of D values: the first half is even, the second odd."""
    return ((embedding // 2, 1.0), (embedding - embedding // 2, -1.0))


def force_signs(mirror: Sequence[float]) -> Runs:
    """Return the signs of forces, from a factor for each."""
    return tuple((1, factor) for factor in mirror)


def linear_layers(*parts: Runs | int, mirrored: bool) -> list[nn.Module]:
    """Return the linear layers of a network between vectors: signs as runs, twins as their number.

    Layers that are not ``mirrored`` are ordinary ones. These are drawn in any case: what a seed
    makes of the rest of a network depends on how many numbers were drawn before.
    """
    sizes = [part if isinstance(part, int) else sum(count for count, _ in part) for part in parts]
    layers: list[nn.Module] = [nn.Linear(*ends) for ends in pairwise(sizes)]
    if not mirrored:
        return layers
    vectors = [Twins(part) if isinstance(part, int) else Signs(part) for part in parts]
    return [MirrorLinear(*ends) for ends in pairwise(vectors)]


def reflect(z: Tensor) -> Tensor:
    """Return the embeddings [..., D] of the mirrored pictures."""
    even, odd = z.chunk(2, dim=-1)
    return torch.cat([even, -odd], dim=-1)


class Signs(nn.Module):
    """It splits vectors [..., n] of which a mirror changes some signs."""

    order: Tensor
    back: Tensor

    def __init__(self, runs: Runs) -> None:
        super().__init__()
        counts, factors = zip(*runs, strict=True)
        even = np.repeat(np.array(factors) > 0, counts)
        order = np.argsort(~even, kind="stable")
        self.even, self.odd = int(even.sum()), int((~even).sum())
        self._sorted = bool(even[: self.even].all())
        self.register_buffer("order", torch.from_numpy(order), persistent=False)
        self.register_buffer("back", torch.from_numpy(np.argsort(order)), persistent=False)

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the even part [..., n_even] and the odd one [..., n_odd] of x [..., n]."""
        # The usual way to take columns, x[..., order], takes much longer.
        x = x if self._sorted else x.index_select(-1, self.order)
        return x[..., : self.even], x[..., self.even :]

    def join(self, even: Tensor, odd: Tensor) -> Tensor:
        """Undo :meth:`split`."""
        x = torch.cat([even, odd], dim=-1)
        return x if self._sorted else x.index_select(-1, self.back)


class Twins(nn.Module):
    """It splits vectors [..., n] whose two halves a mirror swaps."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.even = self.odd = size // 2

    def split(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return sum and difference of the halves of x [..., n], [..., n / 2] each."""
        right, left = x.chunk(2, dim=-1)
        return HALF * (right + left), HALF * (right - left)

    def join(self, even: Tensor, odd: Tensor) -> Tensor:
        """Undo :meth:`split`."""
        return HALF * torch.cat([even + odd, even - odd], dim=-1)


class MirrorLinear(nn.Module):
    """This linear layer commutes with the mirror; the even part alone has a bias."""

    def __init__(self, inputs: Signs | Twins, outputs: Signs | Twins) -> None:
        super().__init__()
        self.inputs, self.outputs = inputs, outputs
        # Nothing is learned for a part that the outputs lack: a single force is odd.
        self.even = nn.Linear(inputs.even, outputs.even) if outputs.even else None
        self.odd = nn.Linear(inputs.odd, outputs.odd, bias=False) if outputs.odd else None

    def forward(self, x: Tensor) -> Tensor:
        """Map [..., n_in] to [..., n_out]."""
        even, odd = self.inputs.split(x)
        return self.outputs.join(_mapped(self.even, even), _mapped(self.odd, odd))


def _mapped(layer: nn.Linear | None, x: Tensor) -> Tensor:
    """Return what a layer makes of x [..., n], nothing [..., 0] where there is none.

    A loop of a few devices spends much of its time on the way into modules: this one is shorter.
    """
    return x[..., :0] if layer is None else F.linear(x, layer.weight, layer.bias)


class MirrorConv2d(nn.Conv2d):
    """It convolves twins to twins; ``channels`` are those of both halves.

    Only the right half's weights exist; the left half sees its twin's inputs through the mirrored
    kernel. With a stride the kernel must be as wide, or the grid of outputs has no mirror image.
    """

    def __init__(self, channels_in: int, channels_out: int, *grid: Any, **bias: Any) -> None:
        super().__init__(channels_in, channels_out // 2, *grid, **bias)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, channels_in, H, W] to [N, channels_out, H', W']."""
        return F.conv2d(x, *self.both_halves(), self.stride, self.padding)

    def both_halves(self) -> tuple[Tensor, Tensor | None]:
        """Return weights [channels_out, channels_in, k, k] and bias of the same map, unshared."""
        own, other = self.weight.chunk(2, dim=1)
        weight = torch.cat([self.weight, torch.cat([other, own], dim=1).flip(-1)])
        return weight, None if self.bias is None else torch.cat([self.bias, self.bias])

    def ordinary(self) -> nn.Conv2d:
        """Return the same map as an ordinary convolution."""
        weight, bias = self.both_halves()
        out, into, kernel, _ = weight.shape
        layer = nn.Conv2d(into, out, kernel, self.stride, self.padding, bias=bias is not None)  # type: ignore[arg-type]
        layer.weight.data = weight.detach().contiguous(memory_format=torch.channels_last)
        if layer.bias is not None and bias is not None:
            layer.bias.data = bias.detach()
        return layer.eval()


class TwinsAsOne(_BatchNorm):
    """Mixed into a batch norm, it treats a channel and its twin as one."""

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, channels, H, W] to the same shape."""
        n, channels, height, width = x.shape
        # Channels-last memory: twins are neighbouring pixels of a map twice as wide, for free.
        wide = x.permute(0, 2, 3, 1).reshape(n, height, 2 * width, channels // 2)
        normed = super().forward(wide.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)
        return normed.reshape(n, height, width, channels).permute(0, 3, 1, 2)


class MirrorNorm2d(TwinsAsOne, nn.BatchNorm2d):
    """It normalises twins; ``channels`` are those of both halves."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels // 2)

    def ordinary(self) -> nn.BatchNorm2d:
        """Return the same map, in evaluation mode, as an ordinary batch norm."""
        layer = nn.BatchNorm2d(2 * self.num_features, eps=self.eps).eval()
        both = {
            name: torch.cat([value, value]) if value.dim() else value
            for name, value in self.state_dict().items()
        }
        layer.load_state_dict(both)
        return layer


class MirrorCentre(nn.Module):
    """It normalises embeddings, without affine part; odd values have mean 0 and keep their sign."""

    def __init__(self, embedding: int) -> None:
        super().__init__()
        self.even = nn.BatchNorm1d(embedding // 2, affine=False)
        self.odd = nn.BatchNorm1d(embedding // 2, affine=False)

    def forward(self, z: Tensor) -> Tensor:
        """Map [N, D] to [N, D]."""
        even, odd = z.chunk(2, dim=-1)
        # A batch and its mirror image have mean 0, and so has the running mean.
        both = self.odd(torch.cat([odd, -odd]))
        return torch.cat([self.even(even), both[: z.shape[0]]], dim=-1)


def flatten_twins(x: Tensor) -> Tensor:
    """Map twins' features [N, C, H, W] to twins [N, C · H · W] in no place: none is flipped."""
    right, left = x.chunk(2, dim=1)
    return torch.cat([right.flatten(1), left.flip(-1).flatten(1)], dim=-1)


def unflatten_twins(x: Tensor, channels: int, height: int, width: int) -> Tensor:
    """Undo :func:`flatten_twins`: map twins [N, C · H · W] to features [N, C, H, W]."""
    right, left = x.reshape(-1, channels, height, width).chunk(2, dim=1)
    return torch.cat([right, left.flip(-1)], dim=1)
