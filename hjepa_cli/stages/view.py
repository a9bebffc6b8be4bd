"""``hjepa view`` shows closed loops over a fading link, and what the controller believes.

Model → a few devices per method on the same draws and the same fading → an animation: the true
pole, the pole that a linear probe reads from the controller's current embedding, every packet, the
SNR and the age of the last packet. It shows a handful of devices; numbers come from ``eval``.
"""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hjepa_cli.compute import memory
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.control.drivers import build_driver, methods_of
from hjepa_cli.core.control.link import described
from hjepa_cli.core.control.link import facts as link_facts
from hjepa_cli.core.control.loop import (
    Bools,
    Controller,
    Draws,
    Floats,
    LinkDraws,
    check_memory,
    gap_schedule,
    lead_of,
    simulate,
    takes_ages,
)
from hjepa_cli.core.datasets.trajectories import generate
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.conditions import actual_camera, actual_plant
from hjepa_cli.core.plants.frames import frames_of, frames_seen
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.radio.channel import rayleigh_power_gains
from hjepa_cli.core.radio.phy.equal_parts import equal_devices
from hjepa_cli.errors import MissingInputError, UsageError, choices, require
from hjepa_cli.output.film import Film, Link
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import CODECS, METHODS
from hjepa_cli.stages.inputs import refuse_recorded
from hjepa_cli.stages.model_set import ModelSet, open_model_set
from hjepa_cli.stages.plan import Plan, seconds_of
from hjepa_cli.storage import files

FADING_KEY = 0xFAD1
PROBE_TRAJECTORIES, PROBE_EVERY = 40, 4  # 1,600 inputs: rendered and encoded in seconds


