"""Codecs ``pca-NxB`` send the N strongest principal components with B bits each, and no scale.

Both ends know the components and their ranges. Fitting them needs embeddings but no labels and no
training.
"""

from __future__ import annotations

import dataclasses
import functools
import re
from typing import TYPE_CHECKING

from hjepa_cli.core.control.codecs.codec import Codec, CodecFamily
from hjepa_cli.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

    from hjepa_cli.config.schema import Settings
    from hjepa_cli.core.networks.model import Model

RANGE_MARGIN = 1.05  # of the largest coefficient seen; beyond, a coefficient is clipped


@dataclasses.dataclass(frozen=True, eq=False)
class PrincipalComponents:
    """Quantises the strongest principal components, each uniformly over its own range.

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

    def encode(self, z: Tensor) -> Tensor:
        """Encode embeddings [n, D] as codes [n, N], whole numbers in 0 … 2^B − 1."""
        levels = 2**self.bits_per_value
        share = ((z - self.mean) @ self.components.T / self.reach + 1) / 2
        codes: Tensor = (share * levels).floor().clamp(0, levels - 1).int()
        return codes

    def decode(self, codes: Tensor) -> Tensor:
        """Decode codes [n, N] into embeddings [n, D] of length √D, as the encoder makes them."""
        from hjepa_cli.core.networks.encoder import normalise

        levels = 2**self.bits_per_value
        coefficients = ((codes.float() + 0.5) / levels * 2 - 1) * self.reach
        return normalise(self.mean + coefficients @ self.components)

    def send(self, z: Tensor) -> Tensor:
        return self.decode(self.encode(z.float()))


def fit_components(z: Tensor, components: int, bits_per_value: int) -> PrincipalComponents:
    """Fit N ≤ D principal components of B bits each to embeddings [n, D]."""
    import torch

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
def training_embeddings(model: Model, settings: Settings) -> Tensor:
    """Embed some of the pictures of the training trajectories of the settings' seed [n, D]."""
    from hjepa_cli.core.control.embedded_split import sampled_embeddings

    return sampled_embeddings(model, settings, "train")


def _member(name: str) -> Codec | None:
    found = re.fullmatch(r"pca-(\d{1,3})x(\d{1,2})", name)
    if not found:
        return None
    components, bits = int(found[1]), int(found[2])
    if not (1 <= components <= 256 and 1 <= bits <= 16):
        return None

    def fit(model: Model, settings: Settings) -> PrincipalComponents:
        if components > (embedding := model.architecture["embedding"]):
            raise UsageError(f"payload {name}: the embedding has {embedding} values")
        return fit_components(training_embeddings(model, settings), components, bits)

    return Codec(name, bits=lambda embedding: components * bits, fit=fit, fitted=True)


PRINCIPAL_COMPONENTS = CodecFamily(
    "pca-NxB",
    _member,
    "pca-NxB for N principal components (1 to 256) of B bits (1 to 16), like pca-8x6",
)
