"""A real server on loopback sockets: devices come and go, strangers shout, and nobody falls."""

import contextlib
import threading
import time
from types import SimpleNamespace

import linear
import numpy as np

from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import serve
from hjepa_cli.wire import protocol
from hjepa_cli.wire.device import Device
from hjepa_cli.wire.server import Server, open_socket

BOUND_S = 20.0  # no test waits longer


@contextlib.contextmanager
def serving(controller, lines, reports, address=("127.0.0.1", 0)):
    opened, stop = open_socket(address), threading.Event()
    server = Server(controller, opened, reports.append, lines.append)

    def run():
        while not stop.is_set():
            server.run(time.monotonic() + 0.1)

    controller.farewell = list  # each run would say goodbye
    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield opened.getsockname()
    finally:
        stop.set()
        thread.join()
        opened.close()


def take(device, opened, step):
    with contextlib.suppress(BlockingIOError):
        while True:
            device.receive(opened.recv(2048), step, time.monotonic())


def drive(device, opened, address, z, until):
    """Connect, send embeddings now and then, and take what comes until ``until()``."""
    end_s, step = time.monotonic() + BOUND_S, 0
    while not until():
        assert time.monotonic() < end_s
        for data in (device.upkeep(time.monotonic()), device.embed(step, z)):
            if data is not None:
                opened.sendto(data, address)
        time.sleep(0.01)
        take(device, opened, step)
        device.play(step)
        step += 1


def test_devices_are_driven_over_sockets():
    lines, reports, z = [], [], np.ones(linear.SIZE, np.float32)
    with (
        serving(linear.controller(), lines, reports) as address,
        open_socket(("127.0.0.1", 0)) as opened,
    ):
        one = linear.device(7)
        drive(one, opened, address, z, lambda: one.counts["planned"] > 20 and reports)
        expected, _ = linear.LinearRuntime().plan(z[None])
        assert abs(float(one._last.forces_n[0]) - float(expected[0, 0, 0])) < 10
    assert reports[-1]["devices"] == 1
    assert reports[-1]["listed"][0]["device"] == 7
    assert reports[-1]["counts"]["sent"] > 0


def test_a_wrong_key_gets_nothing_but_a_line_a_second():
    lines, reports = [], []
    with (
        serving(linear.controller(), lines, reports) as address,
        open_socket(("127.0.0.1", 0)) as opened,
    ):
        started_s = time.monotonic()
        for number in range(5_000):
            wrong = Device(linear.bundle(), number, bytes(32), 0.01)
            opened.sendto(wrong.upkeep(0.0), address)
            opened.sendto(b"HJ\x01\x03" + bytes(60), address)
            if number % 100 == 0:
                time.sleep(0.001)
        while not lines and time.monotonic() < started_s + BOUND_S:
            time.sleep(0.05)
        took_s = time.monotonic() - started_s
        with contextlib.suppress(BlockingIOError):
            raise AssertionError(opened.recv(2048))
    assert lines and len(lines) <= took_s + 1
    assert all(line.startswith("ignored in the last second") for line in lines)


def test_a_server_that_is_killed_and_started_again_takes_its_devices_up():
    z, lines = np.ones(linear.SIZE, np.float32), []
    with open_socket(("127.0.0.1", 0)) as opened:
        one = linear.device(3, actor=lambda: np.zeros(1, np.float32), watchdog_steps=10)
        with serving(linear.controller(), lines, []) as address:
            drive(one, opened, address, z, lambda: one.counts["planned"] > 5)
        drive(one, opened, address, z, lambda: one.counts["local"] > 5)
        before = one.counts["planned"]
        with serving(linear.controller(), lines, [], address):
            started_s = time.monotonic()
            drive(one, opened, address, z, lambda: one.counts["planned"] > before)
        assert time.monotonic() - started_s < BOUND_S
    assert protocol.SOURCES[one._last.source] == "planned"


def test_hellos_that_come_while_the_networks_are_loaded_wait(monkeypatch):
    opened = []

    class Serving:
        def __init__(self, controller, opened, report, say):
            self._socket = opened

        def run(self, until_s):
            assert self._socket.recv(100) == b"hello"

    def warm_up(*names):
        with open_socket(("127.0.0.1", 0)) as device:
            device.sendto(b"hello", opened[0].getsockname())

    def opening(address):
        opened.append(open_socket(address))
        return opened[0]

    fakes = {
        "open_bundle": lambda path: SimpleNamespace(plant="desktop", digest=b""),
        "Runtime": lambda *given: SimpleNamespace(warm_up=warm_up),
        "Controller": lambda *given, **more: None,
        "snapshot": lambda *given: {},
        "Server": Serving,
        "open_socket": opening,
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(serve, name, fake)
    serve.run(Screen(quiet=True), model=None, bind="127.0.0.1:0")


def test_a_scrape_sees_one_whole_snapshot(monkeypatch):
    """It runs in a thread of its own: what it was given must not change under it."""
    scrapes = []

    @contextlib.contextmanager
    def exposed(host, port, latest):
        scrapes.append(latest)
        yield host, port

    class Reporting:
        def __init__(self, controller, opened, report, say):
            self._report = report

        def run(self, until_s):
            before = scrapes[0]()
            self._report({"devices": 1})
            assert before == {"devices": 0} and scrapes[0]() == {"devices": 1}

    fakes = {
        "open_bundle": lambda path: SimpleNamespace(plant="desktop", digest=b""),
        "Runtime": lambda *given: SimpleNamespace(warm_up=lambda *names: None),
        "Controller": lambda *given, **more: None,
        "snapshot": lambda *given: {"devices": 0},
        "Server": Reporting,
    }
    for name, fake in fakes.items():
        monkeypatch.setattr(serve, name, fake)
    monkeypatch.setattr(serve.prometheus, "exposed", exposed)
    serve.run(Screen(quiet=True), model=None, bind="127.0.0.1:0", metrics="127.0.0.1:0")
    assert len(scrapes) == 1
