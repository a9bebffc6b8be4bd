"""Codecs ``float32`` and ``float16`` send every value as a floating-point number."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

from hjepa_cli.core.control.codecs.codec import Codec

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Float:
    """Sends every value as a floating-point number."""

    half: bool

    def send(self, z: Tensor) -> Tensor:
        return (z.half() if self.half else z).float()


def _codec(bits_per_value: int) -> Codec:
    return Codec(
        f"float{bits_per_value}",
        bits=lambda embedding: embedding * bits_per_value,
        fit=lambda model, settings: Float(half=bits_per_value == 16),
    )


FLOAT32, FLOAT16 = _codec(32), _codec(16)
