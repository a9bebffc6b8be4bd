"""A relay is a network that misbehaves on purpose, the same way every time.

It stands between devices and a controller and treats datagrams each way as an :class:`Impairment`
says: lost one by one or in bursts, late by a constant and by chance, doubled, overtaken, or slowed
to a rate. What happens to the n-th datagram of a direction follows from the seed and n alone.
Recorded traces take the place of chance; the simulator reads the same file
(:meth:`Trace.draws`).
"""

import contextlib
import dataclasses
import heapq
import itertools
import resource
import select
import socket
import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.arrays import Bools
from hjepa_cli.core.control.loop import LinkDraws
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.storage import files
from hjepa_cli.wire import protocol

_KEY = 0x2E1A
MOST_CLIENTS = 16_384
SPARE_FILES = 32  # descriptors that clients' ports leave to everything else
MOST_WAITING = 200_000  # datagrams in the relay
LONGEST_STEPS = 2**31  # of a delay: no loop lasts so long
QUEUE_S = 0.25  # longest wait for a rate
LOST = "lost"


@dataclasses.dataclass(frozen=True)
class Trace:
    """Delays and losses of a real link, datagram by datagram; it begins again at its end.

    Attributes:
        delays_ms: of each; NaN: it was lost.
    """

    delays_ms: tuple[float, ...]

    @classmethod
    def read(cls, path: Path) -> "Trace":
        """Read a text file with a line per datagram: its delay in milliseconds, or ``lost``.

        Empty lines and those that begin with # are left out.

        Raises:
            MissingInputError, DataError: no such file, or another line in it.
        """
        delays = []
        text = files.read_bytes(path, limit=files.JSON_LIMIT_BYTES).decode(errors="replace")
        for number, line in enumerate(text.splitlines(), start=1):
            word = line.strip()
            if not word or word.startswith("#"):
                continue
            try:
                delay_ms = float("nan") if word == LOST else float(word)
            except ValueError:
                delay_ms = -1.0
            if word != LOST and not 0 <= delay_ms < float("inf"):
                raise DataError(
                    f"{path}, line {number}: '{word}'; expected a delay in milliseconds, or {LOST}"
                )
            delays.append(delay_ms)
        if not delays:
            raise DataError(f"{path} holds no datagrams; expected a delay or {LOST} in every line")
        return cls(tuple(delays))

    def latest_steps(self, step_ms: float) -> int:
        """Return the whole steps that a datagram takes at most; 0 where all are lost."""
        delays_ms = np.array(self.delays_ms)
        return int(np.rint(np.max(delays_ms, initial=0.0, where=~np.isnan(delays_ms)) / step_ms))

    def draws(self, steps: int, devices: int, step_ms: float) -> tuple[LinkDraws, Bools]:
        """Return what the trace does to the datagrams of a loop, for the simulator.

        Every device begins at another place of it. Delays are rounded to whole steps.

        Returns:
            The delays, and which datagrams are lost [steps, devices].
        """
        delays_ms = np.array(self.delays_ms)
        starts = (np.arange(devices) * len(delays_ms)) // devices
        of = delays_ms[(np.arange(steps)[:, None] + starts) % len(delays_ms)]
        lost = np.isnan(of)
        steps_late = np.rint(np.where(lost, 0.0, of) / step_ms)
        extra = steps_late.clip(max=LONGEST_STEPS).astype(np.int64)
        return LinkDraws(0, extra if extra.any() else None, None), lost


@dataclasses.dataclass(frozen=True)
class Impairment:
    """Losses and delays of one direction of a link.

    Attributes:
        loss: share of datagrams that are lost.
        burst: mean number of datagrams that a burst of losses lasts; 1: they are independent.
            A Gilbert-Elliott link of two states, one of which loses all (Gilbert 1960).
        delay_ms: that all take.
        jitter_ms: up to so much more, evenly; some then overtake others.
        reorder: share of datagrams that are passed on without any delay, before others.
        duplicate: share that come twice.
        rate_kbps: what passes in a second; more waits, for a quarter of a second at most.
        trace: takes the place of loss, delay and jitter.
    """

    loss: float = 0.0
    burst: float = 1.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    reorder: float = 0.0
    duplicate: float = 0.0
    rate_kbps: float = 0.0
    trace: Trace | None = None

    def __post_init__(self) -> None:
        """Raise UsageError for what a trace replaces, and a loss that bursts cannot make.

        There is a good datagram at least between two bursts.
        """
        replaced = ("loss", "delay_ms", "jitter_ms")
        if self.trace is not None and (given := [*filter(vars(self).get, replaced)]):
            raise UsageError(
                f"a trace takes the place of {given[0].removesuffix('_ms')}; leave one of both out"
            )
        most = self.burst / (1 + self.burst)
        if self.burst > 1 and self.loss > most:
            raise UsageError(
                f"a loss of {self.loss:g} in bursts of {self.burst:g} datagrams; such bursts lose "
                f"at most {most:g}",
                hint="longer bursts, or none (1), which are independent losses",
            )


