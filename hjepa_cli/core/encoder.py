"""The context encoder Ψ: two camera frames in, one embedding out (paper §III-A).

A residual network with three stages of 64, 128 and 256 channels keeps a 4 × 8 map to its last
layer, because a cart-pole is where things are: global average pooling would throw the positions
away. Frames travel as uint8 [N, 2, H, W, 3] (previous, current), which is already channels-last
memory, the layout the convolutions are fastest in.
"""

import copy
import math
from typing import Self

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import fuse_conv_bn_eval

HEIGHT_PX, WIDTH_PX, CHANNELS = 64, 128, 3
STEM_PX = 4
MAP_CHANNELS = 32
CENTRE_OFFSET = 1.0


def normalise(z: Tensor) -> Tensor:
    """Scale embeddings [..., D] to length √D: unit mean square, whatever the encoder put out.

    The cosine loss ignores lengths; fixing them here gives actor and predictors, which do see
    them, one scale for encoded and predicted embeddings.
    """
    unit: Tensor = F.normalize(z, dim=-1)
    return unit * math.sqrt(z.shape[-1])


class ResidualBlock(nn.Module):
    """Two 3 × 3 convolutions with batch norm around a (projected) identity."""

    def __init__(self, channels_in: int, channels_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(channels_out)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(channels_out)
        self.project = nn.Conv2d(channels_in, channels_out, 1, stride, bias=False)
        self.project_norm = nn.BatchNorm2d(channels_out)

    def forward(self, x: Tensor) -> Tensor:
        """[N, channels_in, H, W] → [N, channels_out, H / stride, W / stride]."""
        y = F.relu(self.norm1(self.conv1(x)))
        return F.relu(self.norm2(self.conv2(y)) + self.project_norm(self.project(x)))

    def fold(self) -> None:
        """Move the batch norms into the convolutions, for good."""
        _fold(self, "conv1", "norm1")
        _fold(self, "conv2", "norm2")
        _fold(self, "project", "project_norm")


class Encoder(nn.Module):
    """Ψ_θ: uint8 frames [N, 2, 64, 128, 3] → embeddings [N, D] of length √D.

    Args:
        embedding: D, 256 in the paper.
        frame_input: ``"difference"`` feeds [current, current − previous], each standardised by
            its own training statistics, which makes the sub-pixel velocity signal visible;
            ``"pair"`` feeds [current, previous] (the paper).
        centre: batch-normalise z (no affine) before its length is fixed, then add a constant to
            every value. Centred embeddings alone have no direction at the mean state, the upright
            pole of all states; with an offset as long as themselves, fixing their length bends
            them little there and the states stay linearly readable (docs/LOG.md).
    """

    input_mean: Tensor
    input_std: Tensor

    def __init__(self, embedding: int, frame_input: str, centre: bool) -> None:
        super().__init__()
        self.frame_input = frame_input
        self.register_buffer("input_mean", torch.zeros(2 * CHANNELS))
        self.register_buffer("input_std", torch.ones(2 * CHANNELS))
        self.stem = nn.Conv2d(2 * CHANNELS, 64, STEM_PX, STEM_PX, bias=False)
        self.stem_norm = nn.BatchNorm2d(64)
        self.stages = nn.Sequential(
            ResidualBlock(64, 64, 2), ResidualBlock(64, 128, 2), ResidualBlock(128, 256, 1)
        )
        map_size = (HEIGHT_PX // (STEM_PX * 4)) * (WIDTH_PX // (STEM_PX * 4))
        self.squeeze = nn.Conv2d(256, MAP_CHANNELS, 1)
        self.head = nn.Linear(MAP_CHANNELS * map_size, embedding)
        self.centre = nn.BatchNorm1d(embedding, affine=False) if centre else None
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def fit_standardisation(self, frames: Tensor) -> None:
        """Measure per-channel mean and standard deviation of both inputs.

        Args:
            frames: uint8 [N, 2, 64, 128, 3], (previous, current).
        """
        flat = self._inputs(frames).permute(0, 2, 3, 1).reshape(-1, 2 * CHANNELS).float()
        self.input_mean.copy_(flat.mean(0))
        self.input_std.copy_(flat.std(0).clamp_min(1e-3))

    def forward(self, frames: Tensor) -> Tensor:
        """uint8 frames [N, 2, 64, 128, 3] → float32 embeddings [N, D]."""
        x = self._inputs(frames)
        if not torch.is_autocast_enabled(x.device.type):
            x = x.float()
        x = F.relu(self.stem_norm(F.conv2d(x, *self._stem(), stride=STEM_PX)))
        x = F.relu(self.squeeze(self.stages(x)))
        z = self.head(x.flatten(1)).float()
        return normalise(z if self.centre is None else self.centre(z) + CENTRE_OFFSET)

    @torch.no_grad()
    def folded(self) -> Self:
        """A copy for inference, with all batch norms inside the convolutions: same z, sooner."""
        frozen = copy.deepcopy(self).eval()
        weight, offset = frozen._stem()
        frozen.stem.weight, frozen.stem.bias = nn.Parameter(weight), nn.Parameter(offset)
        _fold(frozen, "stem", "stem_norm")
        frozen.input_mean.zero_()
        frozen.input_std.fill_(1.0)
        for block in frozen.modules():
            if isinstance(block, ResidualBlock):
                block.fold()
        return frozen

    def _stem(self) -> tuple[Tensor, Tensor]:
        """The stem's weights and offset with the standardisation inside.

        The same sum, (w/s)·x − Σ(w/s)·m, without three passes over the pixels.
        """
        weight = self.stem.weight / self.input_std[:, None, None]
        offset = -(weight * self.input_mean[:, None, None]).sum((1, 2, 3))
        return weight, offset if self.stem.bias is None else offset + self.stem.bias

    def _inputs(self, frames: Tensor) -> Tensor:
        """Both inputs [N, 6, H, W] in bfloat16: pixels and their differences are exact in it."""
        previous, current = frames[:, 0].bfloat16(), frames[:, 1].bfloat16()
        second = current - previous if self.frame_input == "difference" else previous
        # [N, H, W, C] memory seen as [N, C, H, W]: channels-last for free.
        return torch.cat([current, second], dim=-1).permute(0, 3, 1, 2)


def _fold(module: nn.Module, convolution: str, norm: str) -> None:
    """Move one batch norm's running statistics and affine part into its convolution."""
    fused = fuse_conv_bn_eval(getattr(module, convolution), getattr(module, norm))
    setattr(module, convolution, fused)
    setattr(module, norm, nn.Identity())
