"""Training pictures are made worse as much as the settings say; targets and labels stay clean."""

import dataclasses
from typing import Any

import numpy as np
import pytest
import torch

from hjepa_cli.config.schema import AugmentSettings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.training.augmentation import SHIFTED_DOWN, Augmentation
from hjepa_cli.core.training.batches import TrajectoryBatch
from hjepa_cli.core.training.hardening import Hardening
from hjepa_cli.core.training.jepa import Jepa

KEPT = (
    *("strength", "steps", "learning_rate", "share", "rotation_share", "rectangles"),
    *("force_weight", "force_steps"),
)
OFF = {field.name: 0.0 for field in dataclasses.fields(AugmentSettings) if field.name not in KEPT}
COUNT = 400


def augmented(frames: torch.Tensor, seed: int = 1, **effects: Any) -> torch.Tensor:
    """One window in which every picture has the effects given, and no others."""
    of_all: dict[str, Any] = {"share": 1.0, "rotation_share": 1.0, "rectangles": 1}
    settings = AugmentSettings(strength=1.0, **{**OFF, **of_all, **effects})
    return Augmentation(settings)(frames, [seed]).float()


def grey(level: int = 128, count: int = COUNT) -> torch.Tensor:
    return torch.full((count, 2, 64, 128, 3), level, dtype=torch.uint8)


def ramp(count: int = COUNT) -> torch.Tensor:
    """Pictures whose red tells the column and whose green the row, 1 and 2 levels a pixel."""
    rows, columns = torch.meshgrid(torch.arange(64), torch.arange(128), indexing="ij")
    one = torch.stack([columns, 2 * rows, 0 * rows], dim=-1).to(torch.uint8)
    return one.expand(count, 2, 64, 128, 3).clone()


def test_off_it_draws_nothing() -> None:
    stream = np.random.default_rng(0)
    before = stream.bit_generator.state
    assert Augmentation(AugmentSettings(strength=0.0)).draw(3, stream) is None
    assert stream.bit_generator.state == before
    assert "augment" not in load_settings(flags={"augment.strength": 0.0}).as_dict()
    assert load_settings().as_dict()["augment"]["strength"] == 1.0


def test_a_window_follows_from_its_seed_alone() -> None:
    augment = Augmentation(AugmentSettings(strength=1.0))
    frames = torch.cat([ramp(5), grey(200, 5)])
    both = augment(frames, [3, 4])
    assert both.dtype == torch.uint8 and both.shape == frames.shape
    assert torch.equal(both[5:], augment(frames[5:], [4]))
    assert not torch.equal(both[5:], augment(frames[5:], [5]))
    assert torch.equal(frames, torch.cat([ramp(5), grey(200, 5)])), "and is not changed in place"
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(both, augment(frames, [3, 4]))


def test_light_and_colour_are_of_an_input_and_flicker_of_a_frame() -> None:
    gain = augmented(grey(100), gain=0.3) / 100
    assert (gain == gain[:, :1, :1, :1, :1]).all()
    gain = gain[:, 0, 0, 0, 0]
    assert gain.min() >= 0.695 and gain.max() <= 1.305
    assert abs(gain.std() - 0.6 / 12**0.5) < 4 * 0.6 / 12**0.5 / (2 * COUNT) ** 0.5
    colour = augmented(grey(), colour=0.2)
    assert (colour == colour[:, :1, :1, :1]).all() and (colour[..., 0] != colour[..., 1]).any()
    flicker = augmented(grey(250), flicker=0.2)[:, :, 0, 0, 0]
    assert flicker.max() <= 250 and flicker.min() >= 199.5
    assert (flicker[:, 0] != flicker[:, 1]).float().mean() > 0.9
    bent = augmented(grey(128), gamma=0.3)[:, 0, 0, 0, 0]
    bounds = [255 * 0.5**power for power in (1.3, 1 / 1.3)]
    assert bounds[0] - 1 <= bent.min() < bounds[0] + 2
    assert bounds[1] - 2 < bent.max() <= bounds[1] + 1
    for level in (0, 255):
        assert (augmented(grey(level, 8), gamma=0.3) == level).all()
    across = augmented(grey(250), gradient=0.4)[:, 0, :, :, 0]
    darkest, brightest = across.flatten(1).amin(1), across.flatten(1).amax(1)
    fall = (brightest - darkest) / brightest
    assert 0.3 < fall.max() <= 0.6 and fall.min() < 0.05  # both edges together, at a corner
    sides = torch.stack(
        [across[:, 32, 0] - across[:, 32, -1], across[:, 0, 64] - across[:, -1, 64]]
    )
    assert (sides.amax(1) > 20).all() and (sides.amin(1) < -20).all(), "in any direction"


