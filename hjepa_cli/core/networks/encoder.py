"""The context encoder Ψ turns camera frames into one embedding (paper §III-A).

A residual network with three stages of 64, 128 and 256 channels keeps a 2 × 4 map to its last
layer, because a cart-pole is where things are: global average pooling would throw the positions
away. Frames of other sizes have as many stages as leave two to four rows (or columns, where there
are fewer of them). Frames travel as uint8 [N, κ, H, W, C], the current one last, which is already
channels-last memory, the layout the convolutions are fastest in.
"""

import copy
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import fuse_conv_bn_eval

from hjepa_cli.config.schema import Look
from hjepa_cli.core.networks.photometry import against_background
from hjepa_cli.core.networks.symmetry import (
    MirrorCentre,
    MirrorConv2d,
    MirrorNorm2d,
    embedding_signs,
    flatten_twins,
    linear_layers,
)
from hjepa_cli.core.plants.frames import FRAME_SHAPE

CACHED_VALUES = 2**19  # of frames prepared at a time: more do not stay in a core's own cache
STEM_PX, STEM_CHANNELS = 4, 64
MAP_CHANNELS = 128
LEAST_ROWS = 2  # of the last map
WIDEST = 256  # channels of a stage


def stages_of(height_px: int, width_px: int) -> int:
    """Return how many stages of stride 2 follow the stem, at least one."""
    return max(int(math.log2(min(height_px, width_px) / (STEM_PX * LEAST_ROWS))), 1)


