"""The bench tells how long devices were without a controller, by the clock on the wall."""

from types import SimpleNamespace

import linear
import numpy as np
import pytest

from hjepa_cli.config.settings import load_settings
from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.stages import bench_link
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.zoo import resolve_model
from hjepa_cli.wire import bench

MODEL = "desktop-h4m2l1"


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


@pytest.fixture
def without_export(monkeypatch):
    """An exported model of which nothing is asked."""
    digest = load_checkpoint(resolve_model(MODEL)).digest
    bundle = SimpleNamespace(frames=4, manifest={"checkpoint": {"sha256": digest}})
    monkeypatch.setattr(bench_link, "open_bundle", lambda path: bundle)
    monkeypatch.setattr(bench_link, "check_plant", lambda bundle, settings: None)


@pytest.mark.parametrize(
    ("flags", "text", "says"),
    [
        ({"protocol.delay_steps": 3}, None, "--delay-steps delays"),
        ({"protocol.jitter_steps": 3}, None, "--jitter-steps delays"),
        ({}, "0\nlost\n0.6\n", "--trace delays"),
    ],
)
def test_delays_are_refused_where_the_wire_has_none(without_export, tmp_path, flags, text, says):
    """The simulation would have them, and the difference would be told as one of the wire."""
    trace = None
    if text is not None:
        (trace := tmp_path / "trace").write_text(text)
    given = {"checkpoint": MODEL, "trace": trace}
    for function in (bench_link.run, bench_link.plan):
        more = {"screen": None} if function is bench_link.run else {}
        with pytest.raises(UsageError, match=f"{says} .* in lockstep only") as caught:
            function(load_settings(flags=flags), **more, **given)
        assert "hjepa link" in caught.value.hint
    assert bench_link.plan(load_settings(flags=flags), lockstep=True, **given).work


def test_losses_and_delays_of_less_than_half_a_step_are_those_of_the_wire(without_export, tmp_path):
    (tmp_path / "trace").write_text("0\nlost\n0.4\n")
    options = load_settings(flags={"protocol.downlink_loss": 0.2})
    assert bench_link.plan(options, checkpoint=MODEL, trace=tmp_path / "trace").work


def test_a_trace_and_delays_are_two_links(without_export, tmp_path):
    (tmp_path / "trace").write_text("0\n")
    options = load_settings(flags={"protocol.delay_steps": 3})
    with pytest.raises(UsageError, match="leave --delay-steps out"):
        bench_link.plan(options, checkpoint=MODEL, trace=tmp_path / "trace", lockstep=True)


def test_a_run_that_ends_before_its_harm_is_refused(without_export):
    """Steps of 5 ms: half a second is 100 of them, from the middle on, and one must be left."""
    given = {"checkpoint": MODEL, "harm": "kill"}
    with pytest.raises(UsageError, match="from step 100 to 200 of 200") as caught:
        bench_link.plan(load_settings(), steps=200, **given)
    assert "--steps 201" in caught.value.hint
    with pytest.raises(UsageError, match="--harm kill"):
        bench_link.run(load_settings(), None, steps=200, **given)
    assert bench_link.plan(load_settings(), steps=201, **given).work
    for steps, lockstep in ((800, False), (4000, True)):
        with pytest.raises(UsageError, match="--harm stop"):
            bench_link.plan(
                load_settings(), checkpoint=MODEL, harm="stop", steps=steps, lockstep=lockstep
            )


def test_the_wire_is_compared_with_what_was_exported(without_export):
    with pytest.raises(
        DataError, match=r"gym-h4m2l1.* is not what exported was exported"
    ) as caught:
        bench_link.plan(load_settings(), checkpoint="gym-h4m2l1")
    assert "hjepa export gym-h4m2l1 --to" in caught.value.hint


def test_a_plan_refuses_and_takes_time_as_the_drive_does(without_export, tmp_path):
    usual, slow, lockstep = (
        bench_link.plan(load_settings(), checkpoint=MODEL, steps=3000, **given).seconds
        for given in ({}, {"period_ms": 105.0}, {"lockstep": True})
    )
    assert slow - usual == pytest.approx(3000 * 0.1) and usual - lockstep == pytest.approx(15.0)
    with pytest.raises(MissingInputError):
        bench_link.plan(load_settings(), checkpoint=MODEL, trace=tmp_path / "no trace")
    with pytest.raises(MissingInputError):
        bench_link.plan(load_settings(), checkpoint="nowhere")