def test_noise_is_drawn_for_every_frame_and_shot_noise_goes_with_the_light() -> None:
    read = augmented(grey(count=60), read_noise=8.0) - 128
    width = read.std((1, 2, 3, 4))
    assert width.max() < 8.2 and width.max() > 7 and width.min() < 1
    busy = read[width > 4]
    assert abs((busy[:, 0] * busy[:, 1]).mean()) < 4 * 64 / busy[:, 0].numel() ** 0.5
    shot = [augmented(grey(level, 60), shot_noise=8.0).std((1, 2, 3, 4)) for level in (60, 240)]
    loud = shot[1] > 2
    # Rounding adds a variance of 1/12 to both.
    ratio = ((shot[1] ** 2 - 1 / 12) / (shot[0] ** 2 - 1 / 12))[loud]
    assert (abs(ratio - 4) < 0.4).sum() > 0.8 * loud.sum()


def test_places_move_as_far_as_they_should() -> None:
    jitter = augmented(ramp(), jitter_px=2.0)[:, :, 32, 64, :2]
    moved_px = (jitter - torch.tensor([64.0, 64.0])) / torch.tensor([1.0, 2.0])
    for axis in range(2):
        assert moved_px[..., axis].std() == pytest.approx(2.0, rel=4 / (4 * COUNT) ** 0.5)
    between = np.corrcoef(moved_px[:, 0, 0], moved_px[:, 1, 0])[0, 1]
    assert abs(between) < 4 / COUNT**0.5, "each frame is moved for itself"
    turned = augmented(ramp(), rotation_deg=10.0)[:, :, 20:45, 40:90]
    # The column grows by cos along a row and by ∓ sin down a column: isotropic in pixels.
    along, down = (turned[..., 0].diff(dim=axis).mean((2, 3)) for axis in (3, 2))
    angle = torch.rad2deg(torch.atan2(down, along))
    assert (angle[:, 0] - angle[:, 1]).abs().max() < 0.2, "one angle for an input"
    assert 9 < angle.abs().max() < 10.1 and (angle > 0).any() and (angle < 0).any()
    torch.testing.assert_close(along**2 + down**2, torch.ones_like(along), atol=0.03, rtol=0)
    rows_along = turned[..., 1].diff(dim=3).mean((2, 3)) / 2
    torch.testing.assert_close(rows_along, -down, atol=0.06, rtol=0)  # of whole grey levels


def test_some_pictures_move_up_or_down_and_none_to_a_side() -> None:
    seen = augmented(ramp(), shift_down_px=6.0)[:, :, 32, 64, :2]
    columns, rows = seen[..., 0], seen[..., 1] / 2
    assert (columns == 64).all()
    assert (rows[:, 0] == rows[:, 1]).all(), "all frames of an input alike"
    down_px = 32 - rows[:, 0]
    moved = down_px[down_px.abs() > 0.25]  # grey levels are half a pixel
    share = SHIFTED_DOWN * 5.75 / 6
    assert abs(len(moved) / COUNT - share) < 4 * (share / COUNT) ** 0.5
    assert moved.abs().max() <= 6.25 and moved.max() > 4 and moved.min() < -4
    assert abs(moved.mean()) < 4 * (12 / 12**0.5) / len(moved) ** 0.5


def test_jitter_and_rotation_are_drawn_for_themselves() -> None:
    """Of the pictures that are turned, as many tremble as of the others."""
    effects = OFF | {"rotation_deg": 40.0, "jitter_px": 3.0}
    settings = AugmentSettings(strength=1.0, share=0.5, rotation_share=0.7, **effects)
    found = Augmentation(settings)(ramp(), [1])[:, :, 20:45, 50:80].float()
    down = found[..., 0].diff(dim=2).mean((2, 3))  # red falls or grows there where they are turned
    turned = (down.abs() > 0.05).any(1)  # all but those by less than 3 degrees
    trembling = (found[:, 0] != found[:, 1]).flatten(1).any(1)
    for found, share in ((turned.float().mean() / (37 / 40), 0.7), (trembling.float().mean(), 0.5)):
        assert abs(found - share) < 4 * 0.5 / COUNT**0.5
    for group in (turned, ~turned):
        assert abs(trembling[group].float().mean() - 0.5) < 4 * 0.5 / int(group.sum()) ** 0.5