def map_of(height_px: int, width_px: int) -> tuple[int, int]:
    """Return rows and columns of the last map; a value stands for that share of the picture.

    Where they do not divide the picture, it is widened by copies of its border.
    """
    pixels = STEM_PX * 2 ** stages_of(height_px, width_px)
    return -(-height_px // pixels), -(-width_px // pixels)


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
    """Ψ_θ maps uint8 frames [N, κ, H, W, C] to embeddings [N, D] of length √D.

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
        look: how many control steps back the κ frames lie, the oldest first, the present one last.
        frame_shape: (H, W, C).
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
        look: Look = (1, 0),
        frame_shape: tuple[int, int, int] = FRAME_SHAPE,
        photometric: str = "none",
    ) -> None:
        super().__init__()
        self.embedding, self.frame_input, self.symmetric = embedding, frame_input, symmetric
        self.photometric, self.look = photometric, look
        *size, colours = frame_shape
        channels, rows_columns = len(look) * colours, map_of(*size)
        pixels = STEM_PX * 2 ** stages_of(*size)
        self.border_px = tuple(pixels * n - px for n, px in zip(rows_columns, size, strict=True))
        widths = [min(STEM_CHANNELS * 2**i, WIDEST) for i in range(stages_of(*size))]
        self.register_buffer("input_mean", torch.zeros(channels))
        self.register_buffer("input_std", torch.ones(channels))
        halves = 2 if symmetric else 1
        self.stem = nn.Conv2d(channels, STEM_CHANNELS // halves, STEM_PX, STEM_PX, bias=False)
        self.stem_norm = (MirrorNorm2d if symmetric else nn.BatchNorm2d)(STEM_CHANNELS)
        self.stages = nn.Sequential(
            *(
                ResidualBlock(into, out, 2, symmetric=symmetric)
                for into, out in pairwise([STEM_CHANNELS, *widths])
            )
        )
        features = MAP_CHANNELS * math.prod(rows_columns)
        last = (MirrorConv2d if symmetric else nn.Conv2d)(widths[-1], MAP_CHANNELS, 1, bias=True)
        self.squeeze = last
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
        """Measure mean and deviation of every channel on uint8 frames [N, κ, H, W, C]."""
        inputs = self.inputs(frames)
        flat = inputs.permute(0, 2, 3, 1).reshape(-1, inputs.shape[1]).float()
        self.input_mean.copy_(flat.mean(0))
        self.input_std.copy_(flat.std(0).clamp_min(1e-3))

    def forward(self, frames: Tensor) -> Tensor:
        """Map uint8 frames [N, κ, H, W, C] to float32 embeddings [N, D]."""
        return self.embed(self.inputs(frames))

    def embed(self, x: Tensor) -> Tensor:
        """Map what :meth:`inputs` returns, [N, Cκ, H, W], to float32 embeddings [N, D]."""
        if not torch.is_autocast_enabled(x.device.type):
            x = x.float()
        x = self._widened(x)
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

    def _widened(self, x: Tensor) -> Tensor:
        """Repeat the border of pictures [N, C, H, W] until all stages divide them."""
        if not any(self.border_px):
            return x
        (top, bottom), (left, right) = ((px // 2, px - px // 2) for px in self.border_px)
        return F.pad(x, (left, right, top, bottom), mode="replicate")

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
        """Return what the network sees of frames [N, κ, H, W, C], the present first.

        It is [N, Cκ, H, W] in bfloat16: pixels and their differences are exact in it. Pixels that
        are fitted to their background are float32, and rounded where networks compute in bfloat16,
        but their differences before that.
        """
        few = _few(frames, math.prod(frames.shape[1:]))
        parts = [torch.cat(self._parts(self.fitted(part)), -1) for part in torch.split(frames, few)]
        # [N, H, W, C] memory seen as [N, C, H, W]: channels-last for free.
        return torch.cat(parts).permute(0, 3, 1, 2)

    def inputs_of(self, pictures: Sequence[Tensor]) -> Tensor:
        """Return what :meth:`inputs` does, of κ pictures [N, H, W, C] that are fitted already.

        The present ones come first.
        """
        few = _few(pictures[0], len(pictures) * math.prod(pictures[0].shape[1:]))
        channels = len(pictures) * pictures[0].shape[-1]
        x = pictures[0].new_empty(*pictures[0].shape[:-1], channels, dtype=self._dtype(pictures[0]))
        split = (torch.split(one, few) for one in (x, *pictures))
        for into, *part in zip(*split, strict=True):
            torch.cat(self._parts(part), -1, out=into)
        return x.permute(0, 3, 1, 2)

    def fitted(self, frames: Tensor) -> list[Tensor]:
        """Return the κ pictures [N, H, W, C] of frames, fitted to their background, float32.

        The present ones come first.
        """
        if self.photometric == "none":
            return [frame.float() for frame in reversed(frames.unbind(1))]
        fitted = against_background(frames.flatten(0, 1), self.photometric)
        return [*reversed(fitted.view(frames.shape).unbind(1))]

    def fitted_one(self, frames: Tensor) -> Tensor:
        """Return the pictures [N, H, W, C] of frames [N, 1, H, W, C], fitted, some at a time."""
        few = _few(frames, math.prod(frames.shape[1:]))
        return torch.cat([self.fitted(part)[0] for part in torch.split(frames, few)])

    def _parts(self, seen: Sequence[Tensor]) -> list[Tensor]:
        """Return what the network sees of fitted pictures, each [N, H, W, C]."""
        earlier = seen[1:]
        if self.frame_input == "difference":
            earlier = [later - before for later, before in pairwise(seen)]
        dtype = self._dtype(seen[0])
        return [part.to(dtype) for part in (seen[0], *earlier)]

    def _dtype(self, pictures: Tensor) -> torch.dtype:
        rounded = self.photometric == "none" or torch.is_autocast_enabled(pictures.device.type)
        return torch.bfloat16 if rounded else torch.float32


def _few(frames: Tensor, values: int) -> int:
    """Return how many packets of so many values to take at a time."""
    few = len(frames)
    if frames.device.type == "cpu":
        few = max(CACHED_VALUES // values, 1)
    return few or 1


def _fold(module: nn.Module, convolution: str, norm: str) -> None:
    """Move one batch norm's running statistics and affine part into its convolution, for good."""
    conv, batch_norm = getattr(module, convolution), getattr(module, norm)
    if isinstance(conv, MirrorConv2d):
        conv, batch_norm = conv.ordinary(), batch_norm.ordinary()
    elif isinstance(batch_norm, MirrorNorm2d):  # the stem's, whose twins are whole by then
        batch_norm = batch_norm.ordinary()
    setattr(module, convolution, fuse_conv_bn_eval(conv, batch_norm))
    setattr(module, norm, nn.Identity())
