"""A device's loop: look, encode, send, wait for forces, play; one control step after the other.

The step is the device's own. Where a step begins late, because the computer was busy or slept, the
next ones are counted from there: a jump of the clock is a pause, and no rush follows.
"""

import select
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hjepa_cli.errors import DataError, HjepaError, Unavailable
from hjepa_cli.wire import protocol
from hjepa_cli.wire.actuator import Actuator
from hjepa_cli.wire.camera import Watched
from hjepa_cli.wire.device import Device, EverySteps, OnInnovation
from hjepa_cli.wire.runtime import Runtime, Singles
from hjepa_cli.wire.server import written

DEADLINE = 0.8  # share of a step after which its force is played, answered or not
CONNECT_S = 3.0
AT_ONCE = 256  # datagrams that a device takes at most before it goes on
LATE_STEPS = 3  # a step that begins so much later is where the clock goes on from


class Drive:
    """It runs one device.

    Args:
        device: its state machine.
        camera, actuator: its eyes and hands.
        runtime: encodes, and acts where ``local``.
        rule: when to send.
        opened: a non-blocking UDP socket.
        server: the controller's address.
        say: prints a line.
    """

    def __init__(
        self,
        device: Device,
        camera: Watched,
        actuator: Actuator,
        runtime: Runtime,
        rule: EverySteps | OnInnovation,
        opened: socket.socket,
        server: Any,
        say: Callable[[str], None],
    ) -> None:
        self._device, self._camera, self._actuator = device, camera, actuator
        self._runtime, self._rule, self._say = runtime, rule, say
        self._socket, self._server = opened, server
        self._source = protocol.PLANNED
        self._said_s: dict[str, float] = {}
        self._late_s: list[float] = []
        self.sent = self.late_steps = self._local_steps = 0

    def connect(self) -> None:
        """Wait until the controller takes this device up.

        Raises:
            Unavailable: it does not answer, or has no place.
            DataError: it runs another model, or another version.
        """
        until_s = time.monotonic() + CONNECT_S
        while not self._device.connected:
            self._send(self._device.upkeep(time.monotonic()))
            self._receive(0, min(time.monotonic() + 0.02, until_s))
            if error := self._refusal():
                raise error
            if time.monotonic() >= until_s and not self._device.connected:
                raise Unavailable(
                    f"no answer from {written(self._server)} within {CONNECT_S:g} s",
                    hint="does a server run there, with the same --key? start one: "
                    "hjepa serve --model DIR",
                )

    def run(self, steps: int | None, stop_after_s: float | None) -> None:
        """Drive for so many steps, or until the recording ends or somebody interrupts.

        Args:
            steps: ``None`` has no end.
            stop_after_s: of silence, in wall time; ``None``: the actor goes on for ever.

        Raises:
            Unavailable: no picture, no actuator; or the controller is silent or has no place, and
                there is no actor on the device, or it has driven for ``stop_after_s``.
            DataError: the controller runs another model by now, or another version.
        """
        device, period_s = self._device, self._device.period_s
        start_s, k, done = time.monotonic(), 0, 0
        while steps is None or done < steps:
            if k == protocol.MOST_STEPS:  # another session, whose steps begin anew
                self.leave()
                start_s, k = start_s + k * period_s, 0
            begins_s = start_s + k * period_s
            if (late_s := time.monotonic() - begins_s) > LATE_STEPS * period_s:
                start_s += late_s
                begins_s += late_s
                self._begins_late(late_s)
            if not self._camera.read():
                return
            self._send(device.upkeep(time.monotonic()))
            asked = self._look(k)
            self._receive(k, begins_s + DEADLINE * period_s, k if asked else None)
            self._heed_refusal()
            played = device.play(k)
            self._actuator.play(played.forces_n)
            self._judge(played.source, stop_after_s)
            self._receive(k, begins_s + period_s, wait=True)
            k, done = k + 1, done + 1

    def leave(self) -> None:
        """Tell the controller that this device ends."""
        self._send(self._device.bye())

    def _look(self, k: int) -> bool:
        """Send this step's embedding, if the rule says so or the session is new; say whether."""
        device, rule = self._device, self._rule
        if not self._camera.good:
            if self._is_time("pictures"):
                self._say("the camera gives empty or torn pictures: they are not sent")
            return False
        new = device.is_new(k)
        if isinstance(rule, OnInnovation):
            if not new and not rule.wants_look(k):
                return False
            z = self._runtime.encode(self._camera.frames)
            due = rule.due(k, self._error(k, z))
        else:
            due = rule.due(k)
            if not (due or new):
                return False
            z = self._runtime.encode(self._camera.frames)
        data = device.embed(k, z[0]) if due or new else None
        self._send(data)
        self.sent += data is not None
        return data is not None

    def _error(self, k: int, z: Singles) -> float | None:
        """Return |C(z) − ũ| ÷ the force range, of the force that is planned for this step."""
        planned_n = self._device.planned_n(k)
        if planned_n is None:
            return None
        limit_n = self._device.bundle.force_limit_n
        return float(np.abs(self._runtime.act(z)[0] - planned_n).mean() / (2 * limit_n))

    def _refusal(self) -> HjepaError | None:
        """Return why the controller will not drive this device, once; it goes on asking."""
        error = refusal(self._device, self._server) if self._device.refused else None
        self._device.refused = protocol.WELCOME
        return error

    def _heed_refusal(self) -> None:
        """End where a refusal cannot pass, or nobody drives until it does; else say it."""
        if (error := self._refusal()) is None:
            return
        if not isinstance(error, Unavailable) or not self._device.has_actor:
            raise error
        if self._is_time("refusal"):
            self._say(f"{error.message}: the actor on the device drives meanwhile")

    def _judge(self, source: int, stop_after_s: float | None) -> None:
        """Tell when who drives changes; stop where nobody does."""
        names = {
            protocol.PLANNED: "the controller drives",
            protocol.LOCAL: "the controller is silent: the actor on the device drives",
        }
        if source != self._source and source in names and self._is_time("source"):
            self._say(names[source])
            self._source = source
        self._local_steps = self._local_steps + 1 if source == protocol.LOCAL else 0
        silent_s = self._device.silent * self._device.period_s
        stopped = source == protocol.ZERO
        if stopped or (
            stop_after_s is not None
            and source == protocol.LOCAL
            and self._local_steps * self._device.period_s >= stop_after_s
        ):
            what = (
                "there is no actor on the device" if stopped else f"--stop-after {stop_after_s:g}"
            )
            since = f"for {silent_s:.3g} s" if self._device.silent < protocol.NO_STEP else "so far"
            raise Unavailable(
                f"no forces from {written(self._server)} {since}, and {what}: stopped at 0 N",
                hint="start the server, then the device again: hjepa serve --model DIR",
            )

    def _send(self, data: bytes | None) -> None:
        if data is not None:
            try:
                self._socket.sendto(data, self._server)
            except OSError:
                pass  # as lost as on any other link

    def _receive(
        self, k: int, until_s: float, answer: int | None = None, *, wait: bool = False
    ) -> None:
        """Take datagrams until a time, or until this step has its force.

        Args:
            k: the step.
            until_s: of the monotonic clock.
            answer: the capture step whose answer to wait for.
            wait: until the time is there, whatever comes.
        """
        device = self._device
        for _ in range(AT_ONCE):  # a flood must not keep a device from its step
            try:
                data, _ = self._socket.recvfrom(protocol.LARGEST_BYTES + 1)
                device.receive(data, k + wait, time.monotonic())  # what comes now is for the next
                continue
            except BlockingIOError:
                pass
            except OSError:  # nobody listens there just now
                pass
            known = device.planned_n(k) is not None and answer in (None, device.answered)
            left_s = until_s - time.monotonic()
            if (known and not wait) or left_s <= 0:
                return
            select.select([self._socket], [], [], left_s)

    def _begins_late(self, late_s: float) -> None:
        """Count a step that begins late, and tell of those of a second at once."""
        self.late_steps += 1
        self._late_s.append(late_s)
        if self._is_time("late"):
            worst_ms = 1e3 * max(self._late_s)
            self._say(
                f"{len(self._late_s)} steps began late, by up to {worst_ms:.0f} ms: this computer "
                "is busy, or its clock has jumped; steps are counted from there"
            )
            self._late_s = []

    def _is_time(self, subject: str) -> bool:
        """Say whether a second has gone by since a subject was last talked of."""
        now_s = time.monotonic()
        if now_s - self._said_s.get(subject, -np.inf) < 1.0:
            return False
        self._said_s[subject] = now_s
        return True


def refusal(device: Device, server: Any) -> HjepaError:
    """Return the error of a controller that will not drive a device."""
    where = f"the controller at {written(server)}"
    if device.refused == protocol.OTHER_MODEL:
        return DataError(
            f"{where} runs another model, of plant {device.plant}; this one is of plant "
            f"{device.bundle.plant}",
            hint="copy the server's exported model to the device, and pass it as --model DIR",
        )
    if device.refused == protocol.OTHER_VERSION:
        return DataError(
            f"{where} speaks version {device.server_version} of the protocol, this device "
            f"{protocol.VERSION}",
            hint="install the same hjepa on both sides",
        )
    if device.refused == protocol.FULL:
        return Unavailable(
            f"{where} serves as many devices as it may", hint="--max-devices N there"
        )
    return DataError(f"{where} refuses the sizes of this model's embeddings or forces")
