"""The bench tells how long devices were without a controller, by the clock on the wall."""

import linear
import numpy as np
import pytest

from hjepa_cli.wire import bench


def outcome(began_s, unplanned_until):
    nothing = np.zeros(1)
    return bench.BenchOutcome(
        nothing, nothing, 0.0, 0.0, {}, {}, unplanned_until, np.array(began_s, float), 0.0
    )


@pytest.mark.parametrize(
    ("unplanned_until", "after_s"),
    [(0, 0.0), (2, 0.0), (3, 1.0), (4, 5.0), (5, None)],
)
def test_devices_are_driven_again_when_all_are_for_good(unplanned_until, after_s):
    """Steps that take longer count as long as they took; to the end of the run is never."""
    assert outcome([0, 1, 2, 3, 7], unplanned_until).driven_again_s(2) == after_s


def test_a_server_that_comes_back_after_the_end_of_the_run_drives_nobody():
    assert outcome([0, 1, 2], 3).driven_again_s(50) is None


class Clock:
    def __init__(self):
        self.now_s = 0.0

    def monotonic(self):
        return self.now_s

    def sleep(self, seconds):
        self.now_s += seconds


class Busy:
    """A fleet without plants; one step takes it thirty periods, and all others no time."""

    def __init__(self, clock, actor):
        self.devices = [linear.device(actor=actor)]
        linear.connect(linear.controller(), *self.devices)
        self.states, self._clock = np.empty((50, 1, 1)), clock

    def upkeep(self, now_s):
        return []

    def sense(self, k):
        return []

    def play(self, k):
        if k == 5:
            self._clock.sleep(30 * linear.PERIOD_S)

    def outcome(self, began_s, seconds):
        return began_s


class Quiet:
    def recvfrom(self, size):
        raise BlockingIOError


@pytest.mark.parametrize(("actor", "ends_after"), [(None, 49), (lambda: None, 35 + 43)])
def test_devices_that_drive_themselves_do_not_rush(monkeypatch, actor, ends_after):
    """They go on from a late step, as a device does; others rush until they are where they were."""
    clock = Clock()
    monkeypatch.setattr(bench, "time", clock)
    began_s = bench.real_time(Busy(clock, actor), Quiet(), None, deadline=0.0)
    assert began_s[6] == pytest.approx(35 * linear.PERIOD_S)
    assert began_s[-1] == pytest.approx(ends_after * linear.PERIOD_S)
