"""Pictures against their background: exact under light and black level, robust to the rest."""

import copy

import numpy as np
import pytest
import torch

from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.photometry import against_background
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.core.plants.named import plant


def pictures(count: int = 8) -> torch.Tensor:
    states = np.random.default_rng(0).uniform(-1, 1, (count, 2, 4)) * [0.1, 0.1, 0.3, 0.5]
    return torch.from_numpy(frames_of(plant("desktop").camera(), states))


def noisy(frames: torch.Tensor, width: float) -> torch.Tensor:
    return frames + width * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0))


def test_light_of_every_channel_does_not_matter_and_with_affine_neither_does_its_offset() -> None:
    frames = noisy(pictures().flatten(0, 1).double(), 3.0).float()
    gain, offset = torch.tensor([0.4, 1.0, 1.7]), torch.tensor([-30.0, 12.0, 55.0])
    for fit, changed in (("gain", gain * frames), ("affine", gain * frames + offset)):
        # Of float32 values of up to 500: a few last bits of each.
        torch.testing.assert_close(
            against_background(changed, fit), against_background(frames, fit), atol=1e-3, rtol=0
        )
    moved = against_background(frames + offset, "gain") - against_background(frames, "gain")
    assert moved.abs().amax() > 10


def test_a_nominal_picture_keeps_its_grey_levels_and_its_mirror_image_is_mirrored() -> None:
    frames = pictures().flatten(0, 1)
    assert torch.equal(against_background(frames, "gain"), frames.float() - 255)
    light = noisy(0.8 * frames.float(), 5.0)
    for fit in ("gain", "affine"):
        seen = against_background(light, fit)
        torch.testing.assert_close(against_background(light.flip(2), fit), seen.flip(2))


def test_noise_and_objects_hardly_move_the_level_or_the_spread() -> None:
    frames = 0.7 * pictures(64)[:, 0].float()
    disturbed = noisy(frames, 8.0)
    disturbed[:, -8:, :8] = 100.0
    level = disturbed[:, 0, 0] / (1 + against_background(disturbed, "gain")[:, 0, 0] / 255)
    # The median of 512 means of 4 pixels, of which at most a tenth hold something darker.
    width = 8 / 2
    assert (level - 0.7 * 255).abs().amax() < 4 * 1.25 * width / 512**0.5 + 1.25 * 0.1 * width
    clean, other = (against_background(seen, "affine") for seen in (frames, disturbed))
    dark = clean[..., 0] < -200  # the cart in red
    ratio = (other[..., 0] * dark).sum((1, 2)) / (clean[..., 0] * dark).sum((1, 2))
    assert (ratio - 1).abs().amax() < 0.05


def test_black_and_empty_pictures_are_all_background() -> None:
    for value in (0, 255):
        frames = torch.full((2, 64, 128, 3), value, dtype=torch.uint8)
        for fit in ("gain", "affine"):
            assert torch.equal(against_background(frames, fit), torch.zeros(2, 64, 128, 3))


@pytest.fixture(scope="module")
def plain() -> Encoder:
    """An encoder of pictures as they come."""
    torch.manual_seed(0)
    encoder = Encoder(32, "difference", centre=True).eval()
    encoder.fit_standardisation(pictures(64))
    return encoder


def test_an_encoder_sees_through_less_light_without_training(plain: Encoder) -> None:
    fitted = copy.deepcopy(plain)
    fitted.photometric = "gain"
    fitted.input_mean[:3] -= 255
    frames = pictures(32)
    dim = torch.round(0.8 * frames.float()).to(torch.uint8)
    with torch.inference_mode():
        z = plain(frames)
        apart = {
            name: float((encoder(seen) - z).norm(dim=1).mean())
            for name, encoder, seen in (
                ("nominal", fitted, frames), ("dim", fitted, dim), ("as it comes", plain, dim)
            )
        }  # fmt: skip
    # Rounding of dim pictures alone remains.
    assert apart["nominal"] < 1e-4 * apart["as it comes"], apart
    assert apart["dim"] < 0.05 * apart["as it comes"], apart


@pytest.mark.parametrize("fit", ["gain", "affine"])
def test_folding_the_batch_norms_leaves_embeddings_as_they_are(plain: Encoder, fit: str) -> None:
    fitted = copy.deepcopy(plain)
    fitted.photometric = fit
    frames = pictures()
    with torch.inference_mode():
        torch.testing.assert_close(fitted.folded()(frames), fitted(frames), atol=2e-3, rtol=1e-3)
