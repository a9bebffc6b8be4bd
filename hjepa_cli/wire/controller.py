"""A controller drives many devices over datagrams; it is a state machine without sockets.

It is given datagrams and the time and returns datagrams. A device's own control steps are the only
clock: what step it is in now is guessed from its newest datagram, the time since, and its period.

Where an embedding is late, the controller moves it on to the present under the forces that the
device has played meanwhile, as :class:`hjepa_cli.core.control.controllers.StrideController` does in
the simulator, and plans strides from there, some steps ahead of the device. What it can compute in
a moment goes to packets first, then to the device whose forces run out soonest. Strides that are
past already are skipped, or a controller that is behind would stay so.
"""

import collections
import dataclasses
import heapq
import itertools
import secrets
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from hjepa_cli.core.control.link import REMEMBERED_STEPS
from hjepa_cli.wire import auth, protocol
from hjepa_cli.wire.bundle import BUCKETS, Bundle
from hjepa_cli.wire.protocol import Answer, Embedding, Forces, Hello
from hjepa_cli.wire.runtime import Runtime, Singles

WINDOW_STEPS = 16  # of forces in a datagram: its stride's, and those of strides before that fit
REPEATS = 7  # of an answer, one a step: what loses it loses the next datagram too, perhaps
LEAD_STEPS = 12  # that forces are computed ahead of the device, at least
CLOCK_INTERVALS = 3  # all of which a device must be slow in to be taken for slow
FADED_STEPS = 512  # since its newest embedding: then a device is served after all others
CLOCK_DATAGRAMS = 16  # of whose arrivals the earliest tells how late the others are
GREETING = (200.0, 400.0)  # hellos a second of all devices, and at once; as many of other versions
ALLOWANCE = (1.5, 32.0)  # datagrams per control step of a device, and at once
PENDING = 1024  # devices with sessions that have not been proved yet
NONCES = 8192  # of the newest hellos: one that comes again is a recording

Address = Any
Outgoing = list[tuple[bytes, Address]]


@dataclasses.dataclass
class Bucket:
    """A token bucket lets ``rate`` a second pass, and ``burst`` at once."""

    rate: float
    burst: float
    level: float = -1.0
    at_s: float = 0.0

    def take(self, now_s: float) -> bool:
        """Say whether one more may pass now."""
        if self.level < 0:
            self.level, self.at_s = self.burst, now_s
        self.level = min(self.burst, self.level + max(now_s - self.at_s, 0.0) * self.rate)
        self.at_s = now_s
        if self.level < 1:
            return False
        self.level -= 1
        return True


class Clock:
    """It guesses a device's control step from when its datagrams arrive.

    A device may be slower than its period, as computers are that have too much to do; one that is
    so in each of its last few intervals is taken at its word.

    Args:
        period_s: of a control step, in wall time.
    """

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self._starts_s: deque[float] = deque(maxlen=CLOCK_DATAGRAMS)
        self._paces_s: deque[float] = deque(maxlen=CLOCK_INTERVALS)
        self._step, self._present, self._at_s, self._pace_s = 0, 0, 0.0, period_s

    def hear(self, step: int, now_s: float) -> int:
        """Take an arrival; return how many steps later than the promptest one it came."""
        if self._starts_s and step > self._step:
            self._paces_s.append((now_s - self._at_s) / (step - self._step))
            slowest = len(self._paces_s) == CLOCK_INTERVALS
            self._pace_s = max(self.period_s, min(self._paces_s) if slowest else 0.0)
        start_s = now_s - step * self.period_s
        late = round((start_s - min(self._starts_s, default=start_s)) / self.period_s)
        if late > LEAD_STEPS:  # so late that its clock has stood still, or ours has jumped
            self._starts_s.clear()
            late = 0
        self._starts_s.append(start_s)
        late = max(late, 0)
        self._step, self._present, self._at_s = step, step + late, now_s
        return late

    def forget(self) -> None:
        """Take the next arrival for prompt: the device's steps have stood still for a while."""
        self._starts_s.clear()

    def step(self, now_s: float) -> int:
        """Return the step that the device is in by now."""
        return self._present + int((now_s - self._at_s) / self._pace_s + 1e-6)

    def time_s(self, step: int) -> float:
        """Return when the device begins a step."""
        return self._at_s + (step - self._present) * self._pace_s


