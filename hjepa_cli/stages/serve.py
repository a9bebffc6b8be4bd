"""``hjepa serve`` drives devices over UDP: one controller, many devices.

Nothing heavy is imported here: no torch.
"""

import contextlib
import time
from pathlib import Path
from typing import Any

from hjepa_cli.errors import UsageError
from hjepa_cli.output.dashboard import Dashboard
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan
from hjepa_cli.wire import auth
from hjepa_cli.wire import metrics as prometheus
from hjepa_cli.wire.bundle import open_bundle
from hjepa_cli.wire.controller import Controller
from hjepa_cli.wire.runtime import Runtime
from hjepa_cli.wire.server import (
    Server,
    is_loopback,
    open_socket,
    parse_address,
    resolve,
    snapshot,
    written,
)
from hjepa_cli.wire.websocket import door


def run(
    screen: Screen,
    *,
    model: Path,
    bind: str = "127.0.0.1:4747",
    key: Path | None = None,
    max_devices: int = 1024,
    timeout_s: float = 10.0,
    metrics: str | None = None,
    websocket: str | None = None,
    backend: str = "onnxruntime",
    for_s: float | None = None,
) -> dict[str, Any]:
    """Serve until interrupted, or for some time; return the last snapshot.

    Raises:
        UsageError: an address that is none, or no key beyond loopback.
        Unavailable: a port is taken.
        MissingInputError, DataError: no such model or key, or a damaged one.
    """
    address = parse_address(bind, "--bind")
    doors = {"--metrics": metrics, "--websocket": websocket}
    parsed = {flag: parse_address(text, flag) for flag, text in doors.items() if text}
    secret = key_for(address, "--bind", key, make=True)
    bundle = open_bundle(model)
    with contextlib.ExitStack() as open_doors:
        # Before the networks are loaded: hellos that come meanwhile wait there; new ones are rare.
        opened = open_doors.enter_context(contextlib.closing(open_socket(address)))
        runtime = Runtime(bundle, backend)
        runtime.warm_up("planner", "coarse", "fine")
        controller = Controller(
            bundle, runtime, secret, most_devices=max_devices, timeout_s=timeout_s
        )
        latest: dict[str, Any] = snapshot(controller, {}, time.monotonic())
        listening = {"serving": written(opened.getsockname())}
        if "--metrics" in parsed:
            at = prometheus.exposed(*parsed["--metrics"], lambda: latest)
            listening["metrics"] = written(open_doors.enter_context(at))
        if "--websocket" in parsed:
            slow = Runtime(bundle, backend)  # of its own: it computes in other threads
            slow.warm_up("encoder", "planner")
            at = door(*parsed["--websocket"], bundle, slow)
            listening["websocket"] = written(open_doors.enter_context(at))
        if screen.json:
            screen.emit(listening)
        told = ", ".join(f"{name} {where}" for name, where in listening.items())
        guard = "with a key" if key else "without a key, on loopback only"
        screen.say(f"{told}: plant {bundle.plant}, model {bundle.digest.hex()[:12]}, {guard}")
        dashboard = open_doors.enter_context(Dashboard(screen))

        def report(found: dict[str, Any]) -> None:
            nonlocal latest
            latest = found  # a scrape, in a thread of its own, has the old one or the new one
            dashboard.show(found)

        until_s = float("inf") if for_s is None else time.monotonic() + for_s
        Server(controller, opened, report, dashboard.say).run(until_s)
    return snapshot(controller, {}, time.monotonic())


def plan(*, model: Path, bind: str, key: Path | None, for_s: float | None) -> Plan:
    """Plan a server; arguments and errors as of :func:`run`."""
    address = parse_address(bind, "--bind")
    bundle = open_bundle(model)
    if key is None or key.exists():
        key_for(address, "--bind", key)
    made = [] if key is None or key.exists() else [f"key {key}"]
    until = "until interrupted" if for_s is None else f"for {for_s:g} s"
    work = [f"drive devices of plant {bundle.plant} at {bind} {until}"]
    return Plan("serve", [f"exported model {model}"], work, made, 32 * len(made), for_s or 0.0)


def key_for(address: Any, flag: str, path: Path | None, *, make: bool = False) -> bytes:
    """Return the key to use at an address.

    Raises:
        UsageError: others than this machine can reach it, and there is no key.
        MissingInputError, DataError: the key file is not there, or not safe.
    """
    _, where = resolve(address, flag)
    if path is None and not is_loopback(where):
        raise UsageError(
            f"{flag} {written(address)} is not on loopback: without a key anybody could drive",
            hint="add --key FILE; serve makes it where there is none, then copy it to the devices",
        )
    return auth.key_of(path, make=make)