class Believer:
    """A linear probe reads, at every step, what a controller of n devices believes.

    ``act`` is :meth:`watch`, and takes ages where the controller does.
    """

    def __init__(self, controller: Controller, probe: torch.Tensor) -> None:
        self._controller: Any = controller
        self._probe = probe
        self._last: torch.Tensor | None = None
        self._heard = False
        self.believed: list[Floats] = []
        self.flagged: list[Bools] = []
        self.act = functools.wraps(controller.act)(lambda *of: self.watch(*of))

    def watch(self, delivered: Bools, packets: Any, ages: Integers | None = None) -> Floats:
        """Return the forces of one step [n, *A]."""
        told = (ages,) if takes_ages(self._controller) else ()
        forces_n: Floats = self._controller.act(delivered, packets, *told)
        check = getattr(self._controller, "check", None)
        self.flagged.append(np.zeros_like(delivered) if check is None else check.now.copy())
        self._heard |= packets is not None
        if not self._heard:  # the link is late: a device is believed to be at rest
            states = np.zeros((len(delivered), self._probe.shape[1]))
        elif hasattr(self._controller, "belief"):
            start, end, share = self._controller.belief
            states = self._read(start)
            states += share[:, None] * (self._read(end) - states)
        else:  # no prediction: what it received last
            if packets is not None:
                if self._last is None:
                    self._last = packets.new_zeros(len(delivered), packets.shape[1])
                self._last[torch.from_numpy(delivered)] = packets
            assert self._last is not None
            states = self._read(self._last)
        self.believed.append(states)
        return forces_n

    def __getattr__(self, name: str) -> Any:
        """Return what the controller tells besides, as the forces that it has planned."""
        return getattr(self._controller, name)

    def _read(self, z: torch.Tensor) -> Floats:
        return np.asarray(health.read_probe(self._probe, z.cpu()).numpy())


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None = None,
    out: Path = Path("hjepa-view.gif"),
    devices: int = 3,
    snr_db: float = 20.0,
    delivery: float = 0.05,
    gap_steps: float | None = None,
    every: int | None = None,
    fps: int = 20,
    live: bool = False,
) -> dict[str, Any]:
    """Simulate, then draw a GIF or MP4, or play in the terminal; return the ``--json`` document.

    Args:
        settings: plant, seed, methods, protocol and bandwidth.
        screen: shows progress, and the film if ``live``.
        checkpoint: zoo name, run directory or file; default: the newest run, else the zoo.
        out: ``.gif`` or ``.mp4``, with ``fps`` pictures per second or, in a GIF, about as many.
        devices: how many are side by side.
        snr_db, delivery: mean SNR of the fading link, and the share of packets that arrive.
        gap_steps: instead of fading, one packet every so many steps.
        every: control steps between pictures; default: a hundred pictures in all.
        fps, live: as on the command line.

    Raises:
        UsageError: a method that the model does not hold or that sends no embedding, a format we
            do not write, more pictures per second than a GIF holds, no terminal.
        MissingInputError: no model, or a library is missing.
    """
    check(settings, screen, out=out, devices=devices, every=every, fps=fps, live=live)
    from hjepa_cli.output import animation
    from hjepa_cli.output import live as terminal

    if not live:
        out = files.target(out)
    models = open_viewable(settings, screen, checkpoint)
    settings = models.settings  # with the law and the camera that the model brings along
    link = make_link(settings, models.model, devices, snr_db, delivery, gap_steps)
    screen.say(link.label + link.late)
    probe = fit_probe(settings, models.model, screen)
    films = [film(name, settings, models.model, link, probe, screen) for name in settings.methods]
    every = every or max(settings.protocol.total_steps // 100, 1)
    kind = actual_plant(settings.plant, settings.conditions)
    camera = actual_camera(settings)
    pictures = animation.Pictures(films, link, kind, camera, every)
    result = {
        "checkpoint": models.path,
        "methods": {
            one.method: {"share_in_band": one.score.mean(axis=0), **belief_errors(one, kind)}
            for one in films
        },
        "delivered": link.sent.mean(),
        "pictures": len(pictures),
        "file": None if live else out,
    }
    if live:
        terminal.play(pictures, fps)
        return result
    with screen.progress("draw", len(pictures), "pictures") as bar:
        animation.write(pictures, out, fps, bar.advance)
    rate = animation.true_fps(out, fps)
    screen.say(f"{len(pictures)} pictures at {round(rate, 1):g} per second: {out}")
    return result


def check(
    settings: Settings,
    screen: Screen,
    *,
    out: Path,
    devices: int,
    every: int | None,
    fps: int,
    live: bool,
) -> None:
    """Refuse what could not be drawn, before any work; arguments and errors as of :func:`run`."""
    require("PIL", "a view needs Pillow", "plot")
    from hjepa_cli.output import animation

    check_memory(settings.protocol, devices)
    if live:
        if not screen.is_terminal:
            raise UsageError("--live needs a terminal", hint="hjepa view --out FILE.gif")
        return
    animation.check_target(out, fps, devices, len(settings.methods))
    steps = settings.protocol.total_steps
    pictures = steps // every if every else 100
    laid = animation.grid(devices, len(settings.methods))
    size = math.prod(laid.size_px if laid else animation.MOST_PX)
    memory.check(pictures * size, f"{pictures} pictures of {devices} devices")


def plan(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | None,
    out: Path,
    devices: int,
    every: int | None,
    fps: int,
    live: bool,
) -> Plan:
    """Plan a film; arguments as of :func:`run`."""
    check(settings, screen, out=out, devices=devices, every=every, fps=fps, live=live)
    models = open_viewable(settings, Screen(quiet=True), checkpoint)
    steps, methods = settings.protocol.total_steps, settings.methods
    frames = 2 * len(methods) * devices * steps / 20 + 2000  # a packet in twenty; the probe's
    return Plan(
        command="view",
        reads=[f"model {models.name}"],
        work=[
            "fit a linear probe of the state on embeddings",
            f"drive {devices} devices for {steps} steps with {', '.join(methods)}",
        ],
        writes=[] if live else [f"animation {out}"],
        writes_bytes=0 if live else 10_000 * 100 * devices * len(methods) // 4,
        seconds=10 + seconds_of({"closed-loop frames": frames}),
    )


def belief_errors(film: Film, kind: System) -> dict[str, float]:
    """Return the mean distances of true and believed states, ``belief_error_x_m`` and so on."""
    errors = np.abs(film.believed - film.states).mean(axis=(0, 1))
    units = [unit.replace("/", "_") for unit in kind.state_units]
    described = zip(kind.state_names, units, errors.tolist(), strict=True)
    return {f"belief_error_{name}_{unit}": error for name, unit, error in described}


def open_viewable(settings: Settings, screen: Screen, checkpoint: str | None) -> ModelSet:
    """Open a model whose methods believe in something that can be shown: those on embeddings.

    Raise MissingInputError without a model of the plant, UsageError for any other method.
    """
    refuse_recorded(settings, "views show simulated devices")
    models = open_model_set(settings, screen, checkpoint, None)
    if models.model is None:
        train = f"hjepa reproduce --preset {settings.preset}"
        raise MissingInputError(f"no model of plant {settings.plant}", hint=train)
    held = {name: METHODS[name] for name in methods_of(models.model)}
    viewable = [name for name, of in held.items() if of.sends == "embedding" and not of.fitted]
    for name in settings.methods:
        if name not in viewable:
            raise UsageError(
                f"method '{name}' cannot be viewed with this model; {choices(name, viewable)}",
                hint=f"hjepa view --methods {viewable[0]}",
            )
    return models


def make_link(
    settings: Settings,
    model: Model,
    devices: int,
    snr_db: float,
    delivery: float,
    gap_steps: float | None,
) -> Link:
    """Draw Rayleigh block fading with a delivery probability, or make periodic packets.

    A packet arrives where the gain |h|² reaches -ln p: then it does with probability p. That is
    the law ``equal`` for as many devices as bring p about.
    """
    steps, kind = settings.protocol.total_steps, plant(settings.plant)
    draws = LinkDraws.make(settings.protocol, devices, settings.seed)
    facts = link_facts(settings.protocol, len(kind.force_signs))
    late = described(facts)
    if gap_steps is not None:
        schedule = gap_schedule(gap_steps, steps, devices)
        label = f"a packet every {gap_steps:g} steps, SNR {snr_db:g} dB by power control"
        return Link(schedule, np.full((steps, devices), snr_db), False, label, draws, late)
    streams = [generator(settings.seed, FADING_KEY, device) for device in range(devices)]
    gains = np.stack([rayleigh_power_gains(stream, steps) for stream in streams], axis=1)
    delivered = gains >= -np.log(delivery)
    delivered[0] = True
    bits = CODECS[settings.protocol.payload].bits(model.architecture["embedding"])
    bits += int(facts["confirmation_bits"])
    sharing = equal_devices(delivery, bits, settings.radio.bandwidth_hz, kind.step_s, snr_db)
    label = (
        f"Rayleigh fading, mean SNR {snr_db:g} dB, packets arrive with p = {delivery:g}: "
        f"{sharing} devices share {settings.radio.bandwidth_hz / 1e6:g} MHz"
    )
    return Link(delivered, snr_db + 10 * np.log10(gains), True, label, draws, late)


def fit_probe(settings: Settings, model: Model, screen: Screen) -> torch.Tensor:
    """Fit a linear probe from embeddings to states, on trajectories made from the seed."""
    count = min(PROBE_TRAJECTORIES, settings.collect.trajectories)
    recorded = generate(settings, "train", range(count))
    camera = model.camera
    embeddings, states = [], []
    with screen.progress("fit probe", count, "trajectories") as bar:
        for trajectory in recorded.states:
            now = np.arange(1, len(trajectory), PROBE_EVERY)
            shown = trajectory[frames_seen(now - 1, model.look)]
            embeddings.append(model.encode(frames_of(camera, shown)))
            states.append(torch.from_numpy(trajectory[now]))
            bar.advance()
    return health.fit_probe(torch.cat(embeddings), torch.cat(states))


def film(
    name: str, settings: Settings, model: Model, link: Link, probe: torch.Tensor, screen: Screen
) -> Film:
    """Drive the devices with one method and keep every state and belief."""
    kind = actual_plant(settings.plant, settings.conditions)
    method = build_driver(name, settings, model)
    steps, devices = link.sent.shape
    believer = Believer(method.controller(devices), probe)
    states: list[Floats] = []
    with screen.progress(f"simulate {name}", steps, "steps") as bar:
        simulate(
            kind,
            Draws.make(settings.protocol, devices, settings.seed),
            link.sent[None],
            believer,
            method.sensor,
            ends=False,  # it is watched to the end
            tick=bar.advance,
            watch=lambda k, now, forces_n: states.append(now.copy()),
        )
    believed, flagged = np.stack(believer.believed), np.stack(believer.flagged)
    if lead := lead_of(link.draws, believer):  # it decides on later steps, and believes in them
        believed = np.concatenate([np.zeros_like(believed[:lead]), believed[:-lead]])
    for k, device in np.argwhere(flagged):  # it may have waited since it came
        flagged[k, device] = False
        flagged[np.flatnonzero(link.delivered[: k + 1, device])[-1], device] = True
    in_band = kind.in_band(np.stack(states))
    return Film(name, np.stack(states), believed, in_band, flagged)
