"""Controller and device as state machines: what any network may do to them, without a network."""

import tracemalloc
from pathlib import Path

import linear
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hjepa_cli.wire import auth, protocol
from hjepa_cli.wire import controller as controllers
from hjepa_cli.wire.bundle import Bundle
from hjepa_cli.wire.device import Device, EverySteps, OnInnovation

# Of int8: half a code of a vector whose largest value is some 4, in eight values, through the law.
CODED = 8 * 0.5 * 4 / 127 * np.abs(linear.LAW).max() * 2


def whole_strides(steps: int) -> int:
    return -(-steps // linear.STRIDE) * linear.STRIDE


def test_promptly_every_force_is_that_of_the_true_state():
    errors = linear.World(linear.controller(), linear.device(), kicks=(40, 100)).run(200, gap=20)
    assert errors.max() < CODED  # both kicks come with a packet


@pytest.mark.parametrize(
    "up",
    [
        pytest.param(lambda k: 5, id="constant"),
        pytest.param(lambda k: 3 + k * 7919 % 5, id="jitter"),
        pytest.param(lambda k: 12, id="long"),
    ],
)
def test_a_late_embedding_is_moved_on_under_the_forces_really_played(up):
    """After a kick the old plan is played until the answer comes; then the force is right at once.

    The first packets tell the delay. Each kick comes with a packet, and its answer after ``up``
    steps, made whole strides: only in these may forces be wrong.
    """
    kicks = (200, 320, 440)
    world = linear.World(linear.controller(), linear.device(), up=up, kicks=kicks)
    errors = world.run(560, gap=40)
    blind = np.zeros(560, bool)
    for kick in kicks:
        blind[kick : kick + whole_strides(up(kick))] = True
    assert errors[blind].max() > 5 * CODED  # the kick was felt, and nothing was known of it
    assert errors[200:][~blind[200:]].max() < CODED


def test_delays_down_count_as_well():
    world = linear.World(linear.controller(), linear.device(), down=lambda k: 3, kicks=(200,))
    errors = world.run(320, gap=40)
    assert errors[200 + whole_strides(3) :].max() < CODED


def test_lost_datagrams_are_made_good_by_the_next_ones():
    """Of three datagrams two are lost: each force is in four, and none is missed."""
    one = linear.device()
    world = linear.World(linear.controller(), one, down=lambda k: 0 if k // 4 % 3 == 0 else None)
    errors = world.run(200, gap=200)
    assert linear.planned_steps(one) == 200
    assert errors.max() < CODED


@pytest.mark.parametrize(("stride", "axes"), [(4, 6), (4, 16), (64, 1), (20, 3)])
def test_datagrams_hold_a_stride_of_any_length_and_no_more_forces_than_devices_take(stride, axes):
    class Counting:
        """It plans as many forces as it is to."""

        def plan(self, z):
            return np.ones((len(z), stride, axes), np.float32), z

    manifest = linear.bundle().manifest | {"stride": stride, "action_shape": [axes]}
    made = Bundle(Path("."), manifest, bytes(32))
    server = controllers.Controller(made, Counting(), linear.KEY)
    one = Device(made, 1, linear.KEY, linear.PERIOD_S)
    linear.connect(server, one)
    server.receive(one.embed(0, np.zeros(linear.SIZE, np.float32)), 1, 0.0)
    for k in range(160):
        for data, _ in linear.settle(server, k * linear.PERIOD_S):
            one.receive(data, k, k * linear.PERIOD_S)
        one.play(k)
    assert linear.planned_steps(one) == 160 and not one.ignored


def test_what_an_older_embedding_foresaw_is_never_played_after_a_newer_one():
    """The bug that lockstep found: a short new plan must take away the tail of a long old one."""
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    server.receive(one.embed(0, np.ones(linear.SIZE, np.float32)), 1, 0.0)
    for data, _ in linear.settle(server, 0.0):
        one.receive(data, 0, 0.0)
    foreseen = one.planned_n(10)
    assert foreseen is not None
    one.play(0)
    server.receive(one.embed(1, -np.ones(linear.SIZE, np.float32)), 1, linear.PERIOD_S)
    ((data, _),) = server.work(linear.PERIOD_S)  # one stride alone
    one.receive(data, 1, linear.PERIOD_S)
    assert one.planned_n(4) is not None and one.planned_n(10) is None


def test_an_answer_is_repeated_in_the_next_steps():
    """All that is sent in the step of a kick and in the next is lost: the third step knows it."""
    lost = (100, 101)
    server, one = linear.controller(), linear.device()
    down = lambda k: None if k in lost else 0  # noqa: E731
    errors = linear.World(server, one, down=down, kicks=(100,)).run(104, gap=50)
    assert errors[102:].max() > CODED > errors[:100].max()  # it was told that two steps late
    assert linear.planned_steps(one) == 104
    assert one.answered == 100


def test_a_device_that_has_stood_still_is_not_taken_for_late():
    """Its steps stop for ten periods, fewer than the lead: the next answers come as promptly."""
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    z, now_s, first = np.ones(linear.SIZE, np.float32), 0.0, []
    for step in range(0, 400, 40):
        now_s += 40 * linear.PERIOD_S + (10 * linear.PERIOD_S if step == 200 else 0.0)
        server.receive(one.embed(step, z), 1, now_s)
        outgoing = [data for data, _ in linear.settle(server, now_s)]
        first.append(protocol.parse(outgoing[0]).first - step)
        for data in outgoing:
            one.receive(data, step, now_s)
        for k in range(step, step + 40):
            one.play(k)
    assert first[:5] == [0] * 5 and first[7:] == [0] * 3  # two answers at most looked late


# -- what must change nothing


def state(server, one):
    session = server.sessions[one.number]
    kept = (session.planned, session.base, session.newest, session.counter, session.address)
    return (*kept, session.z.tobytes(), session.forces_n(0, 64).tobytes())


def ready():
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    sent = one.embed(0, np.ones(linear.SIZE, np.float32))
    server.receive(sent, 1, 0.0)
    answers = [data for data, _ in linear.settle(server, 0.0)]
    return server, one, sent, answers


def of_version(version, data):
    """Return what a side of another version sends, whose head and tag lie where ours do."""
    body = data[:2] + bytes([version]) + data[3 : -protocol.TAG_BYTES]
    return auth.tagged(linear.KEY, body)


def test_old_doubled_and_foreign_datagrams_change_nothing():
    server, one, sent, answers = ready()
    overtaken = one.embed(3, np.ones(linear.SIZE, np.float32))
    newest = one.embed(5, np.ones(linear.SIZE, np.float32))
    server.receive(newest, 1, 0.05)
    linear.settle(server, 0.05)
    before, other = state(server, one), linear.device(2)
    linear.connect(linear.controller(), other)
    foreign = other.embed(9, np.ones(linear.SIZE, np.float32))
    for data in (sent, newest, overtaken, foreign, answers[0]):
        assert server.receive(data, "elsewhere", 0.06) == []
    assert state(server, one) == before
    assert server.work(0.05) == []
    assert server.counts["doubled"] == 2 and server.counts["late"] == 1
    # A device takes each answer once, and the older not after the newer.
    for data in answers:
        assert one.receive(data, 0, 0.0)
    for data in (*answers, sent):
        assert not one.receive(data, 0, 0.0)


def test_a_recorded_session_proves_nothing_to_a_new_server():
    _, _, sent, _ = ready()
    hello = linear.device().upkeep(0.0)
    server = linear.controller()
    server.receive(hello, "thief", 0.0)
    assert server.receive(sent, "thief", 0.0) == [] and not server.sessions
    assert server.counts["foreign"] == 1
    assert server.receive(hello, "thief", 1.0) == [] and server.counts["doubled"] == 1


def test_a_hello_alone_takes_nobodys_place():
    """A session goes on until a newer one has proved itself."""
    server, *_ = ready()
    before = server.sessions[1]
    again = linear.device(1)
    linear.connect(server, again, now_s=0.5)
    assert server.sessions[1] is before
    server.receive(again.embed(0, np.ones(linear.SIZE, np.float32)), "new", 0.5)
    assert server.sessions[1] is not before and server.sessions[1].address == "new"


def test_recorded_hellos_do_not_end_a_handshake_under_way():
    """A server that has started anew knows no recording; the device's own hello is still good."""
    recorded = [linear.device(1).upkeep(0.0) for _ in range(2 * protocol.TRIES)]
    server, one = linear.controller(), linear.device(1)
    for hello in recorded[: protocol.TRIES]:
        server.receive(hello, "thief", 0.0)
    linear.connect(server, one)
    for hello in recorded[protocol.TRIES + 1 :]:
        server.receive(hello, "thief", 0.0)
    server.receive(one.embed(0, np.ones(linear.SIZE, np.float32)), 1, 0.0)
    assert server.sessions[1].address == 1 and not server._pending


def test_another_key_another_model_another_version_and_no_place():
    server = linear.controller(most_devices=1)
    wrong = Device(linear.bundle(), 1, bytes(32), 0.01)
    assert server.receive(wrong.upkeep(0.0), 1, 0.0) == []
    other = Device(linear.bundle(plant="gym", digest=b"e" * 32), 2, linear.KEY, 0.01)
    for data, _ in server.receive(other.upkeep(0.0), 2, 0.0):
        other.receive(data, 0, 0.0)
    assert (other.refused, other.plant) == (protocol.OTHER_MODEL, "linear")
    newer = linear.device(3)
    ((answer, _),) = server.receive(of_version(7, newer.upkeep(0.0)), 3, 0.0)
    newer.receive(answer, 0, 0.0)
    assert newer.refused == protocol.OTHER_VERSION
    first, second = linear.device(4), linear.device(5)
    linear.connect(server, first)
    server.receive(first.embed(0, np.ones(linear.SIZE, np.float32)), 4, 0.0)
    for data, _ in server.receive(second.upkeep(0.0), 5, 0.0):
        second.receive(data, 0, 0.0)
    assert second.refused == protocol.FULL and not second.connected


def test_an_older_server_is_told_from_a_newer_one():
    one = linear.device()
    one.upkeep(0.0)
    answer = of_version(3, linear.controller()._answer(1, next(iter(one._asked_s)), bytes(8), 0))
    one.receive(answer[: -protocol.TAG_BYTES] + bytes(protocol.TAG_BYTES), 0, 0.0)
    assert not one.refused  # anybody could have said that
    one.receive(answer, 0, 0.0)
    assert (one.refused, one.server_version) == (protocol.OTHER_VERSION, 3)


def test_who_has_no_key_is_of_no_version():
    """A flood of hellos of other versions is not answered, and keeps nobody else out."""
    server, one = linear.controller(), linear.device()
    untagged = b"HJ\x07\x01" + bytes(72 + protocol.TAG_BYTES)
    for _ in range(2 * int(controllers.GREETING[1])):
        assert server.receive(untagged, "stranger", 0.0) == []
    linear.connect(server, one)
    for number in range(2 * int(controllers.GREETING[1])):  # one with the key keeps out its like
        server.receive(of_version(7, linear.device(number).upkeep(0.0)), number, 0.0)
    assert server.counts["limited"] == controllers.GREETING[1]
    linear.connect(server, linear.device(2))


def test_a_hundred_thousand_bad_datagrams_change_nothing():
    """Noise, cuts, changed bytes, forgeries and replays, at both ends."""
    server, one, sent, answers = ready()
    for data in answers:
        one.receive(data, 0, 0.0)
    before, forces_n = state(server, one), dict(one._forces_n)
    random = np.random.default_rng(0)
    forged = auth.tagged(bytes(32), sent[: -protocol.TAG_BYTES])
    whole = [sent, forged, *answers, linear.device().upkeep(0.0)]

    def bad(number):
        kind, data = number % 5, bytearray(whole[number // 5 % len(whole)])
        if kind == 0:
            return random.bytes(int(random.integers(0, 400)))
        if kind == 1:
            return bytes(data[: random.integers(0, len(data))])
        if kind == 2:
            data[random.integers(2, len(data))] ^= int(random.integers(1, 256))
            return bytes(data)
        if kind == 3:
            return forged
        return sent

    for number in range(2_000):  # pending tables fill, and dictionaries reach their sizes
        server.receive(bad(number), number, 0.0)
        one.receive(bad(number), 0, 0.0)
    tracemalloc.start()
    for number in range(100_000):
        server.receive(bad(number), number, 0.0)
        if number % 4 == 0:
            one.receive(bad(number), 0, 0.0)
    grown, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert grown < 300_000
    assert state(server, one) == before and server.work(0.0) == []
    assert list(server.sessions) == [1]
    assert {at: f.tobytes() for at, f in one._forces_n.items()} == {
        at: f.tobytes() for at, f in forces_n.items()
    }


# -- load and time


def test_ten_thousand_silent_devices_do_not_delay_the_others():
    """They sent one embedding each, long ago: whoever sends now is answered in the next batch."""
    server = linear.controller(most_devices=20_000, timeout_s=1e9)
    z, now_s = np.ones(linear.SIZE, np.float32), 0.0
    for number in range(10_000):
        now_s = number / controllers.GREETING[0]
        quiet = linear.device(number)
        linear.connect(server, quiet, now_s=now_s)
        server.receive(quiet.embed(0, z), number, now_s)
        server.work(now_s)
    assert len(server.sessions) == 10_000
    now_s += 10.0  # all have faded, thousands of strides of theirs are due
    busy = [linear.device(20_000 + i) for i in range(16)]
    linear.connect(server, *busy, now_s=now_s)
    for one in busy:
        server.receive(one.embed(0, z), one.number, now_s)
    batches = [server.work(now_s) for _ in range(1 + controllers.LEAD_STEPS // linear.STRIDE)]
    for batch in batches:  # the answers, then their look-ahead, before anybody who is silent
        assert {address for _, address in batch} == {one.number for one in busy}
    assert server.work(now_s)  # and then there is time for the silent ones


def test_one_device_cannot_take_more_than_its_allowance():
    server, one, *_ = ready()
    taken = 0
    for step in range(1, 1000):  # within a single control step of wall time
        server.receive(one.embed(step, np.ones(linear.SIZE, np.float32)), 1, 0.0)
        taken = server.counts["embeddings"] - 1
    assert taken <= controllers.ALLOWANCE[1]
    assert server.counts["limited"] >= 900


def test_who_has_no_key_spends_no_device_s_allowance():
    """Forged tags and recordings come by the hundred for each true embedding, all in one moment."""
    server, one, sent, _ = ready()
    z = np.ones(linear.SIZE, np.float32)

    def flood(now_s):
        for _ in range(200):
            server.receive(b"HJ\x01\x03" + one.number.to_bytes(4, "little") + bytes(16), 2, now_s)
            server.receive(sent, 2, now_s)

    for step in range(1, 51):
        flood(step * linear.PERIOD_S)
        server.receive(one.embed(step, z), 1, step * linear.PERIOD_S)
    assert server.counts["embeddings"] == 51 and not server.counts["limited"]
    again = linear.device(one.number)
    linear.connect(server, again, now_s=0.6)
    flood(0.6)
    server.receive(again.embed(0, z), "new", 0.6)
    assert server.sessions[one.number].address == "new"


def at_the_last_step(server, one):
    server.receive(one.embed(protocol.MOST_STEPS - 1, np.ones(linear.SIZE, np.float32)), 1, 0.0)


def with_all_counters(server, one):
    server.sessions[one.number].counter = 2**32 - 2


def after_an_hour_of_silence_at_a_microsecond_a_step(server, one):
    quick = Device(linear.bundle(), one.number, linear.KEY, 1e-6)
    linear.connect(server, quick)
    server.receive(quick.embed(0, np.ones(linear.SIZE, np.float32)), 1, 0.0)
    server.work(0.0)


@pytest.mark.parametrize(
    "end",
    [at_the_last_step, with_all_counters, after_an_hour_of_silence_at_a_microsecond_a_step],
)
def test_a_session_whose_numbers_end_ends_alone(end):
    """None of them has more than 32 bits; the server goes on with all other devices."""
    server, one, *_ = ready()
    end(server, one)
    for now_s in (0.0, 0.1, 5_000.0):
        for data, _ in linear.settle(server, now_s):
            protocol.parse(data)
    assert not server.sessions and server.counts["used_up"] == 1
    other = linear.device(2)
    linear.connect(server, other)
    server.receive(other.embed(0, np.ones(linear.SIZE, np.float32)), 2, 0.0)
    assert linear.settle(server, 0.0)


def test_behind_schedule_it_skips_what_is_past():
    server, *_ = ready()
    planned, before = server.sessions[1].planned, server.counts["strides"]
    outgoing = linear.settle(server, 4.0)  # 400 steps later
    skipped = server.counts["skipped_strides"]
    assert skipped * linear.STRIDE > 400 - planned - linear.STRIDE
    ahead = 1 + (controllers.LEAD_STEPS + linear.STRIDE) / linear.STRIDE
    assert server.counts["strides"] - before <= ahead
    last = protocol.parse(outgoing[-1][0])
    assert last.first + len(last.forces_n) >= 400 + controllers.LEAD_STEPS


def test_silent_devices_are_forgotten_and_memory_is_bounded():
    server, *_ = ready()
    server.tidy(9.0)
    assert server.sessions
    server.tidy(11.0)
    assert not server.sessions and server.work(11.0) == []
    for number in range(controllers.PENDING + 500):
        now_s = 20 + number / controllers.GREETING[0]
        stranger = linear.device(number)
        server.receive(stranger.upkeep(now_s), number, now_s)
    assert len(server._pending) <= controllers.PENDING
    for _ in range(3 * protocol.TRIES):
        now_s += 0.1
        server.receive(linear.device(number).upkeep(now_s), number, now_s)
    assert len(server._pending[number]) <= protocol.TRIES
    assert len(server._nonces) <= controllers.NONCES
    server.tidy(1e6)
    assert not server._pending


def test_a_restarted_server_takes_a_device_up_within_a_second():
    server, one, *_ = ready()
    one.receive(server.farewell()[0][0], 0, 0.0)
    assert not one.connected
    killed = linear.device()
    linear.connect(server, killed)
    fresh, now_s = linear.controller(), 0.0
    while not fresh.sessions:
        now_s += linear.PERIOD_S
        step = round(now_s / linear.PERIOD_S)
        assert now_s < 1.0
        if hello := killed.upkeep(now_s):
            for data, _ in fresh.receive(hello, 1, now_s):
                killed.receive(data, step, now_s)
        if killed.is_new(step):
            fresh.receive(killed.embed(step, np.ones(linear.SIZE, np.float32)), 1, now_s)


@pytest.mark.parametrize("round_trip_steps", [5, 20, 70, 120])
def test_a_device_connects_over_a_long_round_trip(round_trip_steps):
    """Of hellos the newest few count, which come ever more rarely."""
    server, one = linear.controller(), linear.device()
    flying, z = {}, np.ones(linear.SIZE, np.float32)
    for step in range(400):
        now_s = step * linear.PERIOD_S
        sent = [one.upkeep(now_s), one.embed(step, z) if one.is_new(step) else None]
        answers = [answer for data in sent if data for answer in server.receive(data, 1, now_s)]
        flying[step + round_trip_steps] = answers + linear.settle(server, now_s)
        for data, _ in flying.pop(step, []):
            one.receive(data, step, now_s)
        one.play(step)
    assert one.counts["planned"] > 50
    assert server.counts["sessions"] == 1 and server.counts["hellos"] <= 9
    tries = [k for k in range(400, 900) if one.upkeep(k * linear.PERIOD_S)]  # the server is gone
    np.testing.assert_allclose(np.diff(tries)[:6], [10, 20, 40, 40, 40, 40], atol=1)


def test_a_device_tells_a_server_that_comes_back_what_it_sees_now():
    """Both were stopped only; what the server knows is old, and the next embedding may be far."""
    server, one, *_ = ready()
    z, silent_steps = np.ones(linear.SIZE, np.float32), 200
    server.receive(one.embed(30, z), 1, 0.3)
    answers = [data for data, _ in linear.settle(server, 0.3)]
    one.receive(answers[0], 30, 0.3)
    assert not one.is_new(60)  # it was silent for less than one notices
    one.receive(answers[1], 30 + silent_steps, 0.3 + silent_steps * linear.PERIOD_S)
    assert one.is_new(30 + silent_steps)
    one.embed(30 + silent_steps, z)
    assert not one.is_new(30 + 2 * silent_steps)  # once


def test_a_device_that_is_slower_than_its_period_gets_every_force():
    """Both sides have too little time: strides are skipped by what the device needs, not by when.

    Steps take three periods, and the controller is let work only every eighth step.
    """
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    z = np.ones(linear.SIZE, np.float32)
    for step in range(800):
        now_s = 3 * step * linear.PERIOD_S
        if step % 40 == 0:
            server.receive(one.embed(step, z), 1, now_s)
        if step % 8 == 0:
            for data, _ in linear.settle(server, now_s):
                one.receive(data, step, now_s)
        source = one.play(step).source
        assert step < 200 or source == protocol.PLANNED, step
    assert server.counts["skipped_strides"] * linear.STRIDE < 2 * 3 * 200


def test_a_device_whose_clock_jumps_is_still_driven():
    """Its steps stand still for two seconds, then go on; or leap ahead by a thousand."""
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    z, now_s = np.ones(linear.SIZE, np.float32), 0.0
    for step in (0, 40, 80, 120, 1120, 1160):
        now_s += 40 * linear.PERIOD_S + (2.0 if step == 80 else 0.0)
        server.receive(one.embed(step, z), 1, now_s)
        for data, _ in linear.settle(server, now_s):
            one.receive(data, step, now_s)
        assert one.planned_n(step) is not None, step
        one.play(step)


# -- a device without a controller


def play(one, steps):
    return [one.play(k).source for k in steps]


def test_silence_holds_then_the_actor_on_the_device_drives():
    server, actor_n = linear.controller(), np.array([7.0], np.float32)
    one = linear.device(1, actor=lambda: actor_n, watchdog_steps=40)
    linear.connect(server, one)
    server.receive(one.embed(0, np.ones(linear.SIZE, np.float32)), 1, 0.0)
    for data, _ in linear.settle(server, 0.0):
        one.receive(data, 0, 0.0)
    sources = play(one, range(200))
    planned = sources.count(protocol.PLANNED)
    assert planned >= controllers.LEAD_STEPS
    assert sources == (
        [protocol.PLANNED] * planned + [protocol.HELD] * (40 - planned) + [protocol.LOCAL] * 160
    )
    assert one.play(200).forces_n == 7.0


def test_without_an_actor_it_ends_at_no_force():
    one = linear.device(1, watchdog_steps=40)
    assert play(one, range(50)) == [protocol.ZERO] * 50  # never heard of the controller at all
    assert not one.play(50).forces_n.any()


def test_forces_are_clipped_to_the_limit():
    server, one = linear.controller(), linear.device()
    linear.connect(server, one)
    server.receive(one.embed(0, np.full(linear.SIZE, 60_000, np.float32)), 1, 0.0)
    for data, _ in linear.settle(server, 0.0):
        one.receive(data, 0, 0.0)
    assert np.abs(one.play(0).forces_n).max() <= 1000.0


@given(st.integers(1, 50), st.integers(0, 500))
def test_every_so_many_steps(gap, step):
    assert EverySteps(gap).due(step) == (step % gap == 0)


def test_on_innovation_it_sends_first_when_wrong_and_when_long_silent():
    rule = OnInnovation(0.1, longest_steps=100)
    assert rule.wants_look(0) and rule.due(0, None)
    assert not rule.due(8, 0.05)
    assert rule.due(16, 0.2)
    assert not rule.due(24, 0.01)
    assert rule.wants_look(116) and rule.due(116, None)
    assert not rule.wants_look(117)
    assert rule.wants_look(1) and rule.due(1, None)  # in a session whose steps have begun anew
