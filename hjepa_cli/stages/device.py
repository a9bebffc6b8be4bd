"""``hjepa device`` is a device: its camera, its encoder and its actuator, driven by a server.

Nothing heavy is imported here: no torch, or it would not start within a second on a small board.
"""

import contextlib
import secrets
from pathlib import Path
from typing import Any

from hjepa_cli.config.schema import Settings
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.plants.frames import same_camera
from hjepa_cli.core.plants.named import camera_of, plant_of, seen_as_trained, sensor_in
from hjepa_cli.errors import DataError, Unavailable, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.plan import Plan
from hjepa_cli.stages.serve import key_for
from hjepa_cli.wire.actuator import Actuator, open_actuator
from hjepa_cli.wire.bundle import Bundle, exported_by, open_bundle
from hjepa_cli.wire.camera import Watched, open_camera, parse_crop
from hjepa_cli.wire.device import Device, EverySteps, OnInnovation
from hjepa_cli.wire.drive import Drive
from hjepa_cli.wire.runtime import Runtime
from hjepa_cli.wire.server import is_loopback, open_socket, parse_address, resolve, written
from hjepa_cli.wire.simulated import SimulatedPlant

FIRST_DEVICE = 0  # of the draws that a simulated plant starts with


def run(
    settings: Settings,
    screen: Screen,
    *,
    model: Path,
    server: str = "127.0.0.1:4747",
    key: Path | None = None,
    number: int | None = None,
    camera: str = "sim",
    crop: str | None = None,
    actuator: str | None = None,
    period_ms: float | None = None,
    gap_steps: int = 80,
    innovation: float | None = None,
    longest_steps: int = 320,
    watchdog_ms: float = 40.0,
    local: bool = True,
    stop_after_s: float | None = None,
    steps: int | None = None,
    precision: str = "fp32",
    backend: str = "onnxruntime",
) -> dict[str, Any]:
    """Drive a device until interrupted, for some steps, or to the end of a recording.

    Raises:
        UsageError: an address, a camera or an actuator that is none.
        MissingInputError, DataError: no such model or key; a model of another plant, a server with
            another model; pictures of another size or type.
        Unavailable: the server does not answer, the camera gives no pictures or always the same.
    """
    address = parse_address(server, "--server")
    secret = key_for(address, "--server", key)
    bundle, kind = open_bundle(model), plant_of(settings)
    check_plant(bundle, settings)
    trained_with = camera_of(kind, settings.camera, sensor_in(bundle.manifest["camera"]))
    if not same_camera(bundle.manifest["camera"], trained_with):
        raise DataError(
            f"{model} was exported with another camera than plant {kind.name} has now",
            hint=exported_by(model),
        )
    runtime = Runtime(bundle, backend, precision)
    _, where = resolve(address, "--server")
    with contextlib.ExitStack() as things:
        part = parse_crop(crop)
        plant = simulated(settings, bundle) if camera == "sim" else None
        watched = Watched(plant or open_camera(camera, part), bundle.look, bundle.most_changed)
        things.enter_context(contextlib.closing(watched))
        hands = actuator or ("sim" if plant else "none")
        if hands == "sim" and not plant:
            raise UsageError("--actuator sim needs --camera sim: the plant that is seen is pushed")
        acts: Actuator = plant if hands == "sim" else open_actuator(hands, bundle.axes)
        things.enter_context(contextlib.closing(acts))
        opened = open_socket((_own_host(where), 0), "--server")
        things.enter_context(contextlib.closing(opened))
        device = Device(
            bundle,
            secrets.randbelow(2**32) if number is None else number,
            secret,
            (1e3 * bundle.step_s if period_ms is None else period_ms) / 1e3,
            actor=(lambda: runtime.act(runtime.encode(watched.frames))[0]) if local else None,
            watchdog_steps=round(watchdog_ms / 1e3 / bundle.step_s),
        )
        runtime.warm_up("encoder" if precision == "fp32" else "encoder-int8", "actor")
        rule = (
            EverySteps(gap_steps) if innovation is None else OnInnovation(innovation, longest_steps)
        )
        drive = Drive(device, watched, acts, runtime, rule, opened, where, screen.say)
        screen.say(f"device {device.number}, plant {bundle.plant}, server {written(where)}")
        try:
            drive.connect()
        except Unavailable as error:
            if not local:
                raise
            screen.say(f"{error.message}: the actor on the device drives meanwhile")
        try:
            drive.run(steps, stop_after_s)
        finally:
            drive.leave()
    return {
        "device": device.number,
        "plant": bundle.plant,
        "model": bundle.digest.hex(),
        "steps": sum(device.counts.values()),
        "sent": drive.sent,
        "spoilt_pictures": watched.spoilt,
        "forces": device.counts,
        "late_steps": drive.late_steps,
        "ignored": device.ignored,
        "score": plant.score if plant else None,
    }


def plan(
    settings: Settings,
    *,
    model: Path,
    server: str,
    key: Path | None,
    camera: str,
    steps: int | None,
) -> Plan:
    """Plan a device; arguments and errors as of :func:`run`."""
    key_for(parse_address(server, "--server"), "--server", key)
    bundle = open_bundle(model)
    check_plant(bundle, settings)
    until = "until interrupted" if steps is None else f"for {steps} steps"
    work = [f"send what camera {camera} sees to {server} and play its forces {until}"]
    return Plan("device", [f"exported model {model}"], work, [], 0, (steps or 0) * bundle.step_s)


def simulated(settings: Settings, bundle: Bundle) -> SimulatedPlant:
    """Return the settings' plant, seen by the model's camera."""
    moved = actual_plant(settings.plant, settings.conditions)
    seen = actual_camera(seen_as_trained(settings, bundle.manifest["camera"]))
    return SimulatedPlant(moved, seen, settings.protocol, settings.seed, FIRST_DEVICE)


def check_plant(bundle: Bundle, settings: Settings) -> None:
    """Raise DataError for a model of another plant than the settings'."""
    if bundle.plant != settings.plant:
        raise DataError(
            f"{bundle.directory} drives plant {bundle.plant}, not {settings.plant}",
            hint=f"add --preset {bundle.plant}, or pass another --model DIR",
        )


def _own_host(server: Any) -> str:
    """Return the host to send from: all of this machine's, or loopback for a server there."""
    if is_loopback(server):
        return str(server[0])
    return "::" if ":" in server[0] else "0.0.0.0"