class Session:
    """It is all that a controller knows of a device; its size does not grow.

    Attributes:
        planned: forces are planned up to this step, which is not among them.
        base: capture step of the embedding that they follow from.
        fresh: an embedding that has not been answered yet, with its lateness.
        embeddings, lost: how many came, and how many did not by the numbers of those that did.
        answers, missed: embeddings that were answered, and of these those too late for their step.
        skipped: strides that were past when their turn came.
        source: of the device's last force.
    """

    def __init__(
        self, hello: Hello, key: bytes, address: Address, now_s: float, stride: int
    ) -> None:
        self._window = max(stride, min(WINDOW_STEPS, protocol.MOST_FORCES // hello.forces))
        self.hello, self.key, self.address = hello, key, address
        self.heard_s, self.replies = now_s, auth.ReplayWindow()
        self.clock = Clock(hello.period_us / 1e6)
        rate, burst = ALLOWANCE
        self.allowance = Bucket(rate / self.clock.period_s, burst)
        self.z: Singles | None = None
        self.planned, self.start, self.base, self.newest = 0, 0, 0, -1
        self.fresh: tuple[Embedding, int] | None = None
        self.counter = self.ticket = 0
        self.embeddings = self.lost = self.answers = self.missed = self.skipped = 0
        self.source, self._count = protocol.HELD, 0
        self._forces_n = np.zeros((REMEMBERED_STEPS, hello.forces), np.float32)
        self._lateness: dict[int, int] = {}  # of the newest captures that were answered
        self._delays: deque[int] = deque(maxlen=8)

    def delay_steps(self) -> int:
        """Return what every round trip takes: by the device's word, less how late packets were."""
        return int(np.median(self._delays)) if self._delays else 0

    def learn(self, packet: Embedding) -> None:
        """Take what a datagram says besides its embedding."""
        guessed = self.answers == 0
        if self.embeddings:
            self.lost += (packet.number - self._count - 1) % 256
        self._count, self.embeddings = packet.number, self.embeddings + 1
        self.source = packet.source
        late = 0
        if packet.answered != protocol.NO_STEP:
            if packet.answered not in self._lateness:
                return
            late = self._lateness.pop(packet.answered)
            if packet.lag_steps < late:  # it cannot have been that late
                self.clock.forget()
            self.answers += 1
            if guessed:  # from the hello
                self._delays.clear()
            self.missed += packet.lag_steps > 0
        self._delays.append(max(packet.lag_steps - late, 0))

    def note_lateness(self, capture: int, late: int) -> None:
        """Remember how late an embedding came, until the device tells how late its answer was."""
        self._lateness[capture] = late
        while len(self._lateness) > 16:
            del self._lateness[next(iter(self._lateness))]

    def remember(self, first: int, forces_n: Singles) -> None:
        """Keep forces [L, m] that the device is sent for the steps from ``first`` on."""
        self._forces_n[(first + np.arange(len(forces_n))) % REMEMBERED_STEPS] = forces_n

    def forces_n(self, first: int, count: int) -> Singles:
        """Return the forces [count, m] of the steps from ``first`` on; the last one is held."""
        steps = np.minimum(first + np.arange(count), max(self.planned - 1, 0))
        return np.asarray(self._forces_n[steps % REMEMBERED_STEPS])

    @property
    def ends_s(self) -> float:
        """Return when the planned forces run out."""
        return self.clock.time_s(self.planned)

    def datagram(self) -> bytes:
        """Return the newest forces as a datagram."""
        first = max(self.start, self.planned - self._window)
        forces_n = self.forces_n(first, self.planned - first)
        self.counter += 1
        message = Forces(self.hello.device, self.counter, self.base, first, forces_n)
        return auth.tagged(self.key, protocol.pack_forces(message))


class Controller:
    """It answers the datagrams of many devices.

    Args:
        bundle: the model.
        runtime: computes its networks.
        key: shared with the devices.
        most_devices: sessions at a time; further devices are refused.
        timeout_s: a device that is silent for so long is forgotten.
        random: makes 8 random bytes.

    Attributes:
        counts: what has come and gone, by name.
        waited_s: times from arrivals to answers of the newest embeddings.
        say: is told, in a line, what somebody who runs a server should know.
    """

    def __init__(
        self,
        bundle: Bundle,
        runtime: Runtime,
        key: bytes,
        *,
        most_devices: int = 1024,
        timeout_s: float = 10.0,
        random: Callable[[], bytes] = lambda: secrets.token_bytes(8),
    ) -> None:
        self.bundle, self._runtime, self._key = bundle, runtime, key
        self._most, self._timeout_s, self._random = most_devices, timeout_s, random
        self.sessions: dict[int, Session] = {}
        self._pending: collections.OrderedDict[int, deque[Session]] = collections.OrderedDict()
        self._greeting, self._greeting_others = Bucket(*GREETING), Bucket(*GREETING)
        self._nonces: collections.OrderedDict[bytes, None] = collections.OrderedDict()
        self._fresh: dict[int, Session] = {}
        self._due: list[tuple[float, int, Session]] = []  # heaps by when, and what is stale
        self._faded: list[tuple[float, int, Session]] = []
        self._again: list[tuple[float, int, Session, int]] = []  # answers to repeat: when, of what
        self._tickets = itertools.count()
        self.counts: collections.Counter[str] = collections.Counter()
        self.waited_s: deque[float] = deque(maxlen=1024)
        self._answering: list[float] = []
        self.say: Callable[[str], None] = lambda line: None

    # -- datagrams ------------------------------------------------------------------------------

    def receive(self, data: bytes, address: Address, now_s: float) -> Outgoing:
        """Take a datagram; return what to send at once. Whatever it holds, nothing is raised."""
        try:
            kind, device = protocol.peek(data)
            if kind == protocol.HELLO:
                return self._greet(data, address, now_s)
            return self._take(device, data, address, now_s)
        except protocol.OtherVersion as error:
            return self._refuse_version(data, error.args[0], address, now_s)
        except protocol.Malformed:
            self.counts["malformed"] += 1
            return []

    def _refuse_version(
        self, data: bytes, version: int, address: Address, now_s: float
    ) -> Outgoing:
        """Answer a hello of another version, whose nonce and tag lie where ours do, in our own."""
        self.counts["other_version"] += 1
        if data[3] != protocol.HELLO or len(data) < 76 + protocol.TAG_BYTES:
            return []
        if not self._admit(data, self._greeting_others, now_s):
            return []
        self.say(f"a device speaks version {version} of the protocol; this is {protocol.VERSION}")
        device = int.from_bytes(data[4:8], "little")
        return [(self._answer(device, data[8:16], bytes(8), protocol.OTHER_VERSION), address)]

    def _answer(self, device: int, nonce: bytes, server_nonce: bytes, reason: int) -> bytes:
        answer = Answer(device, nonce, server_nonce, reason, self.bundle.digest, self.bundle.plant)
        return auth.tagged(self._key, protocol.pack_answer(answer))

    def _admit(self, data: bytes, allowance: Bucket, now_s: float) -> bool:
        """Say whether a hello is of somebody with the key, is no recording, and is within bounds.

        What has no tag of ours spends nothing: or strangers could keep devices out.
        """
        if not auth.is_tagged(self._key, data):
            self.counts["forged"] += 1
            return False
        nonce = data[8:16]
        if nonce in self._nonces:
            self.counts["doubled"] += 1
            return False
        if not allowance.take(now_s):
            self.counts["limited"] += 1
            return False
        self._nonces[nonce] = None
        while len(self._nonces) > NONCES:
            self._nonces.popitem(last=False)
        return True

    def _greet(self, data: bytes, address: Address, now_s: float) -> Outgoing:
        """Answer a hello; the session counts once a datagram proves that the device has its key."""
        if not self._admit(data, self._greeting, now_s):
            return []
        hello = protocol.parse(data)
        assert isinstance(hello, Hello)
        self.counts["hellos"] += 1
        known = hello.device in self.sessions
        ours = self.bundle.embedding, self.bundle.axes, protocol.INT8
        reason = protocol.WELCOME
        if hello.model != self.bundle.digest:
            reason = protocol.OTHER_MODEL
            self.say(f"device {hello.device} runs another model, of plant {hello.plant}: refused")
        elif (hello.embedding, hello.forces, hello.codec) != ours:
            reason = protocol.UNSUITED
        elif not known and len(self.sessions) >= self._most:
            reason = protocol.FULL
            self.say(f"device {hello.device} refused: {self._most} devices are served already")
        server_nonce = self._random()
        if reason == protocol.WELCOME:
            key = auth.session_key(self._key, hello.device, hello.nonce, server_nonce)
            tries = self._pending.setdefault(hello.device, deque(maxlen=protocol.TRIES))
            tries.appendleft(Session(hello, key, address, now_s, self.bundle.stride))
            self._pending.move_to_end(hello.device)
            while len(self._pending) > PENDING:
                self._pending.popitem(last=False)
        else:
            self.counts["refused"] += 1
        return [(self._answer(hello.device, hello.nonce, server_nonce, reason), address)]

    def _take(self, device: int, data: bytes, address: Address, now_s: float) -> Outgoing:
        """Take a datagram of a session; what is old, doubled or foreign changes nothing."""
        session = self._session_of(device, data)
        if session is None:
            self.counts["foreign" if device not in self.sessions else "forged"] += 1
            return []
        message = protocol.parse(data)
        if isinstance(message, protocol.Bye):
            self._forget(device)
            self.counts["byes"] += 1
            return []
        ours = self.bundle.embedding, self.bundle.axes
        if (
            not isinstance(message, Embedding)
            or (len(message.codes), len(message.forces_n)) != ours
        ):
            self.counts["malformed"] += 1
            return []
        if session is not self.sessions.get(device):
            if device not in self.sessions and len(self.sessions) >= self._most:
                self.counts["refused"] += 1
                return []
            self.sessions[device] = session
            del self._pending[device]
            self.counts["sessions"] += 1
        verdict = session.replies.judge(message.step)
        if verdict != "new" or message.capture <= session.newest:
            self.counts["late" if verdict == "late" else "doubled"] += 1
            return []
        if not session.allowance.take(now_s):  # last, or strangers could spend a device's own
            self.counts["limited"] += 1
            return []
        self.counts["embeddings"] += 1
        session.address, session.heard_s = address, now_s
        session.learn(message)
        late = session.clock.hear(message.step, now_s)
        session.newest = message.capture
        session.fresh = message, late
        self._fresh[device] = session
        return []

    def _session_of(self, device: int, data: bytes) -> Session | None:
        """Return the session whose key a datagram is tagged with, be it proved yet or not."""
        tries: Iterable[Session] = self._pending.get(device, ())
        for one in (self.sessions.get(device), *tries):
            if one is not None and auth.is_tagged(one.key, data):
                return one
        return None

    def _forget(self, device: int) -> None:
        self.sessions.pop(device, None)
        self._pending.pop(device, None)
        self._fresh.pop(device, None)

    # -- work -----------------------------------------------------------------------------------

    def work(self, now_s: float) -> Outgoing:
        """Do the most urgent batch of what there is to do; return datagrams, none if all is done.

        Call it again until it returns none, looking for new datagrams in between.
        """
        if self._fresh:
            return self._answer_fresh(now_s)
        return self._repeat(now_s) or self._look_ahead(now_s)

    def due_s(self, now_s: float) -> float:
        """Return in how many seconds there is something to do again, at most 1."""
        if self._fresh:
            return 0.0
        heaps: tuple[list[Any], ...] = (self._due, self._faded, self._again)
        soonest_s = min((heap[0][0] for heap in heaps if heap), default=now_s + 1.0)
        return min(max(soonest_s - now_s, 0.0), 1.0)

    def tidy(self, now_s: float) -> None:
        """Forget devices that have been silent for too long; call it about once a second."""
        for device, session in [*self.sessions.items()]:
            if now_s - session.heard_s > self._timeout_s:
                self.counts["timeouts"] += 1
                self.say(f"device {device} has been silent for {self._timeout_s:g} s: forgotten")
                self._forget(device)
        while self._pending:  # in the order of their newest hellos
            device, tries = next(iter(self._pending.items()))
            if now_s - tries[0].heard_s <= self._timeout_s:
                break
            del self._pending[device]

    def _answer_fresh(self, now_s: float) -> Outgoing:
        """Plan a stride for each of those that have sent something, the first come first."""
        devices = list(self._fresh)[: BUCKETS[-1]]
        sessions = [self._fresh.pop(device) for device in devices]
        z, ages = np.empty((len(sessions), self.bundle.embedding), np.float32), []
        for row, session in enumerate(sessions):
            assert session.fresh is not None
            packet, late = session.fresh
            z[row] = protocol.decode_int8(packet.scale, packet.codes)
            age = packet.capture_age + late + session.delay_steps()
            age += -age % self.bundle.stride  # P^H alone moves it on; until then the old plan holds
            ages.append(min(age, REMEMBERED_STEPS - WINDOW_STEPS))
            if packet.source != protocol.PLANNED and packet.force_age <= packet.step:
                session.remember(packet.step - packet.force_age, packet.forces_n[None])
            session.note_lateness(packet.capture, late + packet.capture_age)
            session.base, session.fresh = packet.capture, None
        steps = np.array(ages)
        if steps.any():
            played_n = np.zeros((len(sessions), int(steps.max()), self.bundle.axes), np.float32)
            for row, (session, age) in enumerate(zip(sessions, ages, strict=True)):
                played_n[row, :age] = session.forces_n(session.base, age)
            z = self._runtime.follow(z, played_n, steps)
        for row, (session, age) in enumerate(zip(sessions, ages, strict=True)):
            session.z, session.start = z[row], session.base + age
            session.planned = session.start
        self._answering = [session.heard_s for session in sessions]
        for session in sessions:
            for repeat in range(1, REPEATS + 1):
                when_s = now_s + repeat * session.clock.period_s - 1e-9
                entry = (when_s, next(self._tickets), session, session.base)
                heapq.heappush(self._again, entry)
        return self._plan(sessions)

    def _repeat(self, now_s: float) -> Outgoing:
        """Send the newest forces of those that were answered a moment ago once more."""
        outgoing = []
        for _ in range(4 * BUCKETS[-1]):
            if not self._again or self._again[0][0] > now_s:
                break
            when_s, _, session, base = heapq.heappop(self._again)
            known = self.sessions.get(session.hello.device) is session and session.base == base
            if known and now_s - when_s < session.clock.period_s:  # later ones are of no use
                outgoing.append((session.datagram(), session.address))
        self.counts["sent"] += len(outgoing)
        return outgoing

    def sent(self, now_s: float) -> None:
        """Take the time when what :meth:`work` returned was on its way."""
        self.waited_s.extend(now_s - heard_s for heard_s in self._answering)
        self._answering = []

    def _look_ahead(self, now_s: float) -> Outgoing:
        """Plan a stride for those whose forces run out soonest, if they do within the lead.

        Devices whose embeddings have faded come after all others: silent ones cost nobody a force.
        """
        due = self._take_due(self._due, now_s) or self._take_due(self._faded, now_s)
        due.sort(key=lambda session: session.ends_s)
        for session in due[BUCKETS[-1] :]:
            self._queue(session)
        sessions = due[: BUCKETS[-1]]
        for session in sessions:
            arrival = session.clock.step(now_s) + session.delay_steps()
            if session.planned < arrival:
                self._skip(session, arrival)
        return self._plan(sessions) if sessions else []

    def _take_due(self, heap: list[tuple[float, int, Session]], now_s: float) -> list[Session]:
        """Take from a heap who is due by now, a few batches at most."""
        due: list[Session] = []
        while heap and heap[0][0] <= now_s and len(due) < 4 * BUCKETS[-1]:
            _, ticket, session = heapq.heappop(heap)
            known = self.sessions.get(session.hello.device) is session
            if not known or session.ticket != ticket:
                continue
            if heap is self._due and session.clock.step(now_s) - session.base > FADED_STEPS:
                heapq.heappush(self._faded, (now_s, ticket, session))
            else:
                due.append(session)
        return due

    def _queue(self, session: Session) -> None:
        """Note when a device's next stride is due: some steps before it needs it."""
        faded = session.planned - session.base > FADED_STEPS
        ahead = LEAD_STEPS + session.delay_steps()
        when_s = session.clock.time_s(session.planned - ahead)
        session.ticket = next(self._tickets)  # older ones in the heaps are void
        heapq.heappush(self._faded if faded else self._due, (when_s, session.ticket, session))

    def _skip(self, session: Session, arrival: int) -> None:
        """Move an embedding over whole strides that are past at arrival; the force was held."""
        strides = (arrival - session.planned) // self.bundle.stride
        if not strides or session.z is None:
            return
        self.counts["skipped_strides"] += strides
        session.skipped += strides
        steps = min(strides * self.bundle.stride, FADED_STEPS)
        held_n = session.forces_n(session.planned - 1, 1)
        ahead_n = np.repeat(held_n[None], steps, axis=1)
        session.z = self._runtime.follow(session.z[None], ahead_n, np.array([steps]))[0]
        session.start = session.planned = session.planned + strides * self.bundle.stride

    def _plan(self, sessions: list[Session]) -> Outgoing:
        """Plan the next stride of each, and return the datagrams that tell them."""
        sessions = [session for session in sessions if not self._is_used_up(session)]
        if not sessions:
            return []
        z = np.stack([session.z for session in sessions])  # type: ignore[misc]
        forces_n, z_next = self._runtime.plan(z)
        outgoing = []
        for row, session in enumerate(sessions):
            session.remember(session.planned, forces_n[row])
            session.planned += self.bundle.stride
            session.z = z_next[row]
            self._queue(session)
            outgoing.append((session.datagram(), session.address))
        self.counts["strides"] += len(sessions)
        self.counts["sent"] += len(sessions)
        return outgoing

    def _is_used_up(self, session: Session) -> bool:
        """Forget a session whose numbers end; say so. Its device begins another one at step 0."""
        if max(session.planned, session.counter) < protocol.MOST_STEPS:
            return False
        self.counts["used_up"] += 1
        self._forget(session.hello.device)
        return True

    def farewell(self) -> Outgoing:
        """Return what tells all devices that the controller ends."""
        return [
            (auth.tagged(one.key, protocol.pack_bye(protocol.Bye(device))), one.address)
            for device, one in self.sessions.items()
        ]
