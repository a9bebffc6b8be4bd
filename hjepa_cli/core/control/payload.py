"""What one transmission carries: a quantised embedding, or raw camera frames.

An embedding travels as one small integer per value and one 16-bit scale per vector. The closed
loop really quantises and dequantises, so the bits counted here are bits the controller lives on.
"""

import torch
from torch import Tensor

from hjepa_cli.errors import UsageError

SCALE_BITS = 16
_SCALE_MAX = torch.finfo(torch.float16).max


def quantise(z: Tensor, bits_per_value: int) -> Tensor:
    """Send embeddings through the quantiser: what the controller receives for ``z``.

    Args:
        z: embeddings [n, D].
        bits_per_value: bits of one value, sign included.

    Returns:
        Dequantised embeddings [n, D], float32.

    Raises:
        UsageError: ``bits_per_value`` is not in 2 … 16.
    """
    return dequantise(*encode(z, bits_per_value), bits_per_value)


def encode(z: Tensor, bits_per_value: int) -> tuple[Tensor, Tensor]:
    """Quantise uniformly between ± the largest magnitude of each vector.

    The scale is rounded to float16 first and the codes are taken against the rounded one, as the
    receiver knows no other.

    Returns:
        Codes [n, D], int16 in ± (2^(bits - 1) - 1), and scales [n], float16.

    Raises:
        UsageError: ``bits_per_value`` is not in 2 … 16.
    """
    top = _largest_code(bits_per_value)
    scale = z.abs().amax(dim=-1).clamp(max=_SCALE_MAX).to(torch.float16)
    # A scale that rounds to zero in float16 stands for a zero vector; 1 only avoids 0 / 0.
    step = torch.where(scale > 0, scale, torch.inf).float().unsqueeze(-1) / top
    codes = torch.round(z.float() / step).clamp(-top, top).to(torch.int16)
    return codes, scale


def dequantise(codes: Tensor, scale: Tensor, bits_per_value: int) -> Tensor:
    """Invert :func:`encode`: codes [n, D] and scales [n] → embeddings [n, D], float32."""
    return codes.float() * (scale.float().unsqueeze(-1) / _largest_code(bits_per_value))


def payload_bits(values: int, bits_per_value: int) -> int:
    """Bits of one embedding transmission, its scale included: 256 values of 8 bits are 2,064."""
    _largest_code(bits_per_value)
    return values * bits_per_value + SCALE_BITS


def raw_frame_bits(frames: int, height_px: int, width_px: int) -> int:
    """Bits of κ uncompressed RGB frames at 8 bits per channel: two of 64 × 128 are 393,216."""
    return frames * height_px * width_px * 3 * 8


def _largest_code(bits_per_value: int) -> int:
    if not 2 <= bits_per_value <= 16:
        raise UsageError(
            f"payload of {bits_per_value} bits per value; choose a whole number from 2 to 16"
        )
    return int(2 ** (bits_per_value - 1) - 1)
