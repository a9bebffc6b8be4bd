"""The decoder of the auto-encoder turns an embedding into what the encoder saw."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.encoder import STEM_PX, Encoder, map_of, stages_of
from hjepa_cli.core.networks.symmetry import (
    MirrorConv2d,
    MirrorNorm2d,
    embedding_signs,
    linear_layers,
    unflatten_twins,
)
from hjepa_cli.core.plants.frames import FRAME_SHAPE

FINEST, WIDEST = 32, 128  # channels at 1/4 of the picture's size, doubled with every halving


class Decoder(nn.Module):
    """It paints, from embeddings [N, D], what the encoder saw, standardised [N, Cκ, H, W].

    It is the encoder backwards: a linear layer makes its last map, which is enlarged by copying
    pixels between 3 × 3 convolutions with batch norm; at last every value becomes a square.
    ``symmetric`` ones answer reflected embeddings by mirrored pictures.
    """

    input_mean: Tensor
    input_std: Tensor

    def __init__(
        self,
        embedding: int,
        frames: int = 2,
        symmetric: bool = False,
        frame_shape: tuple[int, int, int] = FRAME_SHAPE,
    ) -> None:
        super().__init__()
        self.symmetric, (*size, colours) = symmetric, frame_shape
        steps = stages_of(*size)
        widths = [min(FINEST * 2 ** (steps - i), WIDEST) for i in range(steps + 1)]
        self.size, self.map = size, (widths[0], *map_of(*size))
        units = math.prod(self.map)
        (self.expand,) = linear_layers(embedding_signs(embedding), units, mirrored=symmetric)
        convolution = MirrorConv2d if symmetric else nn.Conv2d
        norm = MirrorNorm2d if symmetric else nn.BatchNorm2d
        self.convolutions = nn.ModuleList(
            convolution(into, out, 3, 1, 1, bias=False) for into, out in pairwise(widths)
        )
        self.norms = nn.ModuleList(norm(channels) for channels in widths[1:])
        halves, channels = 2 if symmetric else 1, frames * colours
        self.paint = nn.ConvTranspose2d(widths[-1] // halves, channels, STEM_PX, STEM_PX)
        self.register_buffer("input_mean", torch.zeros(channels))
        self.register_buffer("input_std", torch.ones(channels))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, z: Tensor) -> Tensor:
        """Map embeddings [N, D] to float32 pictures [N, Cκ, H, W]."""
        x = F.relu(self.expand(z))
        if self.symmetric:
            x = unflatten_twins(x, *self.map)
        else:
            x = x.reshape(-1, *self.map)
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = F.relu(norm(convolution(F.interpolate(x, scale_factor=2.0))))
        weight = self.paint.weight
        if self.symmetric:  # the left twin paints with a mirrored brush
            weight = torch.cat([weight, weight.flip(-1)])
        painted = F.conv_transpose2d(x, weight, self.paint.bias, stride=STEM_PX).float()
        height_px, width_px = self.size  # without the border that the encoder added
        top, left = (painted.shape[2] - height_px) // 2, (painted.shape[3] - width_px) // 2
        return painted[:, :, top : top + height_px, left : left + width_px]

    def standardise(self, inputs: Tensor) -> Tensor:
        """Return what :meth:`forward` should have painted of inputs [N, Cκ, H, W]."""
        return (inputs.float() - self.input_mean[:, None, None]) / self.input_std[:, None, None]

    def restore(self, z: Tensor) -> Tensor:
        """Map embeddings [N, D] to the encoder's inputs [N, Cκ, H, W], in grey levels."""
        painted: Tensor = self(z)
        return painted * self.input_std[:, None, None] + self.input_mean[:, None, None]


def read_frames(networks: nn.ModuleDict, frames: Tensor) -> Tensor:
    """Return the embeddings [N, D] that the actor gets of frames uint8 [N, κ, H, W, C].

    With a decoder among the networks they are those of the reconstructed frames.
    """
    z: Tensor = networks["encoder"](frames)
    if "decoder" not in networks:
        return z
    decoder, reader = networks["decoder"], networks["reader"]
    assert isinstance(decoder, Decoder) and isinstance(reader, Encoder)
    return reader.embed(decoder.restore(z))
