"""From camera frames to embeddings, with or without a decoder in between."""

from torch import Tensor, nn

from hjepa_cli.core.networks.decoder import Decoder
from hjepa_cli.core.networks.encoder import Encoder


def read_frames(networks: nn.ModuleDict, frames: Tensor) -> Tensor:
    """The embeddings [N, D] that the actor listens to, from frames uint8 [N, κ, 64, 128, 3].

    With a decoder among the networks they are those of the reconstructed frames.
    """
    z: Tensor = networks["encoder"](frames)
    if "decoder" not in networks:
        return z
    decoder, reader = networks["decoder"], networks["reader"]
    assert isinstance(decoder, Decoder) and isinstance(reader, Encoder)
    return reader.embed(decoder.restore(z))