def test_as_many_pictures_stay_as_they_are_as_the_settings_say() -> None:
    settings = AugmentSettings(strength=1.0, share=1.0, **OFF | {"clean": 0.25, "gain": 0.3})
    before = ramp()
    after = Augmentation(settings)(before, [1])
    same = (after == before).flatten(1).all(1).float().mean()
    assert abs(same - 0.25) < 4 * (0.25 * 0.75 / COUNT) ** 0.5


def test_inputs_of_four_frames_take_no_more_numbers_than_there_are() -> None:
    settings = AugmentSettings(strength=1.0, share=1.0, clean=0.0)
    frames = ramp(8)[:, [0, 0, 1, 1]]
    worse = Augmentation(settings)(frames, [7])
    assert worse.shape == frames.shape and (worse != frames).flatten(1).any(1).all()


def test_blur_and_rectangles() -> None:
    dot = torch.zeros(40, 2, 64, 128, 3, dtype=torch.uint8)
    dot[:, :, 20:44, 40:88] = 200
    blurred = torch.stack([augmented(dot, seed, blur_px=2.0) for seed in range(8)])
    edge = blurred[:, 0, 0, 32, 30:50, 0].diff(dim=1) / 200  # the kernel's own profile
    columns = torch.arange(edge.shape[1], dtype=torch.float32)
    mean = (edge * columns).sum(1, keepdim=True)
    width_px = ((columns - mean) ** 2 * edge).sum(1).clamp_min(0).sqrt()
    assert 1.2 < width_px.max() < 2.1 and width_px.min() < 1
    hidden = augmented(grey(count=100), rectangle_px=12.0) != 128
    assert (hidden[:, 0] == hidden[:, 1]).all(), "before both frames"
    rows = hidden[:, 0, :, :, 0].any(2).sum(1)
    columns = hidden[:, 0, :, :, 0].any(1).sum(1)
    assert rows.max() <= 12 and rows.max() >= 10 and (rows != columns).any()
    quarters = hidden[:, 0, :, :, 0].any(0).view(2, 32, 2, 64).any(3).any(1)
    assert quarters.all(), "anywhere"


def test_as_many_rectangles_as_the_settings_say() -> None:
    """Each has a place and a grey of its own, and not every one is there."""
    one, three = (
        augmented(grey(), rectangle_px=8.0, rectangles=count)[:, 0, :, :, 0] for count in (1, 3)
    )
    greys = [[len(torch.unique(picture)) - 1 for picture in of] for of in (one, three)]
    assert max(greys[0]) == 1 and max(greys[1]) == 3 and 1 in greys[1]
    covered = [(of != 128).float().mean() for of in (one, three)]
    # Of sides drawn evenly from 0 to 8 px, rounded; they seldom overlap.
    assert covered[1] / covered[0] == pytest.approx(3, rel=0.25)


class Seen(Encoder):
    """An encoder that remembers what it saw."""

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        self.frames = frames
        return super().forward(frames)


def worse_batch() -> TrajectoryBatch:
    return TrajectoryBatch(grey(100, 4), torch.zeros(2, 1, 4), worse=grey(50, 4))


def test_a_jepa_sees_clean_pictures_only() -> None:
    """Its context encoder as well as its target, whatever a batch brings along."""
    encoder = Seen(16, "difference", centre=False)
    jepa = Jepa(
        encoder, Predictor(16, 16, 4), ema_decay=0.9, inverse_dynamics=0.0, rollout_strides=1,
        device=torch.device("cpu"),
    )  # fmt: skip
    batch = worse_batch()
    jepa.losses(batch)
    target: Any = jepa.target.module
    assert torch.equal(encoder.frames, batch.frames) and torch.equal(target.frames, batch.frames)


def test_what_is_hardened_sees_worse_pictures_than_its_teacher() -> None:
    encoder = Seen(16, "difference", centre=False)
    clean = AugmentSettings(force_weight=0.0)
    hardening = Hardening(torch.nn.ModuleDict({"encoder": encoder}), torch.device("cpu"), clean, 4)
    hardening.train()
    batch = worse_batch()
    hardening.losses(batch)
    teacher: Any = hardening.networks["teacher"]
    assert torch.equal(encoder.frames, batch.worse) and torch.equal(teacher.frames, batch.frames)
