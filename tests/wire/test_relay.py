"""A relay does to datagrams what its flags say, by the closed forms of their statistics."""

import contextlib
import errno
import socket
import threading
import time
import types

import numpy as np
import pytest

from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.wire import relay as relay_module
from hjepa_cli.wire.relay import QUEUE_S, Direction, Impairment, Relay, Trace
from hjepa_cli.wire.server import open_socket

N = 20_000


def lost(impairment, seed=0, count=N):
    direction = Direction(impairment, seed, 0)
    return np.array([not direction.passes_on(300, k * 1e-3) for k in range(count)])


def test_nothing_happens_on_an_ideal_link():
    assert Direction(Impairment(), 0, 0).passes_on(300, 5.0) == [5.0]


def test_independent_losses():
    found = lost(Impairment(loss=0.2))
    assert abs(found.mean() - 0.2) < 4 * np.sqrt(0.2 * 0.8 / N)  # four standard errors
    together = (found[1:] & found[:-1]).mean()
    assert abs(together - 0.04) < 4 * np.sqrt(0.04 / N)


def test_bursts_of_losses():
    """Gilbert's chain: the stationary loss, and geometric bursts of the mean that was asked for."""
    found = lost(Impairment(loss=0.2, burst=5.0))
    edges = np.diff(np.concatenate([[0], found.astype(int), [0]]))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    # Of a geometric length of mean 5 the deviation is √20; of the share, what bursts make of it.
    assert abs(lengths.mean() - 5.0) < 4 * np.sqrt(20 / len(lengths))
    assert abs(found.mean() - 0.2) < 4 * np.sqrt(0.2 * 0.8 * 9 / N)


@pytest.mark.parametrize("share", [0.6, 1.0])
def test_independent_losses_may_be_any_share_and_bursts_no_more_than_they_can_make(share):
    """Between bursts of b datagrams at least one arrives: b ÷ (b + 1) are lost at most."""
    assert abs(lost(Impairment(loss=share)).mean() - share) <= 4 * np.sqrt(0.24 / N)
    with pytest.raises(UsageError, match=r"bursts of 1\.25 datagrams; .* at most 0\.555556"):
        Impairment(loss=share, burst=1.25)
    assert Impairment(loss=0.8, burst=4.0).loss == 0.8  # on the bound


def test_a_trace_takes_the_place_of_losses_and_delays():
    for given in ({"loss": 0.3}, {"delay_ms": 5.0}, {"jitter_ms": 1.0}):
        with pytest.raises(UsageError, match="a trace takes the place of"):
            Impairment(**given, trace=Trace((0.0,)))


def test_delay_and_jitter():
    direction = Direction(Impairment(delay_ms=10, jitter_ms=6), 1, 0)
    taken = np.array([direction.passes_on(300, 1.0)[0] - 1.0 for _ in range(N)])
    assert taken.min() >= 0.010 and taken.max() <= 0.016
    assert abs(taken.mean() - 0.013) < 4 * 0.006 / np.sqrt(12 * N)


def test_doubled_and_overtaking():
    direction = Direction(Impairment(delay_ms=20, reorder=0.1, duplicate=0.3), 1, 0)
    times = [direction.passes_on(300, 0.0) for _ in range(N)]
    assert abs(np.mean([len(one) == 2 for one in times]) - 0.3) < 4 * np.sqrt(0.21 / N)
    assert abs(np.mean([one[0] == 0.0 for one in times]) - 0.1) < 4 * np.sqrt(0.09 / N)


def test_a_rate_makes_datagrams_wait_and_then_drops_them():
    direction = Direction(Impairment(rate_kbps=80), 0, 0)  # 1,000 bytes in 100 ms
    times = [direction.passes_on(1000, 0.0) for _ in range(5)]
    np.testing.assert_allclose([one[0] for one in times[:3]], [0.1, 0.2, 0.3])
    assert times[3:] == [[], []] and QUEUE_S < 0.3


def test_the_same_seed_does_the_same_each_way_its_own():
    how = Impairment(loss=0.3, burst=2)
    np.testing.assert_array_equal(lost(how, 7, 500), lost(how, 7, 500))
    assert (lost(how, 7, 500) != lost(how, 8, 500)).any()
    up, down = (Direction(how, 7, way) for way in (0, 1))
    assert [up.passes_on(9, 0.0) for _ in range(99)] != [down.passes_on(9, 0.0) for _ in range(99)]


