"""The test bench drives simulated devices through the wire, and the same ones in the simulator.

Both see the same starts, gusts, losses and delays (:class:`~hjepa_cli.core.control.loop.Draws`).
In lockstep there are no deadlines: every datagram of a step is delivered before the next, and what
is left of a difference is a fault. In real time a controller in a process of its own has to keep
up; where it does not, a score says nothing about the wire and is not reported.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hjepa_cli.core.arrays import Bools, Floats, Pixels
from hjepa_cli.core.control.loop import Draws, LinkDraws, ScoredPlants
from hjepa_cli.core.plants.frames import Camera, frames_back, frames_of
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import NumericalError
from hjepa_cli.wire import protocol
from hjepa_cli.wire.bundle import Bundle
from hjepa_cli.wire.controller import Controller, Outgoing
from hjepa_cli.wire.device import Device
from hjepa_cli.wire.drive import LATE_STEPS
from hjepa_cli.wire.runtime import Runtime, Singles

CONNECT_S = 5.0  # that all devices together may take to be taken up
AT_ONCE = 65_536  # datagrams that the bench takes in a step at most
MOST_MISSING = 1e-3  # of all steps without a force: beyond it a score is of the machine
LOST_THETA_RAD = 0.5  # a pole beyond it has fallen; no force brings it back


@dataclasses.dataclass(frozen=True)
class BenchOutcome:
    """Measurements of one drive.

    Attributes:
        score: share of scored steps in the band [N].
        states: of all steps [K, N, S].
        missing: share of device-steps for which no datagram had a force in time, those left out
            whose datagrams the link had lost.
        late_answers: share of embeddings whose answer came after their step.
        ages: steps between capture and first force of the embeddings that were answered.
        sources: device-steps by where their force came from.
        unplanned_until: step after the last one in which some device had no planned force.
        began_s: when each step began [K], counted from the start of the drive.
        seconds: of the drive.
    """

    score: Floats
    states: Floats
    missing: float
    late_answers: float
    ages: dict[int, int]
    sources: dict[str, int]
    unplanned_until: int
    began_s: Floats
    seconds: float

    def driven_again_s(self, step: int) -> float | None:
        """Return how long after a step began all were driven for good; ``None``: never."""
        until = max(self.unplanned_until, step)
        if until >= len(self.began_s):
            return None
        return float(self.began_s[until] - self.began_s[step])


class Fleet:
    """Simulated devices, with their cameras, encoders and state machines.

    Args:
        bundle, runtime: of the model; every device encodes by itself, one picture at a time.
        plant, camera: what they are, and what looks at them.
        draws: their starts and gusts.
        delivered: when each sends [K, N]; what the link would lose is not sent.
        key, period_s: as of :class:`~hjepa_cli.wire.device.Device`.
        local: whether the actor on a device drives it when the controller is silent.
        lost: whether a datagram with forces that comes in a step is lost [K, N].
        watchdog_steps: as of a device.
        grace_steps: before which no force can have come, as the link is late.
        first_number: of the devices, which are counted from there.
    """

    def __init__(
        self,
        bundle: Bundle,
        runtime: Runtime,
        plant: System,
        camera: Camera,
        draws: Draws,
        delivered: Bools,
        key: bytes,
        period_s: float,
        *,
        local: bool = False,
        lost: Bools | None = None,
        watchdog_steps: int | None = None,
        grace_steps: int = 0,
        first_number: int = 1,
    ) -> None:
        self.bundle, self._runtime, self._camera = bundle, runtime, camera
        self._back = frames_back(bundle.look)
        self._delivered, self._lost, self._first = delivered, lost, first_number
        steps, count = delivered.shape
        self.plants = ScoredPlants(
            plant, draws.initial, draws.mass_scale, iter(draws.noise), draws.warmup_steps
        )
        self._grace_steps = grace_steps
        self._scored = steps - draws.warmup_steps
        self._local_n: dict[int, Singles] = {}
        self.devices = [
            Device(
                bundle,
                first_number + i,
                key,
                period_s,
                actor=functools.partial(self._local_n.__getitem__, i) if local else None,
                watchdog_steps=watchdog_steps,
            )
            for i in range(count)
        ]
        self.states = np.empty((steps, count, len(plant.state_names)))
        self._offered = np.zeros((count, steps + protocol.MOST_FORCES), bool)
        self._captures: list[dict[int, int]] = [{} for _ in range(count)]
        self.missing, self.unplanned_until, self.ages = 0, 0, dict[int, int]()

    def upkeep(self, now_s: float) -> list[bytes]:
        """Return hellos that are due."""
        due = (device.upkeep(now_s) for device in self.devices)
        return [data for data in due if data is not None]

    def sense(self, k: int) -> list[bytes]:
        """Return the embeddings of those that send in step k."""
        wants = self._delivered[k].copy()
        for i, device in enumerate(self.devices):
            wants[i] = device.connected and (wants[i] or device.is_new(k))
        if not wants.any():
            return []
        rows, datagrams = np.flatnonzero(wants), []
        frames = self._look(wants)
        for row, i in enumerate(rows.tolist()):
            z = self._runtime.encode(frames[row : row + 1])[0]
            data = self.devices[i].embed(k, z)
            if data is not None:
                datagrams.append(data)
                self._captures[i][k] = k
        return datagrams

    def take(self, data: bytes, k: int, now_s: float) -> None:
        """Hand a datagram that comes in step k to its device, unless the link loses it."""
        try:
            kind, number = protocol.peek(data)
        except protocol.Malformed:
            return
        i = number - self._first
        if not 0 <= i < len(self.devices):
            return
        if kind == protocol.FORCES:
            message = protocol.parse(data)
            assert isinstance(message, protocol.Forces)
            self._offered[i, message.first : message.first + len(message.forces_n)] = True
            if self._lost is not None and self._lost[k, i]:
                return
        device = self.devices[i]
        before = device.answered
        device.receive(data, k, now_s)
        if device.answered != before and device.answered in self._captures[i]:
            age = k - device.answered
            self.ages[age] = self.ages.get(age, 0) + 1
            self._captures[i] = {c: c for c in self._captures[i] if c > device.answered}

    def play(self, k: int) -> Floats:
        """Play step k on all devices, and return their forces [N, *A]."""
        needy = [i for i, device in enumerate(self.devices) if self._needs_actor(device, k)]
        if needy:
            mask = np.zeros(len(self.devices), bool)
            mask[needy] = True
            forces_n = self._runtime.act(self._runtime.encode(self._look(mask)))
            self._local_n.update(zip(needy, forces_n, strict=True))
        self.states[k] = self.plants.states
        played = [device.play(k) for device in self.devices]
        if k >= self._grace_steps:
            self.missing += int((~self._offered[:, k]).sum())
        if any(one.source != protocol.PLANNED for one in played):
            self.unplanned_until = k + 1
        forces_n = np.stack([one.forces_n for one in played])
        shape = (len(played), *self.plants.plant.action_shape)
        return self.plants.move(np.asarray(forces_n, np.float64).reshape(shape))

    def outcome(self, began_s: Floats, seconds: float) -> BenchOutcome:
        """Return what was measured."""
        sources: dict[str, int] = dict.fromkeys(protocol.SOURCES, 0)
        for device in self.devices:
            for name, count in device.counts.items():
                sources[name] += count
        answers = sum(self.ages.values())
        late = sum(count for age, count in self.ages.items() if age > 0)
        return BenchOutcome(
            score=self.plants.score / self._scored,
            states=self.states,
            missing=self.missing / self._delivered.size,
            late_answers=late / max(answers, 1),
            ages=dict(sorted(self.ages.items())),
            sources=sources,
            unplanned_until=self.unplanned_until,
            began_s=began_s,
            seconds=seconds,
        )

    def _needs_actor(self, device: Device, k: int) -> bool:
        return (
            device.has_actor
            and device.planned_n(k) is None
            and device.silent >= device.watchdog_steps
        )

    def _look(self, mask: Bools) -> Pixels:
        """Return the pictures [m, κ, 64, 128, 3] that some devices see now."""
        seen = self.plants.sense(lambda states: states[:, self._back], mask)
        return frames_of(self._camera, seen)


def lockstep(
    fleet: Fleet,
    controller: Controller,
    link: LinkDraws,
    tick: Callable[[], None] = lambda: None,
    *,
    silent: range = range(0),
    restarted: Controller | None = None,
) -> BenchOutcome:
    """Drive a fleet with everything of a step done before the next; time is counted in steps.

    Args:
        fleet, controller: both ends.
        link: tells how many steps datagrams up take.
        tick: called after every step.
        silent: steps in which the controller stands still. What comes in them waits for it,
        restarted: or is lost, where another one takes its place.
    """
    steps = len(fleet.states)
    period_s, started_s = fleet.devices[0].period_s, time.monotonic()
    flying: dict[int, list[bytes]] = {}
    waiting: list[bytes] = []
    for i, device in enumerate(fleet.devices):  # taken up before, by a link as late as at first
        hello_s = -flying_steps(link, 0, i) * period_s
        for data, _ in controller.receive(device.upkeep(hello_s) or b"", None, hello_s):
            fleet.take(data, 0, 0.0)
    for k in range(steps):
        now_s = k * period_s

        def deliver(outgoing: Outgoing, k: int = k, now_s: float = now_s) -> None:
            for data, _ in outgoing:
                fleet.take(data, k, now_s)

        greetings = fleet.upkeep(now_s)
        if k in silent:
            waiting += [*greetings, *fleet.sense(k)]
            fleet.play(k)
            tick()
            continue
        if k == silent.stop and restarted is not None:
            controller, waiting = restarted, []
        for data in (*waiting, *greetings):
            deliver(controller.receive(data, None, now_s))
        waiting = []
        for data in fleet.sense(k):
            i = protocol.peek(data)[1] - fleet.devices[0].number
            flying.setdefault(k + flying_steps(link, k, i), []).append(data)
        for data in flying.pop(k, []):
            deliver(controller.receive(data, None, now_s))
        while outgoing := controller.work(now_s):
            deliver(outgoing)
        fleet.play(k)
        tick()
    return fleet.outcome(np.arange(float(steps)) * period_s, time.monotonic() - started_s)


def flying_steps(link: LinkDraws, k: int, i: int) -> int:
    """Return the steps that a datagram takes which device i sends in step k."""
    extra = 0 if link.extra_steps is None else int(link.extra_steps[k, i])
    return link.delay_steps + extra


def real_time(
    fleet: Fleet,
    socket: Any,
    server: Any,
    *,
    deadline: float = 0.8,
    tick: Callable[[], None] = lambda: None,
    at_step: Callable[[int], None] = lambda k: None,
) -> BenchOutcome:
    """Drive a fleet over a socket, a step every period of wall time.

    Where steps begin late the next ones follow at once. Only while devices drive themselves, which
    this process computes for all of them, steps are counted from a late one, as each device counts
    (:class:`~hjepa_cli.wire.drive.Drive`): a rush of all would be the bench's own.

    Args:
        fleet: the devices, all behind one socket.
        socket: an unconnected, non-blocking UDP socket.
        server: the controller's address.
        deadline: share of a step after which its force is played.
        tick: called after every step.
        at_step: called before step k, so that somebody may harm the server then.

    Raises:
        NumericalError: devices were not taken up.
    """
    import select

    def receive(k: int, until_s: float) -> None:
        for _ in range(AT_ONCE):  # what has come is taken even if time is up
            try:
                data, _ = socket.recvfrom(2048)
            except BlockingIOError:
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not select.select([socket], [], [], left_s)[0]:
                    return
                continue
            except OSError:
                continue  # nobody listens just now
            fleet.take(data, k, time.monotonic())

    def send(datagrams: list[bytes]) -> None:
        for data in datagrams:
            try:
                socket.sendto(data, server)
            except OSError:
                pass  # as lost as on any other link

    steps, period_s = fleet.states.shape[0], fleet.devices[0].period_s
    give_up_s = time.monotonic() + CONNECT_S
    while not all(device.connected for device in fleet.devices):
        if time.monotonic() > give_up_s:
            lacking = sum(not device.connected for device in fleet.devices)
            raise NumericalError(f"{lacking} of {len(fleet.devices)} devices were not taken up")
        send(fleet.upkeep(time.monotonic()))
        receive(0, time.monotonic() + 0.02)
    pauses = any(device.has_actor for device in fleet.devices)
    first, began_s = fleet.sense(0), np.empty(steps)
    drive_s = start_s = time.monotonic()
    for k in range(steps):
        began_s[k] = time.monotonic() - drive_s
        at_step(k)
        begins_s = start_s + k * period_s
        if pauses and (late_s := time.monotonic() - begins_s) > LATE_STEPS * period_s:
            start_s += late_s
            begins_s += late_s
        send(fleet.upkeep(time.monotonic()))
        send(first if k == 0 else fleet.sense(k))
        receive(k, begins_s + deadline * period_s)
        fleet.play(k)
        tick()
        if (left_s := begins_s + period_s - time.monotonic()) > 0:
            time.sleep(left_s)
    return fleet.outcome(began_s, time.monotonic() - drive_s)