class Direction:
    """It decides about the datagrams of one direction, in their order."""

    def __init__(self, impairment: Impairment, seed: int, number: int) -> None:
        self.impairment = impairment
        self._random = generator(seed, _KEY, number)
        self._count, self._bad, self._free_s = 0, False, 0.0

    def passes_on(self, size_bytes: int, now_s: float) -> list[float]:
        """Return when a datagram is handed on: never, once or twice, [] being lost."""
        how, drawn = self.impairment, self._random.random(5)
        index, self._count = self._count, self._count + 1
        if how.trace is not None:
            delay_s = how.trace.delays_ms[index % len(how.trace.delays_ms)] / 1e3
            if np.isnan(delay_s):
                return []
        else:
            if self._lost(drawn[0]):
                return []
            delay_s = (how.delay_ms + drawn[1] * how.jitter_ms) / 1e3
        if drawn[2] < how.reorder:
            delay_s = 0.0
        if how.rate_kbps:
            starts_s = max(self._free_s, now_s)
            if starts_s - now_s > QUEUE_S:
                return []
            self._free_s = starts_s + 8 * size_bytes / (1e3 * how.rate_kbps)
            delay_s += self._free_s - now_s
        times_s = [now_s + delay_s]
        if drawn[3] < how.duplicate:
            times_s.append(now_s + delay_s + drawn[4] * max(how.jitter_ms, 1.0) / 1e3)
        return times_s

    def _lost(self, uniform: float) -> bool:
        """Go on by one datagram in the chain of good and bad states."""
        how = self.impairment
        if how.burst == 1.0:
            return bool(uniform < how.loss)
        leaves_bad = 1.0 / how.burst
        enters_bad = leaves_bad * how.loss / (1.0 - how.loss) if how.loss else 0.0
        self._bad = uniform >= leaves_bad if self._bad else uniform < enters_bad
        return self._bad


class Relay:
    """It passes datagrams between clients and a server, each client through a port of its own.

    Args:
        listening: a non-blocking UDP socket for clients.
        server: the server's address.
        family: of that address.
        up, down: what happens to datagrams to and from the server.
    """

    def __init__(
        self,
        listening: socket.socket,
        server: Any,
        family: socket.AddressFamily,
        up: Direction,
        down: Direction,
    ) -> None:
        self._listening, self._server, self._family = listening, server, family
        self._up, self._down = up, down
        self._ports: OrderedDict[Any, socket.socket] = OrderedDict()
        self._clients: dict[socket.socket, Any] = {}
        self._waiting: list[tuple[float, int, socket.socket, bytes, Any]] = []
        self._tickets = itertools.count()
        self._poll = select.poll()
        self._poll.register(listening, select.POLLIN)
        self._of = {listening.fileno(): listening}
        self._most_ports = _most_ports()
        self.counts: Counter[str] = Counter()

    def run(
        self,
        until_s: float = float("inf"),
        report: Callable[[dict[str, int]], None] = lambda counts: None,
    ) -> None:
        """Pass on until a time of the monotonic clock, or an interruption."""
        next_s = time.monotonic() + 1.0
        try:
            while (now_s := time.monotonic()) < until_s:
                self._release(now_s)
                if now_s >= next_s:
                    next_s = now_s + 1.0
                    report(dict(self.counts))
                soonest_s = self._waiting[0][0] if self._waiting else next_s
                wait_s = min(soonest_s, next_s, until_s) - time.monotonic()
                for number, _ in self._poll.poll(max(1e3 * wait_s, 0.0)):
                    if port := self._of.get(number):  # none: it has just made place for another
                        self._take(port, time.monotonic())
        finally:
            for port in self._ports.values():
                port.close()

    def _take(self, port: socket.socket, now_s: float) -> None:
        for _ in range(64):
            try:
                data, sender = port.recvfrom(protocol.LARGEST_BYTES + 1)
            except OSError:
                return
            up = port is self._listening
            direction, name = (self._up, "up") if up else (self._down, "down")
            times_s = direction.passes_on(len(data), now_s)
            self.counts[name] += 1
            self.counts[f"{name}_lost"] += not times_s
            through = self._port_of(sender) if up else self._listening
            target = self._server if up else self._clients.get(port)
            if (
                through is None
                or target is None
                or len(self._waiting) + len(times_s) > MOST_WAITING
            ):
                self.counts[f"{name}_full"] += 1
                continue
            for at_s in times_s:
                entry = (at_s, next(self._tickets), through, data, target)
                heapq.heappush(self._waiting, entry)
            self._release(now_s)

    def _release(self, now_s: float) -> None:
        while self._waiting and self._waiting[0][0] <= now_s:
            _, _, through, data, target = heapq.heappop(self._waiting)
            try:
                through.sendto(data, target)
            except OSError:
                self.counts["refused"] += 1

    def _port_of(self, client: Any) -> socket.socket | None:
        """Return the port that a client's datagrams leave by; the least used one makes place.

        ``None`` where the system has no descriptor for it even so.
        """
        if client in self._ports:
            self._ports.move_to_end(client)
            return self._ports[client]
        if len(self._ports) >= self._most_ports:
            self._close_oldest()
        if (port := self._new_port()) is None:
            return None
        port.setblocking(False)
        self._ports[client], self._clients[port] = port, client
        self._of[port.fileno()] = port
        self._poll.register(port, select.POLLIN)
        return port

    def _new_port(self) -> socket.socket | None:
        try:
            return socket.socket(self._family, socket.SOCK_DGRAM)
        except OSError:  # others take descriptors, too
            if not self._ports:
                return None
        self._close_oldest()
        with contextlib.suppress(OSError):
            return socket.socket(self._family, socket.SOCK_DGRAM)
        return None

    def _close_oldest(self) -> None:
        _, port = self._ports.popitem(last=False)
        self._poll.unregister(port)
        del self._of[port.fileno()], self._clients[port]
        port.close()


def _most_ports() -> int:
    """Return how many clients may have a port, of the files that this process may open."""
    files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files == resource.RLIM_INFINITY:
        return MOST_CLIENTS
    return min(MOST_CLIENTS, max(files - SPARE_FILES, 1))
