"""The context encoder Ψ turns camera frames into one embedding (paper §III-A).

A residual network with three stages of 64, 128 and 256 channels keeps a 2 × 4 map to its last
layer, because a cart-pole is where things are: global average pooling would throw the positions
away. Frames travel as uint8 [N, κ, H, W, 3], the current one last, which is already channels-last
memory, the layout the convolutions are fastest in.
"""

import copy
import math
from itertools import pairwise
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import fuse_conv_bn_eval

from hjepa_cli.core.networks.photometry import against_background
from hjepa_cli.core.networks.symmetry import (
    MirrorCentre,
    MirrorConv2d,
    MirrorNorm2d,
    embedding_signs,
    flatten_twins,
    linear_layers,
)
from hjepa_cli.core.plants.frames import CHANNELS, HEIGHT_PX, WIDTH_PX

STEM_PX, STEM_CHANNELS = 4, 64
MAP_PX, MAP_CHANNELS = 32, 128  # a value of the last map stands for that many pixels, squared


def normalise(z: Tensor) -> Tensor:
    """Scale embeddings [..., D] to length √D: unit mean square, whatever the encoder put out.

    The cosine loss ignores lengths; fixing them here gives actor and predictors, which do see
    them, one scale for encoded and predicted embeddings.
    """
    unit: Tensor = F.normalize(z, dim=-1)
    return unit * math.sqrt(z.shape[-1])


class ResidualBlock(nn.Module):
    """It adds two convolutions with batch norm to a projected identity.

    A stride is taken by a kernel as wide as itself and by averaging on the way around: such grids
    have mirror images (:mod:`hjepa_cli.core.networks.symmetry`).
    """

    def __init__(
        self, channels_in: int, channels_out: int, stride: int, *, symmetric: bool = False
    ) -> None:
        super().__init__()
        conv = MirrorConv2d if symmetric else nn.Conv2d
        norm = MirrorNorm2d if symmetric else nn.BatchNorm2d
        kernel, padding = (3, 1) if stride == 1 else (stride, 0)
        self.conv1 = conv(channels_in, channels_out, kernel, stride, padding, bias=False)
        self.norm1 = norm(channels_out)
        self.conv2 = conv(channels_out, channels_out, 3, 1, 1, bias=False)
        self.norm2 = norm(channels_out)
        self.shrink = nn.AvgPool2d(stride) if stride > 1 else nn.Identity()
        self.project = conv(channels_in, channels_out, 1, bias=False)
        self.project_norm = norm(channels_out)

    def forward(self, x: Tensor) -> Tensor:
        """Map [N, channels_in, H, W] to [N, channels_out, H / stride, W / stride]."""
        y = F.relu(self.norm1(self.conv1(x)))
        return F.relu(self.norm2(self.conv2(y)) + self.project_norm(self.project(self.shrink(x))))


