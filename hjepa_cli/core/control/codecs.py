"""How an embedding becomes bits: ``float32``, ``float16``, ``int2`` … ``int16``, or ``pca-8x6``.

``pca-NxB`` sends the N strongest principal components with B bits each and no scale: both ends know
the components and their ranges. Fitting them needs embeddings but no labels and no training.
"""

import dataclasses
import functools
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.checks import parse_payload
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.control.embedded_trajectories import embed_states
from hjepa_cli.core.control.payload import payload_bits, quantise
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.networks.encoder import normalise
from hjepa_cli.errors import UsageError

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

FLOATS = {"float32": torch.float32, "float16": torch.float16}
FIT_EMBEDDINGS = 2000
RANGE_MARGIN = 1.05  # of the largest coefficient seen; beyond, a coefficient is clipped


class Codec(Protocol):
    """One way to send embeddings."""

    @property
    def bits(self) -> int:
        """Bits of one transmission."""
        ...

    def send(self, z: Tensor) -> Tensor:
        """Embeddings [n, D] → what the controller receives [n, D], float32."""
        ...


def bits_of(name: str, embedding: int) -> int:
    """Bits of one transmission of an embedding with D values."""
    kind, bits, components = parse_payload(name)
    if kind in FLOATS:
        return embedding * bits
    return components * bits if kind == "pca" else payload_bits(embedding, bits)


def build_codec(name: str, model: "Model", settings: Settings) -> Codec:
    """The codec called ``name`` for a model's embeddings.

    Components are fitted to what the model sees on trajectories drawn from ``settings.seed``, so
    that they are the same wherever they are fitted.

    Raises:
        UsageError: no such payload, or more components than the embedding has values.
    """
    kind, bits, components = parse_payload(name)
    embedding = model.architecture["embedding"]
    if kind in FLOATS:
        return Float(embedding, FLOATS[kind])
    if kind == "int":
        return Integers(embedding, bits)
    if components > embedding:
        raise UsageError(f"payload {name}: the embedding has {embedding} values")
    return fit_pca(_typical_embeddings(model, settings), components, bits)


@dataclasses.dataclass(frozen=True)
class Float:
    """Every value as a floating-point number."""

    embedding: int
    dtype: torch.dtype

    @property
    def bits(self) -> int:
        return self.embedding * torch.finfo(self.dtype).bits

    def send(self, z: Tensor) -> Tensor:
        rounded: Tensor = z.to(self.dtype)
        return rounded.float()


@dataclasses.dataclass(frozen=True)
class Integers:
    """Every value as a small integer, with one 16-bit scale per vector."""

    embedding: int
    bits_per_value: int

    @property
    def bits(self) -> int:
        return payload_bits(self.embedding, self.bits_per_value)

    def send(self, z: Tensor) -> Tensor:
        return quantise(z, self.bits_per_value)


@dataclasses.dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """The strongest principal components, each quantised uniformly over its own range.

    Attributes:
        mean: of the embeddings [D].
        components: orthonormal rows [N, D], strongest first.
        reach: largest coefficient of each component [N]; coefficients are clipped there.
        bits_per_value: B.
    """

    mean: Tensor
    components: Tensor
    reach: Tensor
    bits_per_value: int

    @property
    def bits(self) -> int:
        return len(self.components) * self.bits_per_value

    def encode(self, z: Tensor) -> Tensor:
        """Embeddings [n, D] → codes [n, N], whole numbers in 0 … 2^B − 1."""
        levels = 2**self.bits_per_value
        share = ((z - self.mean) @ self.components.T / self.reach + 1) / 2
        codes: Tensor = (share * levels).floor().clamp(0, levels - 1).to(torch.int32)
        return codes

    def decode(self, codes: Tensor) -> Tensor:
        """Codes [n, N] → embeddings [n, D] of length √D, as the encoder makes them."""
        levels = 2**self.bits_per_value
        coefficients = ((codes.float() + 0.5) / levels * 2 - 1) * self.reach
        return normalise(self.mean + coefficients @ self.components)

    def send(self, z: Tensor) -> Tensor:
        return self.decode(self.encode(z.float()))


def fit_pca(z: Tensor, components: int, bits_per_value: int) -> PrincipalComponents:
    """Fit principal components to embeddings.

    Args:
        z: embeddings [n, D].
        components: N ≤ D.
        bits_per_value: B of each.
    """
    centred = z.double() - z.double().mean(0)
    # Eigenvectors of a D × D matrix; their signs are arbitrary, so the largest entry is positive.
    _, vectors = torch.linalg.eigh(centred.T @ centred)
    rows = vectors.flip(1).T[:components]
    largest = rows.gather(1, rows.abs().argmax(1, keepdim=True))
    rows = rows * largest.sign()
    reach = RANGE_MARGIN * (centred @ rows.T).abs().amax(0).clamp_min(1e-9)
    return PrincipalComponents(
        z.double().mean(0).float(), rows.float(), reach.float(), bits_per_value
    )


@functools.lru_cache(maxsize=1)  # methods of one run share it
def _typical_embeddings(model: "Model", settings: Settings) -> Tensor:
    """What the model sees on training trajectories of the settings' seed: embeddings [n, D]."""
    states = generate(settings, "train").states
    count = states.shape[2]
    pairs = np.stack([states[:, :-1], states[:, 1:]], axis=2).reshape(-1, 2, count)
    pairs = pairs[:: max(1, len(pairs) // FIT_EMBEDDINGS)]
    return embed_states(model, pairs)
