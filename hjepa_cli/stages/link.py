"""``hjepa link`` stands between devices and a server and behaves like a bad network."""

import contextlib
import time
from pathlib import Path
from typing import Any

from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan
from hjepa_cli.wire.relay import Direction, Impairment, Relay, Trace
from hjepa_cli.wire.server import is_loopback, open_socket, parse_address, resolve, written

UP, DOWN = 0, 1


def run(
    screen: Screen,
    *,
    listen: str = "127.0.0.1:4748",
    to: str = "127.0.0.1:4747",
    seed: int = 0,
    for_s: float | None = None,
    **impairments: Any,
) -> dict[str, Any]:
    """Relay until interrupted, or for some time; return what was counted.

    Args:
        screen: gets a line of counts every second, JSON under ``--json``.
        listen, to: addresses for devices, and of the server.
        seed: of what happens to datagrams.
        for_s: how long.
        impairments: ``up_loss`` … ``down_trace``, as :class:`~hjepa_cli.wire.relay.Impairment`.

    Raises:
        UsageError: an address that is none, or losses in bursts that are too short.
        Unavailable: the port is taken.
        MissingInputError, DataError: no such trace, or no trace.
    """
    family, server = resolve(parse_address(to, "--to"), "--to")
    up, down = (
        Direction(impairment(way, impairments), seed, number)
        for way, number in (("up", UP), ("down", DOWN))
    )
    with contextlib.closing(open_socket(parse_address(listen, "--listen"), "--listen")) as opened:
        where = opened.getsockname()
        if tuple(where[:2]) == tuple(server[:2]):
            raise UsageError(f"--listen and --to are the same address, {written(where)}")
        if not is_loopback(where):
            screen.say("the relay listens beyond loopback: it passes on what anybody sends")
        if screen.json:
            screen.emit({"listening": written(where)})
        screen.say(f"devices: --server {written(where)}; passed on to {written(server)}")
        relay = Relay(opened, server, family, up, down)
        until_s = float("inf") if for_s is None else time.monotonic() + for_s
        relay.run(until_s, screen.emit if screen.json else lambda counts: None)
    counts = dict(relay.counts)
    screen.say(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()))
    return counts


def plan(*, listen: str, to: str, for_s: float | None) -> Plan:
    """Plan a relay; arguments and errors as of :func:`run`."""
    for text, flag in ((listen, "--listen"), (to, "--to")):
        parse_address(text, flag)
    until = "until interrupted" if for_s is None else f"for {for_s:g} s"
    return Plan("link", [], [f"pass datagrams from {listen} on to {to} {until}"], [], 0, for_s or 0)


def impairment(way: str, given: dict[str, Any]) -> Impairment:
    """Return what the flags of a direction say."""
    values = {
        name.removeprefix(f"{way}_"): value
        for name, value in given.items()
        if name.startswith(f"{way}_")
    }
    path: Path | None = values.pop("trace", None)
    return Impairment(**values, trace=Trace.read(path) if path else None)