class Encoder(nn.Module):
    """Ψ_θ maps uint8 frames [N, κ, 64, 128, 3] to embeddings [N, D] of length √D.

    Args:
        embedding: D, 256 in the paper.
        frame_input: ``"difference"`` feeds [current, current − previous], each standardised by
            its own training statistics, which makes the sub-pixel velocity signal visible;
            ``"pair"`` feeds [current, previous] (the paper).
        centre: whether z is batch-normalised (no affine) before its length is fixed, and then a
            constant added to every value. Centred embeddings alone have no direction at the mean
            state, the upright pole of all states; with an offset as long as themselves, fixing
            their length bends them little there and states stay linearly readable (docs/LOG.md).
        symmetric: whether the embedding of a mirrored picture is the reflected embedding; D is
            even then, and the offset is on the even half.
        frames, frame_gap: κ, the current one and κ − 1 earlier ones, and the steps between them.
        photometric: whether every frame is fitted to its background first, and by what; see
            :func:`~hjepa_cli.core.networks.photometry.against_background`.
    """

    input_mean: Tensor
    input_std: Tensor
    offset: Tensor

    def __init__(
        self,
        embedding: int,
        frame_input: str,
        centre: bool,
        symmetric: bool = False,
        frames: int = 2,
        photometric: str = "none",
        frame_gap: int = 1,
    ) -> None:
        super().__init__()
        self.embedding, self.frame_input, self.symmetric = embedding, frame_input, symmetric
        self.photometric, self.look = photometric, (frames, frame_gap)
        channels = frames * CHANNELS
        self.register_buffer("input_mean", torch.zeros(channels))
        self.register_buffer("input_std", torch.ones(channels))
        halves = 2 if symmetric else 1
        self.stem = nn.Conv2d(channels, STEM_CHANNELS // halves, STEM_PX, STEM_PX, bias=False)
        self.stem_norm = (MirrorNorm2d if symmetric else nn.BatchNorm2d)(STEM_CHANNELS)
        self.stages = nn.Sequential(
            ResidualBlock(STEM_CHANNELS, 64, 2, symmetric=symmetric),
            ResidualBlock(64, 128, 2, symmetric=symmetric),
            ResidualBlock(128, 256, 2, symmetric=symmetric),
        )
        features = MAP_CHANNELS * (HEIGHT_PX // MAP_PX) * (WIDTH_PX // MAP_PX)
        self.squeeze = (MirrorConv2d if symmetric else nn.Conv2d)(256, MAP_CHANNELS, 1, bias=True)
        (self.head,) = linear_layers(features, embedding_signs(embedding), mirrored=symmetric)
        self.centre: nn.Module | None = None
        if centre:
            self.centre = (
                MirrorCentre(embedding) if symmetric else nn.BatchNorm1d(embedding, affine=False)
            )
        offset = torch.ones(embedding)
        if symmetric:
            offset[: embedding // 2] *= 2**0.5  # a reflection must not change it
            offset[embedding // 2 :] = 0.0
        self.register_buffer("offset", offset, persistent=False)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def fit_standardisation(self, frames: Tensor) -> None:
        """Measure mean and deviation of every channel on uint8 frames [N, κ, 64, 128, 3]."""
        inputs = self.inputs(frames)
        flat = inputs.permute(0, 2, 3, 1).reshape(-1, inputs.shape[1]).float()
        self.input_mean.copy_(flat.mean(0))
        self.input_std.copy_(flat.std(0).clamp_min(1e-3))

    def forward(self, frames: Tensor) -> Tensor:
        """Map uint8 frames [N, κ, 64, 128, 3] to float32 embeddings [N, D]."""
        return self.embed(self.inputs(frames))

    def embed(self, x: Tensor) -> Tensor:
        """Map what :meth:`inputs` returns, [N, 3κ, 64, 128], to float32 embeddings [N, D]."""
        if not torch.is_autocast_enabled(x.device.type):
            x = x.float()
        x = F.relu(self.stem_norm(F.conv2d(x, *self._stem(), stride=STEM_PX)))
        x = F.relu(self.squeeze(self.stages(x)))
        z = self.head(flatten_twins(x) if self.symmetric else x.flatten(1)).float()
        return normalise(z if self.centre is None else self.centre(z) + self.offset)

    @torch.no_grad()
    def folded(self) -> Self:
        """Return a copy for inference, all batch norms inside the convolutions: same z, sooner."""
        frozen = copy.deepcopy(self).eval()
        weight, offset = frozen._stem()
        frozen.stem = nn.Conv2d(weight.shape[1], STEM_CHANNELS, STEM_PX, STEM_PX).eval()
        frozen.stem.weight, frozen.stem.bias = nn.Parameter(weight), nn.Parameter(offset)
        _fold(frozen, "stem", "stem_norm")
        frozen.input_mean.zero_()
        frozen.input_std.fill_(1.0)
        for block in frozen.stages:
            for pair in (("conv1", "norm1"), ("conv2", "norm2"), ("project", "project_norm")):
                _fold(block, *pair)
        return frozen

    def _stem(self) -> tuple[Tensor, Tensor]:
        """Return the stem's weights and offset with the standardisation inside.

        The sum is the same, (w/s)·x − Σ(w/s)·m, without three passes over the pixels.
        """
        weight = self.stem.weight / self.input_std[:, None, None]
        offset = -(weight * self.input_mean[:, None, None]).sum((1, 2, 3))
        if self.stem.bias is not None:
            offset = offset + self.stem.bias
        if len(weight) < STEM_CHANNELS:  # a picture's twin is the picture through mirrored eyes
            weight, offset = torch.cat([weight, weight.flip(-1)]), torch.cat([offset, offset])
        return weight, offset

    def inputs(self, frames: Tensor) -> Tensor:
        """Return what the network sees of frames [N, κ, 64, 128, 3], the present first.

        It is [N, 3κ, 64, 128] in bfloat16: pixels and their differences are exact in it. Pixels
        that are fitted to their background are rounded there, but their differences before that.
        """
        if self.photometric == "none":
            seen = [frame.bfloat16() for frame in reversed(frames.unbind(1))]
        else:
            fitted = against_background(frames.flatten(0, 1), self.photometric)
            seen = [*reversed(fitted.view(frames.shape).unbind(1))]
        earlier = seen[1:]
        if self.frame_input == "difference":
            earlier = [later - before for later, before in pairwise(seen)]
        # [N, H, W, C] memory seen as [N, C, H, W]: channels-last for free.
        together = [part.bfloat16() for part in (seen[0], *earlier)]
        return torch.cat(together, dim=-1).permute(0, 3, 1, 2)


def _fold(module: nn.Module, convolution: str, norm: str) -> None:
    """Move one batch norm's running statistics and affine part into its convolution, for good."""
    conv, batch_norm = getattr(module, convolution), getattr(module, norm)
    if isinstance(conv, MirrorConv2d):
        conv, batch_norm = conv.ordinary(), batch_norm.ordinary()
    elif isinstance(batch_norm, MirrorNorm2d):  # the stem's, whose twins are whole by then
        batch_norm = batch_norm.ordinary()
    setattr(module, convolution, fuse_conv_bn_eval(conv, batch_norm))
    setattr(module, norm, nn.Identity())
