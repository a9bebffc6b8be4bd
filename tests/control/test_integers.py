"""Quantisation against an independent numpy implementation and published distortions."""

import numpy as np
import pytest
import torch

from hjepa_cli.core.control.codecs.integers import Integers
from hjepa_cli.core.plants.frames import FRAME_SHAPE, frame_bits
from hjepa_cli.errors import UsageError


def quantise(z: torch.Tensor, bits: int) -> torch.Tensor:
    return Integers(z.shape[-1], bits).send(z)


def reference(z: np.ndarray, bits: int) -> np.ndarray:
    """Absmax quantisation of one vector at a time, in double precision."""
    rows = []
    for row in z.astype(np.float64):
        top, largest = 2 ** (bits - 1) - 1, np.abs(row).max()
        scale = float(np.float16(largest))
        if largest - scale > scale / top / 2:  # beyond what the last code stands for
            scale = float(np.nextafter(np.float16(scale), np.float16(np.inf)))
        codes = np.clip(np.rint(row * top / scale), -top, top) if scale else np.zeros_like(row)
        rows.append(codes * scale / top)
    return np.array(rows)


@pytest.mark.parametrize("bits", [2, 3, 4, 8, 12, 16])
def test_equals_the_definition(bits: int) -> None:
    z = torch.randn(50, 256, generator=torch.Generator().manual_seed(0))
    received = quantise(z, bits).numpy()
    step = np.abs(z.numpy()).max(axis=1, keepdims=True) / (2 ** (bits - 1) - 1)
    # Single precision may round a value that lies halfway between two codes the other way.
    off = np.abs(received - reference(z.numpy(), bits)) / step
    assert (off < 5e-3).mean() > 0.999
    assert off.max() < 1.01


@pytest.mark.parametrize(
    ("bits", "one_minus_cos"), [(8, 2.4e-5), (4, 7.9e-3), (3, 4.1e-2), (2, 0.30)]
)
def test_distortion_of_gaussian_embeddings(bits: int, one_minus_cos: float) -> None:
    z = torch.randn(4000, 256, generator=torch.Generator().manual_seed(1))
    loss = 1 - torch.nn.functional.cosine_similarity(z.double(), quantise(z, bits).double())
    assert loss.mean().item() == pytest.approx(one_minus_cos, rel=0.05)


def test_codes_fit_their_bits_and_the_scale_its_sixteen() -> None:
    z = torch.tensor([[-3.0, 1.0, 3.0], [0.1, 0.2, -0.4]])
    codes, scale = Integers(3, 4).encode(z)
    assert scale.dtype == torch.float16
    assert codes.tolist() == [[-7, 2, 7], [2, 4, -7]]  # 0.2/0.4 * 7 = 3.5: rounds to even
    assert torch.equal(Integers(3, 4).decode(codes, scale), quantise(z, 4))


def test_a_scale_rounded_down_does_not_push_codes_out_of_range() -> None:
    largest = 1.0 + 2.0**-12  # float16 rounds it to 1
    codes, scale = Integers(2, 8).encode(torch.tensor([[largest, -largest]]))
    assert scale.item() == 1.0
    assert codes.tolist() == [[127, -127]]


@pytest.mark.parametrize("bits", range(2, 17))
def test_no_value_is_off_by_more_than_half_a_step(bits: int) -> None:
    """Above all the largest ones, whose scale float16 rounds down by up to 16 steps of int16."""
    chance = torch.Generator().manual_seed(0)
    z = torch.randn(2000, 64, generator=chance, dtype=torch.float64)
    z *= 10 ** (4 * torch.rand(2000, 1, generator=chance, dtype=torch.float64) - 2)
    z[:500, 0] = 1 + torch.arange(500) * 2.0**-14  # all ways to lie between two scales
    codes, scale = Integers(64, bits).encode(z.float())
    top = 2 ** (bits - 1) - 1
    assert codes.abs().max() <= top and codes.dtype == torch.int16
    steps = (scale.double() / top)[:, None]
    off = (codes.double() * steps - z.float().double()).abs() / steps
    assert off.max() <= 0.5 + top * 2.0**-23 + 1e-6  # codes are taken in single precision


def test_what_eight_bits_send_is_what_they_sent_before() -> None:
    """Published curves were measured through them: rounding up is for finer steps."""
    z = torch.randn(3000, 256, generator=torch.Generator().manual_seed(2))
    z = 16 * z / z.norm(dim=-1, keepdim=True)
    _, scale = Integers(256, 8).encode(z)
    assert torch.equal(scale, z.abs().amax(dim=-1).half())


def test_zero_tiny_and_huge_vectors_survive() -> None:
    z = torch.tensor([[0.0, 0.0], [1e-9, -1e-9], [1e9, 1.0]])
    received = quantise(z, 8)
    assert torch.isfinite(received).all()
    assert received[:2].abs().max() == 0  # below float16: a zero scale
    assert received[2, 0] == torch.finfo(torch.float16).max


def test_vectors_do_not_share_a_scale() -> None:
    z = torch.tensor([[1.0, 0.5], [100.0, 50.0]])
    received = quantise(z, 8)
    assert torch.allclose(received[0] * 100, received[1], rtol=1e-3)


@pytest.mark.parametrize("bits", [-1, 0, 1, 17])
def test_impossible_bits_are_refused(bits: int) -> None:
    with pytest.raises(UsageError, match=f"payload of {bits} bits .* 2 to 16"):
        Integers(4, bits)


def test_bit_counts() -> None:
    assert Integers(256, 8).bits == 2064  # 256 values and one 16-bit scale
    assert Integers(16, 6).bits == 112
    assert 2 * frame_bits(FRAME_SHAPE) == 393_216
    assert 1 - 256 * 8 / frame_bits(FRAME_SHAPE) == pytest.approx(0.98958, abs=1e-5)  # paper
