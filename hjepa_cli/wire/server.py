"""A server puts a controller behind a UDP socket: a blocking loop, which is fast enough.

In one round it takes what has come, a few hundred datagrams at most, does the most urgent batch of
work, and looks at the socket again.
"""

import contextlib
import select
import socket
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from hjepa_cli.compute.interrupts import Postponed
from hjepa_cli.errors import Unavailable, UsageError
from hjepa_cli.wire import protocol
from hjepa_cli.wire.controller import Controller

AT_ONCE = 256  # datagrams taken before the next batch of work
BUFFER_BYTES = 4 * 2**20  # of the socket: a second of a thousand devices
SECOND_S = 1.0
LISTED = 64  # devices in a report, those that fare worst first

Address = tuple[str, int]


def parse_address(text: str, flag: str) -> Address:
    """Return host and port of ``"127.0.0.1:4747"``, ``"[::1]:4747"``, ``":4747"`` or ``"4747"``.

    Raises:
        UsageError: it is none of these.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]") or "127.0.0.1"
    if not port.isascii() or not port.isdigit() or int(port) > 65_535:
        raise UsageError(f"{flag} {text}: expected HOST:PORT, as in 127.0.0.1:4747")
    return host, int(port)


def resolve(address: Address, flag: str) -> tuple[socket.AddressFamily, Any]:
    """Return family and socket address of a host, a name or a number.

    Raises:
        Unavailable: no such host.
    """
    try:
        found = socket.getaddrinfo(*address, type=socket.SOCK_DGRAM)[0]
    except (OSError, UnicodeError) as error:
        raise Unavailable(f"{flag} {written(address)}: {error}") from None
    return found[0], found[4]


def written(address: Any) -> str:
    """Write an address as flags take it."""
    host, port, *_ = address
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def is_loopback(address: Any) -> bool:
    """Say whether only this machine can reach an address."""
    host = str(address[0])
    return host.startswith("127.") or host == "::1"


def open_socket(address: Address, flag: str = "--bind") -> socket.socket:
    """Return a non-blocking UDP socket.

    Raises:
        Unavailable: the port is taken, or the address is not one of this machine.
    """
    family, where = resolve(address, flag)
    opened = socket.socket(family, socket.SOCK_DGRAM)
    try:
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            opened.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES)
        opened.bind(where)
    except OSError as error:
        opened.close()
        raise Unavailable(
            f"{flag} {written(address)}: {error.strerror}",
            hint=f"choose another port, as {flag} {address[0]}:0 does",
        ) from None
    opened.setblocking(False)
    return opened


class Server:
    """It serves a controller until somebody stops it.

    Args:
        controller: to serve.
        opened: a socket of :func:`open_socket`.
        report: is given :func:`snapshot` once a second.
        say: prints a line.
    """

    def __init__(
        self,
        controller: Controller,
        opened: socket.socket,
        report: Callable[[dict[str, Any]], None],
        say: Callable[[str], None],
    ) -> None:
        self._controller, self._socket = controller, opened
        self._report, self._say = report, say
        self._before: Counter[str] = Counter()
        self._lines: dict[str, int] = {}
        self._next_s = time.monotonic() + SECOND_S
        controller.say = self._note

    def run(self, until_s: float = float("inf")) -> None:
        """Serve until a time of the monotonic clock, or an interruption; then say goodbye.

        An interruption waits for the end of a round, so that no line is half printed.
        """
        with Postponed() as signals, signals.postpone() as stopped:
            try:
                while (now_s := time.monotonic()) < until_s and not stopped():
                    self._round(now_s, until_s)
            finally:
                self._send(self._controller.farewell())

    def _round(self, now_s: float, until_s: float) -> None:
        """Take what has come, do a batch of work, and wait if there is nothing more to do."""
        self._receive(now_s)
        if outgoing := self._controller.work(time.monotonic()):
            self._send(outgoing)
            self._controller.sent(time.monotonic())
        if now_s >= self._next_s:
            self._next_s = now_s + SECOND_S
            self._each_second(now_s)
        if not outgoing:
            next_s = min(now_s + self._controller.due_s(now_s), self._next_s, until_s)
            select.select([self._socket], [], [], max(next_s - time.monotonic(), 0.0))

    def _receive(self, now_s: float) -> None:
        for _ in range(AT_ONCE):
            try:
                data, address = self._socket.recvfrom(protocol.LARGEST_BYTES + 1)
            except BlockingIOError:
                return
            except OSError:  # a client's port has been closed
                continue
            self._send(self._controller.receive(data, address, now_s))

    def _send(self, outgoing: list[tuple[bytes, Any]]) -> None:
        for data, address in outgoing:
            with contextlib.suppress(OSError):  # a full buffer, or nobody there: as good as lost
                self._socket.sendto(data, address)

    def _note(self, line: str) -> None:
        """Keep a line for the end of the second: who floods us does not fill a disk."""
        if line in self._lines or len(self._lines) < 8:
            self._lines[line] = self._lines.get(line, 0) + 1

    def _each_second(self, now_s: float) -> None:
        self._controller.tidy(now_s)
        counts = self._controller.counts
        gained = counts - self._before
        self._before = Counter(counts)
        bad = {name: gained[name] for name in ("forged", "malformed", "foreign") if gained[name]}
        if bad:
            listed = ", ".join(f"{count} {name}" for name, count in bad.items())
            self._say(f"ignored in the last second: {listed} (a wrong key, or no device of ours)")
        if gained["skipped_strides"]:
            skipped = gained["skipped_strides"]
            self._say(f"behind schedule: {skipped} strides skipped in the last second")
        for line, count in self._lines.items():
            self._say(line if count == 1 else f"{line} ({count} times)")
        self._lines = {}
        self._report(snapshot(self._controller, gained, now_s))


def snapshot(controller: Controller, gained: Mapping[str, int], now_s: float) -> dict[str, Any]:
    """Return what a server knows, plain: totals, what the last second brought, and devices."""
    waits_ms = 1e3 * np.sort(controller.waited_s or [0.0])
    # As np.quantile, which would import masked arrays while devices wait for a server that starts.
    p50_ms, p99_ms = np.interp([0.5, 0.99], np.linspace(0, 1, len(waits_ms)), waits_ms)
    rows: list[dict[str, Any]] = []
    for number, session in controller.sessions.items():
        age = session.clock.step(now_s) - session.base if session.z is not None else None
        rows.append(
            {
                "device": number,
                "age_steps": age,
                "silent_s": round(now_s - session.heard_s, 3),
                "embeddings": session.embeddings,
                "lost": session.lost,
                "missed": session.missed,
                "answers": session.answers,
                "skipped": session.skipped,
                "delay_steps": session.delay_steps(),
                "source": protocol.SOURCES[session.source],
            }
        )
    answers = sum(row["answers"] for row in rows)
    rows.sort(key=lambda row: (-row["missed"] - row["lost"] - row["skipped"], row["device"]))
    return {
        "devices": len(rows),
        "embeddings_per_s": gained.get("embeddings", 0),
        "datagrams_per_s": gained.get("sent", 0),
        "answer_ms": {"p50": round(float(p50_ms), 3), "p99": round(float(p99_ms), 3)},
        "lost": sum(row["lost"] for row in rows),
        "missed_deadlines": sum(row["missed"] for row in rows),
        "answers": answers,
        "counts": dict(sorted(controller.counts.items())),
        "listed": rows[:LISTED],
    }
