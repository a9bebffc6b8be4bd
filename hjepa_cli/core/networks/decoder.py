"""The decoder of the auto-encoder turns an embedding into what the encoder saw."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.encoder import MAP_PX, STEM_PX, Encoder
from hjepa_cli.core.networks.symmetry import (
    MirrorConv2d,
    MirrorNorm2d,
    embedding_signs,
    linear_layers,
    unflatten_twins,
)
from hjepa_cli.core.plants.frames import CHANNELS, HEIGHT_PX, WIDTH_PX

MAPS = (128, 128, 64, 32)  # channels at 1/32, 1/16, 1/8 and 1/4 of the picture's size
STEPS = len(MAPS) - 1


class Decoder(nn.Module):
    """It paints, from embeddings [N, D], what the encoder saw, standardised [N, 3κ, 64, 128].

    It is the encoder backwards: a linear layer makes a 2 × 4 map, which is enlarged by copying
    pixels between 3 × 3 convolutions with batch norm; at last every value becomes a square.
    ``symmetric`` ones answer reflected embeddings by mirrored pictures.
    """

    input_mean: Tensor
    input_std: Tensor

    def __init__(self, embedding: int, frames: int = 2, symmetric: bool = False) -> None:
        super().__init__()
        self.symmetric = symmetric
        self.map = (MAPS[0], HEIGHT_PX // MAP_PX, WIDTH_PX // MAP_PX)
        units = MAPS[0] * self.map[1] * self.map[2]
        (self.expand,) = linear_layers(embedding_signs(embedding), units, mirrored=symmetric)
        convolution = MirrorConv2d if symmetric else nn.Conv2d
        norm = MirrorNorm2d if symmetric else nn.BatchNorm2d
        self.convolutions = nn.ModuleList(
            convolution(MAPS[i], MAPS[i + 1], 3, 1, 1, bias=False) for i in range(STEPS)
        )
        self.norms = nn.ModuleList(norm(channels) for channels in MAPS[1:])
        halves = 2 if symmetric else 1
        self.paint = nn.ConvTranspose2d(MAPS[-1] // halves, frames * CHANNELS, STEM_PX, STEM_PX)
        self.register_buffer("input_mean", torch.zeros(frames * CHANNELS))
        self.register_buffer("input_std", torch.ones(frames * CHANNELS))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, z: Tensor) -> Tensor:
        """Map embeddings [N, D] to float32 pictures [N, 3κ, 64, 128]."""
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
        return F.conv_transpose2d(x, weight, self.paint.bias, stride=STEM_PX).float()

    def standardise(self, inputs: Tensor) -> Tensor:
        """Return what :meth:`forward` should have painted of inputs [N, 3κ, 64, 128]."""
        return (inputs.float() - self.input_mean[:, None, None]) / self.input_std[:, None, None]

    def restore(self, z: Tensor) -> Tensor:
        """Map embeddings [N, D] to the encoder's inputs [N, 3κ, 64, 128], in grey levels."""
        painted: Tensor = self(z)
        return painted * self.input_std[:, None, None] + self.input_mean[:, None, None]


def read_frames(networks: nn.ModuleDict, frames: Tensor) -> Tensor:
    """Return the embeddings [N, D] that the actor gets of frames uint8 [N, κ, 64, 128, 3].

    With a decoder among the networks they are those of the reconstructed frames.
    """
    z: Tensor = networks["encoder"](frames)
    if "decoder" not in networks:
        return z
    decoder, reader = networks["decoder"], networks["reader"]
    assert isinstance(decoder, Decoder) and isinstance(reader, Encoder)
    return reader.embed(decoder.restore(z))