def test_a_trace_is_played_to_datagrams_and_to_the_simulator(tmp_path):
    path = tmp_path / "trace"
    path.write_text("# recorded\n3.2\n\nlost\n0\n7.6\n")
    trace = Trace.read(path)
    direction = Direction(Impairment(trace=trace), 0, 0)
    times = [direction.passes_on(300, 0.0) for _ in range(8)]
    np.testing.assert_allclose(times[0] + times[2] + times[3], [0.0032, 0.0, 0.0076])
    assert times[1] == [] and times[4:] == times[:4]
    draws, gone = trace.draws(steps=6, devices=2, step_ms=1.0)
    assert draws.extra_steps[:, 0].tolist() == [3, 0, 0, 8, 3, 0]
    assert gone[:, 0].tolist() == [False, True, False, False, False, True]
    assert gone[:, 1].tolist() == [False, False, False, True, False, False]  # from another place


@pytest.mark.parametrize("delay_ms", [32_768.0, 1e300])
def test_delays_of_a_trace_are_never_negative(delay_ms):
    draws, _ = Trace((delay_ms, 1.0)).draws(steps=2, devices=1, step_ms=1.0)
    assert draws.extra_steps[1] == 1 and draws.extra_steps[0] >= 32_768


@pytest.mark.parametrize("text", ["", "# nothing\n", "3\nsoon\n", "-1\n", "nan\n", "inf\n"])
def test_what_is_no_trace_is_refused(tmp_path, text):
    path = tmp_path / "trace"
    path.write_text(text)
    with pytest.raises(DataError, match=r"trace"):
        Trace.read(path)


@pytest.mark.parametrize("limited", ["known", "met"])
def test_more_clients_than_files_are_passed_on_by_ports_that_make_place(monkeypatch, limited):
    """Whether the limit is the process's own or others have taken what there is."""
    opened, real, most = [], socket.socket, 3

    class Limited(real):
        def __init__(self, *arguments):
            opened[:] = [one for one in opened if one.fileno() >= 0]
            if len(opened) == most:
                raise OSError(errno.EMFILE, "too many open files")
            super().__init__(*arguments)
            opened.append(self)

    with (
        contextlib.closing(open_socket(("127.0.0.1", 0))) as server,
        contextlib.closing(open_socket(("127.0.0.1", 0))) as listening,
    ):
        if limited == "known":
            files = relay_module.SPARE_FILES + most
            monkeypatch.setattr(relay_module.resource, "getrlimit", lambda kind: (files, files))
        ideal = [Direction(Impairment(), 0, way) for way in (0, 1)]
        relay = Relay(listening, server.getsockname(), socket.AF_INET, *ideal)
        senders = [real(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(9)]
        named = types.SimpleNamespace(**vars(socket) | {"socket": Limited})
        monkeypatch.setattr(relay_module, "socket", named)
        for number, sender in enumerate(senders):
            sender.sendto(bytes([number]), listening.getsockname())
        relay.run(time.monotonic() + 0.2)
        got = set()
        with contextlib.suppress(BlockingIOError):
            while True:
                got |= set(server.recv(10))
        assert got == set(range(9)) and len(relay._ports) <= most
        most = 0  # and where there is none at all, a datagram is lost and nothing ends
        relay = Relay(listening, server.getsockname(), socket.AF_INET, *ideal)
        senders[0].sendto(b"x", listening.getsockname())
        relay.run(time.monotonic() + 0.05)
        assert relay.counts["up"] == relay.counts["up_full"] == 1
        for sender in senders:
            sender.close()


def test_two_clients_over_real_sockets():
    """The server sees two ports, and each client gets its own answers back."""
    server, listening = open_socket(("127.0.0.1", 0)), open_socket(("127.0.0.1", 0))
    ideal = [Direction(Impairment(duplicate=0.999999), 0, way) for way in (0, 1)]
    relay = Relay(listening, server.getsockname(), socket.AF_INET, *ideal)
    thread = threading.Thread(target=relay.run, args=(time.monotonic() + 1.5,))
    thread.start()
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    server.setblocking(True)
    server.settimeout(5)
    try:
        for number, client in enumerate(clients):
            client.settimeout(5)
            client.sendto(bytes([number]), listening.getsockname())
        seen = {}
        for _ in range(4):
            data, address = server.recvfrom(10)
            seen.setdefault(data, set()).add(address)
            server.sendto(b"to " + data, address)
        assert sorted(map(len, seen.values())) == [1, 1]  # each from a port of its own
        assert not seen[b"\0"] & seen[b"\1"]
        for number, client in enumerate(clients):
            assert client.recv(10) == b"to " + bytes([number])
    finally:
        thread.join()
        for one in (*clients, server, listening):
            one.close()
