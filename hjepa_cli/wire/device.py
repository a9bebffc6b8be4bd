"""A device is a state machine too: it sends embeddings, keeps forces, and is never without one.

The newest datagram says what to play in which step; what an older one foresaw for those steps is
gone. Where no datagram says anything of a step, the device plays the last force on, as in the
simulator, until a watchdog finds that the controller is silent; then its own actor drives, for as
long as it lasts. Without an actor it plays nothing, and stops.
"""

import secrets
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from hjepa_cli.wire import auth, protocol
from hjepa_cli.wire.bundle import Bundle
from hjepa_cli.wire.protocol import HELD, LOCAL, NO_STEP, PLANNED, ZERO, Embedding, Hello
from hjepa_cli.wire.runtime import Singles

WATCHDOG_S = 0.08  # at most, in the plant's own time: poles that only hold a force fall soon after
HELLO_S = (0.1, 0.4)  # between tries, at first and at most
AGAIN_STEPS = 20  # between first embeddings of a session, until one is answered; after silence too
QUIET_S = 0.5  # without a datagram the session is taken to be gone


class Played(NamedTuple):
    """Forces [m] that a device plays in a step, and where they are from."""

    forces_n: Singles
    source: int


class Device:
    """It speaks for one device.

    Args:
        bundle: the model that it shares with the controller.
        number: its own, of 32 bits.
        key: shared with the controller.
        period_s: of a control step, in wall time.
        actor: makes forces [m] of this step's picture without the controller; ``None``: it cannot.
        watchdog_steps: without a datagram, until the actor drives.
        random: makes 8 random bytes.

    Attributes:
        refused: why the controller will not drive it, as :data:`~.protocol.OTHER_MODEL`.
        plant: that of a controller which refused.
        connected: whether there is a session.
        silent: steps since the newest datagram with forces.
    """

    def __init__(
        self,
        bundle: Bundle,
        number: int,
        key: bytes,
        period_s: float,
        *,
        actor: Callable[[], Singles] | None = None,
        watchdog_steps: int | None = None,
        random: Callable[[], bytes] = lambda: secrets.token_bytes(8),
    ) -> None:
        self.bundle, self.number, self.period_s = bundle, number, period_s
        self._key, self._actor, self._random = key, actor, random
        self.watchdog_steps = (
            max(round(WATCHDOG_S / 2 / bundle.step_s), 1)
            if watchdog_steps is None
            else watchdog_steps
        )
        self.refused, self.plant, self.server_version = protocol.WELCOME, "", protocol.VERSION
        self._session: bytes | None = None
        self._hello_s, self._wait_s = -np.inf, 0.0
        self._asked_s: dict[bytes, float] = {}  # by nonce, of the newest hellos without an answer
        self._heard_s, self._was_silent = -np.inf, False
        self._counter, self._sent, self._sent_step = 0, 0, -AGAIN_STEPS
        self._forces_n: dict[int, Singles] = {}
        self._last = Played(np.zeros(bundle.axes, np.float32), HELD)
        self._last_step = 0
        self.silent = NO_STEP  # until the first forces
        self._answered, self._lag = NO_STEP, 0
        self.counts = dict.fromkeys(protocol.SOURCES, 0)
        self.ignored = 0

    @property
    def connected(self) -> bool:
        """Return whether there is a session."""
        return self._session is not None

    @property
    def has_actor(self) -> bool:
        """Return whether it can drive itself."""
        return self._actor is not None

    @property
    def answered(self) -> int:
        """Return the capture step of the newest embedding that forces have come back for."""
        return self._answered

    def is_new(self, step: int) -> bool:
        """Say whether to send now, whatever the rule: the controller knows nothing of now.

        It has not answered ever yet, or was silent until a moment ago.
        """
        unknown = self.connected and (self._answered == NO_STEP or self._was_silent)
        return unknown and step - self._sent_step >= AGAIN_STEPS

    # -- datagrams ------------------------------------------------------------------------------

    def upkeep(self, now_s: float) -> bytes | None:
        """Return a hello where one is due: without a session, or where it has become silent."""
        if now_s - self._hello_s < self._wait_s:
            return None
        if self.connected and now_s - self._heard_s < QUIET_S:
            return None
        nonce, self._hello_s = self._random(), now_s
        self._asked_s[nonce] = now_s
        if len(self._asked_s) > protocol.TRIES:
            del self._asked_s[next(iter(self._asked_s))]
        first_s, longest_s = HELLO_S
        self._wait_s = min(max(2 * self._wait_s, first_s), longest_s)
        hello = Hello(
            *(self.number, nonce, round(self.period_s * 1e6), self.bundle.embedding),
            *(self.bundle.axes, protocol.INT8, self.bundle.digest, self.bundle.plant),
        )
        return auth.tagged(self._key, protocol.pack_hello(hello))

    def embed(self, step: int, z: Singles, capture: int | None = None) -> bytes | None:
        """Return an embedding [D] of this step, or of an earlier one, as a datagram.

        ``None`` without a session.
        """
        if self._session is None:
            return None
        scale, codes = protocol.encode_int8(z)
        self._sent, self._sent_step, self._was_silent = self._sent + 1, step, False
        packet = Embedding(
            device=self.number,
            step=step,
            capture_age=step - (step if capture is None else capture),
            forces_n=self._last.forces_n,
            force_age=min(max(step - self._last_step, 0), 255),
            source=self._last.source,
            number=self._sent % 256,
            answered=self._answered,
            lag_steps=min(self._lag, 65_535),
            scale=scale,
            codes=codes,
        )
        return auth.tagged(self._session, protocol.pack_embedding(packet))

    def bye(self) -> bytes | None:
        """End the session; return what tells the controller."""
        session, self._session = self._session, None
        if session is None:
            return None
        return auth.tagged(session, protocol.pack_bye(protocol.Bye(self.number)))

    def receive(self, data: bytes, step: int, now_s: float) -> bool:
        """Take a datagram that comes in a step; say whether it changed anything."""
        try:
            kind, number = protocol.peek(data)
            if kind == protocol.ANSWER and number == self.number:
                return self._take_answer(data, now_s)
            session = self._session
            if number == self.number and session and auth.is_tagged(session, data):
                message = protocol.parse(data)
                if isinstance(message, protocol.Forces):
                    return self._take_forces(message, step, now_s)
                if isinstance(message, protocol.Bye):
                    self._session = None
                    return True
        except protocol.OtherVersion as error:
            ours = data[3] == protocol.ANSWER and data[8:16] in self._asked_s
            if ours and auth.is_tagged(self._key, data):
                self.refused, self.server_version = protocol.OTHER_VERSION, error.args[0]
        except protocol.Malformed:
            pass
        self.ignored += 1
        return False

    def _take_answer(self, data: bytes, now_s: float) -> bool:
        if not self._asked_s or not auth.is_tagged(self._key, data):
            self.ignored += 1
            return False
        answer = protocol.parse(data)
        assert isinstance(answer, protocol.Answer)
        asked_s = self._asked_s.get(answer.nonce)
        if asked_s is None:
            self.ignored += 1
            return False
        self.refused, self.plant = answer.reason, answer.plant
        if answer.reason == protocol.WELCOME:
            self._session = auth.session_key(
                self._key, self.number, answer.nonce, answer.server_nonce
            )
            self._counter, self._answered = 0, NO_STEP
            self._sent, self._sent_step = 0, -AGAIN_STEPS
            self._lag = int((now_s - asked_s) / self.period_s + 1e-6)
            self._hear(now_s)
        return True

    def _take_forces(self, message: protocol.Forces, step: int, now_s: float) -> bool:
        if message.counter <= self._counter or message.forces_n.shape[1] != self.bundle.axes:
            self.ignored += 1
            return False
        self._counter = message.counter
        kept = {at: f for at, f in self._forces_n.items() if step <= at < message.first}
        fresh = enumerate(message.forces_n, message.first)
        self._forces_n = kept | {at: forces_n for at, forces_n in fresh if at >= step}
        self._was_silent |= now_s - self._heard_s >= QUIET_S
        self._hear(now_s)
        self.silent = 0
        if message.base != self._answered:
            self._answered, self._lag = message.base, max(step - message.base, 0)
        return True

    def _hear(self, now_s: float) -> None:
        """Note that the session lives: an answer to a hello that is under way would end it."""
        self._heard_s, self._wait_s = now_s, 0.0
        self._asked_s.clear()

    # -- forces ---------------------------------------------------------------------------------

    def planned_n(self, step: int) -> Singles | None:
        """Return the forces [m] that the controller foresees for a step, if it does."""
        return self._forces_n.get(step)

    def play(self, step: int) -> Played:
        """Return the forces [m] to play in a step; call it once a step, in order."""
        planned = self._forces_n.pop(step, None)
        if planned is not None:
            limit_n = self.bundle.force_limit_n
            played = Played(np.clip(planned, -limit_n, limit_n), PLANNED)
        elif self.silent < self.watchdog_steps:
            played = Played(self._last.forces_n, HELD)
        elif self._actor is not None:
            played = Played(self._actor(), LOCAL)
        else:
            played = Played(np.zeros(self.bundle.axes, np.float32), ZERO)
        self.silent = min(self.silent + 1, NO_STEP)
        self._last, self._last_step = played, step
        self.counts[protocol.SOURCES[played.source]] += 1
        return played


