"""Codecs ``int2`` … ``int16`` send small integers, with one 16-bit scale per vector."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import TYPE_CHECKING

from hjepa_cli.core.control.codecs.codec import Codec, CodecFamily
from hjepa_cli.errors import UsageError

if TYPE_CHECKING:
    from torch import Tensor

SCALE_BITS = 16
_LARGEST_SCALE = 65_504.0  # in float16


@dataclasses.dataclass(frozen=True)
class Integers:
    """Quantises values uniformly between ± the largest magnitude of each vector.

    Raises:
        UsageError: ``bits_per_value``, sign included, is not in 2 … 16.
    """

    embedding: int
    bits_per_value: int

    def __post_init__(self) -> None:
        if not 2 <= self.bits_per_value <= 16:
            raise UsageError(
                f"payload of {self.bits_per_value} bits per value; choose a whole number from 2 "
                "to 16"
            )

    @property
    def bits(self) -> int:
        """Return the bits of a transmission: 256 values of 8 bits and a scale are 2,064."""
        return self.embedding * self.bits_per_value + SCALE_BITS

    def send(self, z: Tensor) -> Tensor:
        return self.decode(*self.encode(z))

    def encode(self, z: Tensor) -> tuple[Tensor, Tensor]:
        """Quantise embeddings [n, D].

        The scale is rounded to float16 first and the codes are taken against the rounded one, as
        the receiver knows no other. It is rounded up where the largest value would else lie more
        than half a step beyond the last code: so no value is off by more.

        Returns:
            Codes [n, D], int16 in ± (2^(bits - 1) - 1), and scales [n], float16.
        """
        import torch  # when there is something to send

        largest = z.abs().amax(dim=-1).clamp(max=_LARGEST_SCALE).float()
        scale = largest.half()
        short = (scale > 0) & (largest > scale.float() * (1 + 0.5 / self._top))
        scale = (scale.view(torch.int16) + short.short()).view(torch.half)  # the next float16
        # A scale that rounds to zero in float16 stands for a zero vector; ∞ only avoids 0 / 0.
        step = scale.float().where(scale > 0, math.inf).unsqueeze(-1) / self._top
        codes = (z.float() / step).round().clamp(-self._top, self._top).short()
        return codes, scale

    def decode(self, codes: Tensor, scale: Tensor) -> Tensor:
        """Invert :meth:`encode`: codes [n, D] and scales [n] → embeddings [n, D], float32."""
        return codes.float() * (scale.float().unsqueeze(-1) / self._top)

    @property
    def _top(self) -> int:
        return int(2 ** (self.bits_per_value - 1) - 1)


def _member(name: str) -> Codec | None:
    found = re.fullmatch(r"int(\d{1,2})", name)
    if not found or not 2 <= (bits := int(found[1])) <= 16:
        return None
    return Codec(
        name,
        bits=lambda embedding: Integers(embedding, bits).bits,
        fit=lambda model, settings: Integers(model.architecture["embedding"], bits),
    )


INTEGERS = CodecFamily("int2 … int16", _member, "int2 … int16")
