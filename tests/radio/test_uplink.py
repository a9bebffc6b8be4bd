"""The uplink's books, kept a second time device by device: ages, turns, queues, power, copies."""

import math

import numpy as np
import pytest
import torch

from hjepa_cli import plugins
from hjepa_cli.core.control.error_growth import ErrorGrowthTable
from hjepa_cli.core.evaluation.cell_simulation import Outbox
from hjepa_cli.core.radio import uplink as module
from hjepa_cli.core.radio.fading import block_fading
from hjepa_cli.core.radio.phy.phy import Reports
from hjepa_cli.core.radio.schedulers.scheduler import Scheduler, pick
from hjepa_cli.core.radio.uplink import Access, Uplink

DEVICES, BLOCKS, MARGIN_DB, SEED = 6, 2, 4.0, 3


class Books:
    """When each device's newest sample at the controller was taken, and what it is repeating."""

    def __init__(self, rounds):
        self.taken = np.zeros(DEVICES, int)
        self.repeating = {}  # device: (slot its sample was taken in, copies lost)
        self.failures = [[] for _ in range(rounds)]

    def send(self, device, slot, arrived):
        first, lost = self.repeating.pop(device, (slot, 0))
        self.failures[lost].append(not arrived)
        if arrived:
            self.taken[device] = first
        elif lost + 1 < len(self.failures):
            self.repeating[device] = (first, lost + 1)
        return first == slot  # whether this was a new sample


@pytest.mark.parametrize("round_errors", [(0.3,), (0.3, 0.0), (0.3, 0.6, 0.0)])
def test_the_books_are_right(round_errors, monkeypatch):
    random, views, slots = np.random.default_rng(0), [], 800
    wishes = random.random((slots, DEVICES))
    spy = Scheduler("spy", lambda view: (views.append(view), wishes[len(views) - 1])[1])
    monkeypatch.setitem(plugins.SCHEDULERS._added, "spy", (spy, None))
    growth = ErrorGrowthTable(np.ones(1))
    access = Access("spy", BLOCKS, MARGIN_DB, -math.inf, 1.0, round_errors, growth, SEED)
    uplink, books, outbox = Uplink(access, DEVICES), Books(len(round_errors)), Outbox()
    turn, queue = np.full(DEVICES, -1), np.zeros(DEVICES)
    gains = block_fading(SEED, DEVICES)
    for slot in range(slots):
        uplink.begin()
        arrived = uplink.grant()
        view, gain = views[-1], next(gains)
        assert view.power == pytest.approx(10 ** (-MARGIN_DB / 10) / gain)
        assert np.array_equal(view.able, 10 * np.log10(gain) >= -MARGIN_DB)
        assert np.array_equal(view.gain, gain) and view.queue == pytest.approx(queue)
        repeats = [d in books.repeating and view.able[d] for d in range(DEVICES)]
        chosen = pick(np.where(repeats, np.inf, wishes[slot]), BLOCKS)  # copies go first
        if slot:
            assert np.array_equal(view.age, slot - books.taken)
            known = turn >= 0
            assert np.array_equal(view.waited[known], slot - turn[known])
            assert not np.any(arrived & ~(chosen & view.able))
            for device in np.flatnonzero(chosen & view.able):
                new = books.send(device, slot, arrived[device])
                assert uplink.sampled[device] == (
                    new and (arrived[device] or len(round_errors) > 1)
                )
            assert not np.any(uplink.sampled & ~chosen)
        else:
            assert arrived.all() and uplink.sampled.all()
        queue = np.maximum(queue - DEVICES / BLOCKS, 0) + view.age
        turn[chosen] = slot
        # A packet says which device took it and when: what arrives is what the books say.
        fresh = np.stack([np.flatnonzero(uplink.sampled), np.full(uplink.sampled.sum(), slot)], 1)
        packets = outbox.deliver(fresh if len(fresh) else None, uplink.sampled, arrived)
        if not arrived.any():
            assert packets is None
        else:
            expected = np.stack([np.flatnonzero(arrived), books.taken[arrived]], axis=1)
            assert np.array_equal(packets, expected)
    for share, failed in zip(round_errors, books.failures, strict=True):
        error = math.sqrt(share * (1 - share) / len(failed))
        assert np.mean(failed) == pytest.approx(share, abs=4 * error + 1e-12)


