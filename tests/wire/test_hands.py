"""Cameras, actuators and addresses: what they give, and what they are refused for."""

import os
import pty
import select

import numpy as np
import pytest

from hjepa_cli.core.plants.frames import FRAME_SHAPE
from hjepa_cli.errors import DataError, MissingInputError, Unavailable, UsageError
from hjepa_cli.wire import camera as cameras
from hjepa_cli.wire.actuator import open_actuator
from hjepa_cli.wire.camera import Watched, fitted, open_camera, parse_crop
from hjepa_cli.wire.server import is_loopback, open_socket, parse_address, resolve


class Pictures:
    def __init__(self, *pictures):
        self._left = list(pictures)

    def read(self):
        return self._left.pop(0) if self._left else None

    def close(self):
        pass


def picture(value):
    return np.full(FRAME_SHAPE, value, np.uint8)


def test_the_encoder_sees_the_newest_pictures_and_copies_of_the_first():
    watched = Watched(Pictures(picture(1), picture(2), picture(3)), (1, 0))
    seen = []
    while watched.read():
        seen.append(watched.frames[0, :, 0, 0, 0].tolist())
    assert seen == [[1, 1], [1, 2], [2, 3]]


def test_pictures_further_apart_are_picked_from_those_that_are_remembered():
    """Four pictures, three apart: of numbers 1, 2, … those that many back, or the first."""
    watched = Watched(Pictures(*map(picture, range(1, 21))), (9, 6, 3, 0))
    seen = []
    while watched.read():
        seen.append(watched.frames[0, :, 0, 0, 0].tolist())
    assert seen == [[max(now - back, 1) for back in (9, 6, 3, 0)] for now in range(1, 21)]


@pytest.mark.parametrize(
    "bad",
    [
        np.zeros((480, 640, 3), np.uint8),
        np.zeros(FRAME_SHAPE, np.float32),
        np.zeros(FRAME_SHAPE[:2], np.uint8),
        "no picture",
    ],
)
def test_pictures_of_another_size_or_type_are_refused(bad):
    with pytest.raises(DataError, match="the model sees"):
        Watched(Pictures(bad), (1, 0)).read()


def test_a_frozen_camera_is_noticed():
    watched = Watched(Pictures(*[picture(1)] * (cameras.FROZEN + 2)), (1, 0))
    with pytest.raises(Unavailable, match="frozen"):
        while watched.read():
            pass


def test_spoilt_pictures_are_not_kept_and_a_scene_that_stays_changed_is():
    """The last good one stands for empty and torn ones, for three torn ones in a row at most."""
    random = np.random.default_rng(0)
    scene, other = random.integers(0, 256, (2, *FRAME_SHAPE), dtype=np.uint8)
    order = [picture(0), scene, picture(255), other, scene, other, other, other, other, other]
    watched = Watched(Pictures(*order), (1, 0), 0.1)
    good = []
    while watched.read():
        good.append(watched.good)
        if watched.good:
            assert np.array_equal(watched.frames[0, -1], order[len(good) - 1])
        elif len(good) > 2:
            assert np.array_equal(watched.frames[0, -1], scene)
    assert good == [False, True, False, False, True, False, False, False, True, True]
    assert watched.spoilt == 6


@pytest.mark.parametrize("levels", [(0, 0), (0, 1)], ids=["black", "flickering black"])
def test_a_camera_that_has_gone_black_ends_the_device(levels):
    """Its last good picture is kept, and predictions on it must not go on for ever."""
    scene = np.random.default_rng(0).integers(0, 256, FRAME_SHAPE, dtype=np.uint8)
    black = [picture(levels[number % 2]) for number in range(cameras.FROZEN + 2)]
    watched = Watched(Pictures(scene, *black), (1, 0), 0.1)
    with pytest.raises(Unavailable, match=r"frozen|shows nothing"):
        while watched.read():
            pass
    assert cameras.FROZEN - 1 <= watched.spoilt <= cameras.FROZEN


