"""A device's loop against a controller in the same process, behind a socket that is none."""

import socket
import time
from contextlib import closing

import linear
import numpy as np
import pytest

from hjepa_cli.errors import DataError, Unavailable
from hjepa_cli.wire import protocol
from hjepa_cli.wire.device import Device, EverySteps
from hjepa_cli.wire.drive import Drive

SERVER = ("127.0.0.1", 4747)
PERIOD_S = 0.002


class Line:
    """A controller where a device's socket should be; what it says can be waited for as usual."""

    def __init__(self, controller):
        self.controller, self.now_s, self.steps = controller, 0.0, []
        self._ours, self._theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._ours.setblocking(False)
        self.fileno, self.recvfrom = self._ours.fileno, self._ours.recvfrom

    def sendto(self, data, address):
        self.now_s += PERIOD_S
        if protocol.peek(data)[0] == protocol.EMBEDDING:
            self.steps.append(protocol.parse(data).step)
        outgoing = self.controller.receive(data, "device", self.now_s)
        for answer, _ in outgoing + linear.settle(self.controller, self.now_s):
            self._theirs.send(answer)

    def close(self):
        self._ours.close()
        self._theirs.close()


class Plant:
    """Its camera, its actuator and its encoder."""

    frames, good = None, True

    def read(self):
        return True

    def play(self, forces_n):
        pass

    def encode(self, frames):
        return np.ones((1, linear.SIZE), np.float32)


@pytest.fixture
def line():
    with closing(Line(linear.controller(most_devices=1))) as opened:
        yield opened


def drive_of(line, lines, bundle=None, **more):
    device = Device(bundle or linear.bundle(), 1, linear.KEY, PERIOD_S, **more)
    plant = Plant()
    drive = Drive(device, plant, plant, plant, EverySteps(10), line, SERVER, lines.append)
    return device, drive


def take_the_only_place(line):
    other = linear.device(2)
    linear.connect(line.controller, other)
    line.controller.receive(other.embed(0, np.ones(linear.SIZE, np.float32)), "other", 0.0)
    return other


def local_n():
    return np.zeros(1, np.float32)


def test_a_device_that_has_no_place_drives_itself_and_goes_on_asking(line):
    """As it comes, and after the server has started anew; until the other one leaves."""
    lines, other, started_s = [], take_the_only_place(line), time.monotonic()

    def told():
        return len([text for text in lines if "as many devices as it may" in text])

    device, drive = drive_of(line, lines, actor=local_n, watchdog_steps=1)
    with pytest.raises(Unavailable, match="as many devices as it may"):
        drive.connect()
    drive.run(100, None)
    assert device.counts["local"] == 100 and told()
    line.controller.receive(other.bye(), "other", 0.0)
    drive.run(500, None)
    assert device.counts["planned"] > 10
    line.controller = linear.controller(most_devices=1)
    take_the_only_place(line)
    drive.run(500, None)
    assert 2 <= told() <= 1 + (time.monotonic() - started_s)  # a line a second


def test_a_refusal_that_cannot_pass_or_leaves_nobody_to_drive_ends(line):
    other = linear.bundle(digest=b"e" * 32)
    _, drive = drive_of(line, [], bundle=other, actor=local_n)
    with pytest.raises(DataError, match="another model"):
        drive.run(100, None)
    take_the_only_place(line)
    _, drive = drive_of(line, [], watchdog_steps=1000)
    with pytest.raises(Unavailable, match="as many devices as it may"):
        drive.run(100, None)


def test_steps_beyond_those_of_a_session_begin_another_one(line, monkeypatch):
    """A device runs longer than 31 bits can count; who drives it changes for a moment at most."""
    monkeypatch.setattr(protocol, "MOST_STEPS", 40)
    device, drive = drive_of(line, [])
    drive.connect()
    drive.run(90, None)
    assert line.steps == [0, 10, 20, 30, 1, 10, 20, 30, 1]
    assert line.controller.counts["sessions"] == 3 and device.counts["planned"] > 80


def test_spoilt_pictures_are_not_sent(line):
    lines = []
    _, drive = drive_of(line, lines, actor=local_n)
    drive.connect()
    Plant.good = False
    try:
        drive.run(30, None)
    finally:
        Plant.good = True
    assert line.steps == [] and drive.sent == 0
    assert any("empty or torn" in text for text in lines)
    drive.run(30, None)
    assert line.steps and drive.sent == len(line.steps)