def test_embeddings_wait_in_the_outbox_as_they_were_sent():
    outbox, everybody = Outbox(), np.ones(3, dtype=bool)
    with torch.inference_mode():
        first = torch.arange(6.0).reshape(3, 2)
    assert torch.equal(outbox.deliver(first.clone(), everybody, everybody), first)
    second, third, nobody = np.array([0, 1, 0], bool), np.array([0, 0, 1], bool), ~everybody
    assert outbox.deliver(torch.full((1, 2), 7.0), second, nobody) is None
    assert torch.equal(
        outbox.deliver(torch.full((1, 2), 8.0), third, third), torch.full((1, 2), 8.0)
    )
    both = outbox.deliver(torch.full((1, 2), 9.0), third, second | third)
    assert both.tolist() == [[7.0, 7.0], [9.0, 9.0]]
    assert outbox.deliver(None, nobody, nobody) is None


def test_a_flood_of_reports_does_not_deafen_the_base_station():
    """δ stays where the growth table still sends devices to look; else it could never fall."""
    growth = ErrorGrowthTable(np.full(50, 1e-4))  # nobody is expected to err by more than 0.01
    access = Access("innovation", 1, 300.0, -math.inf, 1.0, (0.0,), growth, 0)
    uplink = Uplink(access, 40)
    looks = 0
    for _ in range(3 * module.CHECK_PERIOD):
        uplink.begin()
        looks += uplink.checking().sum()
        uplink.hear(np.ones(40, dtype=bool), np.full(40, 0.9))
        uplink.grant()
        uplink._reported[:] = 0.0  # as if all had been served: they will report again
    assert uplink._delta == pytest.approx(0.01)
    assert looks == 40 * 3 - 5  # every eighth slot each, but for the first slot


def test_reports_in_levels_that_take_a_while():
    """From δ = 0.02 on, each level twice the one below; the base station hears two slots later."""
    growth = ErrorGrowthTable(np.full(50, 1.0))
    told = Reports(2, levels=4, delay_slots=2)
    known = []

    def score(view):
        known.append(view.reported.copy())
        return np.zeros(3)

    plugins.SCHEDULERS._added["listener"] = Scheduler("listener", score, wants_reports=True), None
    try:
        access = Access("listener", 1, 300.0, -math.inf, 1.0, (0.0,), growth, 0, reports=told)
        uplink = Uplink(access, 3)
        for slot in range(5):
            uplink.begin()
            if slot == 1:
                delta = uplink._delta
                uplink.hear(np.ones(3, dtype=bool), delta * np.array([0.9, 1.5, 40.0]))
            uplink.grant()
    finally:
        del plugins.SCHEDULERS._added["listener"]
    steps = [0.0, delta * 2**0.5, delta * 2**3.5]
    assert np.allclose(known[:3], 0.0) and np.allclose(known[3:], steps)


def test_a_copy_waits_for_its_round_trip():
    """After a lost first copy the device is not served before three slots have gone by."""
    growth = ErrorGrowthTable(np.full(50, 1.0))
    access = Access("max-aoi", 2, 300.0, -math.inf, 1.0, (1.0, 0.0), growth, 0, round_trip_slots=3)
    uplink, arrivals = Uplink(access, 2), []
    for _ in range(9):
        uplink.begin()
        arrivals.append(uplink.grant().all())
    # Everybody in slot 0; first copies in 1, second ones in 4; first in 5, second in 8.
    assert np.flatnonzero(arrivals).tolist() == [0, 4, 8]
