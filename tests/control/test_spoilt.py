"""Pictures that no device should send are told from motion, noise and flicker."""

import math

import numpy as np
import pytest

from hjepa_cli.core.arrays import Pixels
from hjepa_cli.core.control.spoilt import changed, empty, most_changed, spoilt
from hjepa_cli.core.plants import stress
from hjepa_cli.core.plants.named import Camera

STEP_S = 0.001


def moving(count: int, speed: float = 1.0) -> Pixels:
    """Two pictures each of cart-poles that move, as uint8 [count, 2, 64, 128, 3]."""
    random = np.random.default_rng(0)
    states = random.uniform(-1, 1, (count, 4)) * [0.1, 1.0, 0.3, 6.0]
    before = states.copy()
    before[:, [0, 2]] -= speed * STEP_S * states[:, [1, 3]]
    camera = Camera("desktop")
    return np.stack([camera.render(before), camera.render(states)], axis=1)


def under(frames: Pixels, condition: str) -> Pixels:
    ((one, severity),) = stress.parse(condition).items()
    assert one.apply is not None
    seen = one.apply(frames.astype(np.float32), severity, np.random.default_rng(1))
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def test_the_share_of_changed_pixels_is_counted() -> None:
    frames = np.full((3, 2, 4, 5, 3), 100, np.uint8)
    frames[1, 1, :2, :2] = 148  # four of twenty, by just enough
    frames[2, 1, 0, 0] = [200, 100, 100]  # by 33 on average
    assert changed(frames).tolist() == [0.0, 0.2, 0.0]


def test_garbage_is_told_from_what_a_camera_sees() -> None:
    learned, seen = moving(200), moving(100)[::-1]
    most = most_changed(learned)
    assert changed(learned).max() < most < changed(under(learned, "torn=1")).min()
    for fault in ("torn=1", "black=1", "saturated=1", "frozen=1"):
        assert spoilt(under(seen, fault), most).all(), fault
    for ordinary in ("light=0.7", "noise=16", "flicker=0.02", "blur=2", "jitter=0.1", "corner=16"):
        assert not spoilt(under(seen, ordinary), most).any(), ordinary


def test_where_tearing_changes_no_more_than_motion_nothing_is_too_much() -> None:
    assert most_changed(moving(50, speed=60.0)) == math.inf
    still = np.repeat(moving(1)[:, 1:], 2, axis=1)
    assert 0 < most_changed(still) < 1, "one pixel at least may change"


@pytest.mark.parametrize("level", [0, 128, 255])
def test_empty_pictures_are_of_any_grey(level: int) -> None:
    assert empty(np.full((1, 64, 128, 3), level, np.uint8)).all()
    assert not empty(moving(5)[:, 1]).any()
