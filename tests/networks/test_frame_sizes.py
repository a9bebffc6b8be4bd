"""Pictures of any size and in grey go through encoder and decoder; a mirror still commutes."""

import pytest
import torch

from hjepa_cli.config.schema import AugmentSettings, CameraSettings, Settings
from hjepa_cli.core.networks.decoder import Decoder
from hjepa_cli.core.networks.encoder import Encoder, map_of, stages_of
from hjepa_cli.core.networks.photometry import against_background
from hjepa_cli.core.networks.symmetry import reflect
from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.core.training.augmentation import Augmentation

SIZES = [(64, 128, 3), (48, 96, 3), (32, 32, 1), (50, 70, 3), (17, 40, 1), (120, 160, 1)]


def test_stages_follow_the_smaller_side():
    """As many halvings after the stem as leave two to four rows: worked by hand."""
    wanted = {(64, 128): (3, (2, 4)), (48, 96): (2, (3, 6)), (128, 128): (4, (2, 2))}
    wanted |= {(240, 320): (4, (4, 5)), (16, 16): (1, (2, 2)), (17, 40): (1, (3, 5))}
    for size, (stages, rows_columns) in wanted.items():
        assert (stages_of(*size), map_of(*size)) == (stages, rows_columns)


@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_embeddings_of_mirrored_pictures_are_reflected(shape):
    torch.manual_seed(0)
    encoder = Encoder(32, "difference", True, symmetric=True, frame_shape=shape).eval()
    frames = torch.randint(0, 256, (3, 2, *shape), dtype=torch.uint8)
    with torch.no_grad():
        z, mirrored = encoder(frames), encoder(frames.flip(-2))
        folded = encoder.folded()(frames)
    assert z.shape == (3, 32)
    assert torch.allclose(mirrored, reflect(z), atol=1e-4)
    assert torch.allclose(folded, z, atol=1e-3)
    # Every pixel counts, those at the border too.
    changed = frames.clone()
    changed[:, :, -1, -1] = 255 - changed[:, :, -1, -1]
    with torch.no_grad():
        assert not torch.allclose(encoder(changed), z, atol=1e-6)


@pytest.mark.parametrize("fit", ["gain", "affine"])
@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_pictures_of_any_size_are_fitted_to_their_background(shape, fit):
    """Of a scene that is mostly background, light does not matter: to float32's last bits."""
    scene = torch.full((2, *shape), 200.0)
    scene[:, shape[0] // 2 :, : shape[1] // 4] = 40.0
    seen = against_background(scene, fit)
    assert seen.shape == scene.shape and (seen[:, 0, -1] == 0).all() and (seen[:, -1, 0] < 0).all()
    torch.testing.assert_close(against_background(0.6 * scene, fit), seen, atol=1e-3, rtol=0)


@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_pictures_of_any_size_are_augmented(shape):
    frames = torch.randint(0, 256, (4, 2, *shape), dtype=torch.uint8)
    worse = Augmentation(AugmentSettings(strength=1.0, share=1.0, clean=0.0))(frames, [1, 2])
    assert worse.shape == frames.shape and worse.dtype == torch.uint8
    assert (worse != frames).flatten(1).any(1).all()


@pytest.mark.parametrize("shape", SIZES, ids=str)
def test_the_decoder_paints_pictures_of_that_size(shape):
    torch.manual_seed(0)
    decoder = Decoder(32, 2, True, shape).eval()
    z = torch.randn(2, 32)
    with torch.no_grad():
        painted, mirrored = decoder(z), decoder(reflect(z))
    assert painted.shape == (2, 2 * shape[2], *shape[:2])
    assert torch.allclose(mirrored, painted.flip(-1), atol=1e-5)


def test_the_usual_size_changes_no_recorded_setting():
    assert CameraSettings().frame_shape == FRAME_SHAPE
    plain = Settings().as_dict()
    assert "camera" not in plain and "recorded" not in plain
    assert "camera" in Settings(camera=CameraSettings(grey=True)).as_dict()