def test_a_crop_averages_areas():
    random = np.random.default_rng(0)
    wide = random.integers(0, 256, (200, 300, 3), dtype=np.uint8)
    found = fitted(wide, (10, 20, 256, 128))
    for row, column in ((0, 0), (63, 127), (17, 40)):
        block = wide[20 + 2 * row : 22 + 2 * row, 10 + 2 * column : 12 + 2 * column]
        assert np.abs(found[row, column] - block.mean(axis=(0, 1))).max() <= 0.5
    for crop in ((0, 0, 300, 150), (100, 0, 256, 128), (0, 0, 256, 100)):
        with pytest.raises(DataError, match="crop"):
            fitted(wide, crop)
    assert parse_crop(" 1,2,256,128") == (1, 2, 256, 128) and parse_crop(None) is None
    for text in ("1,2,3", "a,b,c,d", "0,0,64,32", "-1,0,256,128"):
        with pytest.raises(UsageError, match="--crop"):
            parse_crop(text)


def test_a_directory_of_pictures_is_replayed_in_order(tmp_path):
    image = pytest.importorskip("PIL.Image")
    for value in (3, 1, 2):
        image.fromarray(picture(value)).save(tmp_path / f"{value}.png")
    replay = open_camera(str(tmp_path), None)
    assert [int(replay.read()[0, 0, 0]) for _ in range(3)] == [1, 2, 3]
    assert replay.read() is None
    (tmp_path / "0.png").write_bytes(b"no picture")
    with pytest.raises(DataError, match=r"0\.png"):
        open_camera(str(tmp_path), None).read()
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(MissingInputError, match="no pictures"):
        open_camera(str(empty), None)
    with pytest.raises(UsageError, match="--camera nonsense"):
        open_camera("nonsense", None)


@pytest.fixture
def serial():
    """A serial cart-pole, and the end of its line that a microcontroller reads."""
    ours, theirs = pty.openpty()
    yield open_actuator(f"serial:{os.ttyname(theirs)}", 1), ours
    os.close(ours)
    os.close(theirs)


ZERO = b"\n" + 3 * b"u +0.000\n"


def read(ours, last):
    """Read until ``last`` has come, or nothing for two seconds."""
    found = b""
    while not found.endswith(last) and select.select([ours], [], [], 2.0)[0]:
        found += os.read(ours, 4096)
    return found


def test_the_serial_cart_pole_writes_newton_and_leaves_none(serial):
    actuator, ours = serial
    actuator.play(np.array([-2.5], np.float32))
    assert read(ours, b"\n") == b"u -2.500\n"
    actuator.close()
    assert read(ours, ZERO) == ZERO


def test_a_full_serial_port_tears_no_line_and_is_told_0_newton_at_last(serial):
    actuator, ours = serial
    forces_n = np.array([[12.5], [-2.5]], np.float32)  # no buffer ends with a line of both lengths

    def play(lines):
        for k in range(lines):
            actuator.play(forces_n[k % 2])

    play(20_000)  # twice what it takes
    found = b""
    for _ in range(40):
        found += os.read(ours, 4096)
        play(600)
    assert set(found.split(b"\n")[:-1]) == {b"u +12.500", b"u -2.500"}
    actuator.close()
    assert read(ours, ZERO).endswith(ZERO)


def test_actuators_that_are_none(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(Unavailable, match="no serial port"):
        open_actuator(f"serial:{tmp_path / 'file'}", 1)
    with pytest.raises(Unavailable, match="nowhere"):
        open_actuator("serial:/dev/nowhere", 1)
    for name in ("serial:", "wheel"):
        with pytest.raises(UsageError, match="--actuator"):
            open_actuator(name, 1)
    with pytest.raises(UsageError, match="has 2"):
        open_actuator("serial:/dev/ttyUSB0", 2)


def test_addresses():
    assert parse_address("127.0.0.1:80", "--bind") == ("127.0.0.1", 80)
    assert parse_address("[::1]:80", "--bind") == ("::1", 80)
    assert parse_address(":80", "--bind") == ("127.0.0.1", 80)
    assert parse_address("80", "--bind") == ("127.0.0.1", 80)
    for text in ("", "host", "host:", "host:a", "host:70000", "host:-1"):
        with pytest.raises(UsageError, match="HOST:PORT"):
            parse_address(text, "--bind")
    assert is_loopback(("127.3.4.5", 1)) and is_loopback(("::1", 1, 0, 0))
    assert not is_loopback(("0.0.0.0", 1)) and not is_loopback(("10.0.0.1", 1))
    with pytest.raises(Unavailable, match="--server"):
        resolve(("no host at all", 1), "--server")


def test_a_taken_port_is_named():
    with open_socket(("127.0.0.1", 0)) as taken:
        with pytest.raises(Unavailable, match=r"--bind 127\.0\.0\.1"):
            open_socket(taken.getsockname())
