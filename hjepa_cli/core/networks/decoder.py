"""The decoder of the auto-encoder: an embedding in, the encoder's input out."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hjepa_cli.core.networks.encoder import MAP_PX, STEM_PX
from hjepa_cli.core.networks.symmetry import (
    MirrorConv2d,
    MirrorLinear,
    MirrorNorm2d,
    Signs,
    Twins,
    embedding_signs,
    unflatten_twins,
)
from hjepa_cli.core.plants.frames import CHANNELS, HEIGHT_PX, WIDTH_PX

MAPS = (128, 128, 64, 32)  # channels at 1/32, 1/16, 1/8 and 1/4 of the picture's size
STEPS = len(MAPS) - 1


class Decoder(nn.Module):
    """Embeddings [N, D] → what the encoder saw of the frames, standardised [N, 3κ, 64, 128].

    The encoder backwards: a linear layer makes a 2 × 4 map, which is enlarged by copying pixels
    between 3 × 3 convolutions with batch norm; at last every value of the map becomes a square.

    Args:
        embedding: D.
        frames: κ.
        symmetric: reflected embeddings give mirrored pictures.
    """

    input_mean: Tensor
    input_std: Tensor

    def __init__(self, embedding: int, frames: int = 2, symmetric: bool = False) -> None:
        super().__init__()
        self.symmetric = symmetric
        height, width = HEIGHT_PX // MAP_PX, WIDTH_PX // MAP_PX
        self.map = (MAPS[0], height, width)
        self.expand: nn.Module = nn.Linear(embedding, MAPS[0] * height * width)
        convolution: type[nn.Conv2d] = nn.Conv2d
        norm: type[nn.BatchNorm2d] = nn.BatchNorm2d
        if symmetric:
            units = Twins(MAPS[0] * height * width)
            self.expand = MirrorLinear(Signs(embedding_signs(embedding)), units)
            convolution, norm = MirrorConv2d, MirrorNorm2d
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
        """[N, D] → float32 [N, 3κ, 64, 128]."""
        x = F.relu(self.expand(z))
        channels, height, width = self.map
        if self.symmetric:
            x = unflatten_twins(x, channels, height, width)
        else:
            x = x.reshape(-1, channels, height, width)
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            x = F.relu(norm(convolution(F.interpolate(x, scale_factor=2.0))))
        weight = self.paint.weight
        if self.symmetric:  # the left twin paints with a mirrored brush
            weight = torch.cat([weight, weight.flip(-1)])
        return F.conv_transpose2d(x, weight, self.paint.bias, stride=STEM_PX).float()

    def standardise(self, inputs: Tensor) -> Tensor:
        """What :meth:`forward` should have painted: inputs [N, 3κ, 64, 128] in its units."""
        return (inputs.float() - self.input_mean[:, None, None]) / self.input_std[:, None, None]

    def restore(self, z: Tensor) -> Tensor:
        """Embeddings [N, D] → the encoder's inputs [N, 3κ, 64, 128], in grey levels."""
        painted: Tensor = self(z)
        return painted * self.input_std[:, None, None] + self.input_mean[:, None, None]