class EverySteps:
    """It sends every so many steps, from step 0 on."""

    def __init__(self, gap_steps: int) -> None:
        self._gap = gap_steps

    def due(self, step: int) -> bool:
        """Say whether to send in a step."""
        return step % self._gap == 0


class OnInnovation:
    """It sends when the controller's force is wrong, by |C(z) − ũ| ÷ the force range.

    As devices report in the scheduler ``innovation``: they look at every eighth step only. A device
    that has nothing to say still sends after ``longest_steps``, so that losses are made good.

    Args:
        threshold: δ, the error that is too large.
        longest_steps: between datagrams.
    """

    LOOK_STEPS = 8

    def __init__(self, threshold: float, longest_steps: int) -> None:
        self._threshold, self._longest = threshold, longest_steps
        self._sent: int | None = None

    def wants_look(self, step: int) -> bool:
        """Say whether to encode this step's picture and compare forces."""
        return self._sent is None or step % self.LOOK_STEPS == 0 or self._overdue(step)

    def due(self, step: int, error: float | None) -> bool:
        """Say whether to send in a step whose control error is known, or not looked at."""
        due = self._sent is None or self._overdue(step)
        due |= error is not None and error >= self._threshold
        if due:
            self._sent = step
        return due

    def _overdue(self, step: int) -> bool:
        """Say whether nothing was sent for long, or steps have begun anew since."""
        return self._sent is not None and not 0 <= step - self._sent < self._longest
