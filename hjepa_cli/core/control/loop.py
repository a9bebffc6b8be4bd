"""The closed loop runs plants, link and controller, batched over devices and points.

One step k of every loop, in this order:

1. a device that transmits at k senses its state (its last frames, or the true state) and the
   controller receives the packet, or one that was sensed earlier where the link is late;
2. the controller picks the force u_k, from packets alone;
3. the device plays it, or, where that is lost on its way, what an earlier datagram said of k;
4. step k is scored on the state x_k and the force that is played, once the warm-up is over;
5. the plant moves to x_{k+1} under that force and process noise.

A device that has fallen, as its plant says, is over: it sends nothing more, gets no force, and each
of its steps is out of band and costs as much as a step can. With ``ends=False`` it goes on.

Devices N and curve points P (different link schedules on the same draws) share one simulation.
"""

import dataclasses
import inspect
import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from numbers import Real
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from numpy.typing import NDArray

from hjepa_cli.compute import memory
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats, Integers, Pixels
from hjepa_cli.core.control.bounds import STATE_LIMIT
from hjepa_cli.core.control.link import REMEMBERED_STEPS, Downlink, InFlight, lead_steps
from hjepa_cli.core.plants.cost import COST_CAP
from hjepa_cli.core.plants.frames import EVERY, LONGEST, frames_seen
from hjepa_cli.core.plants.system import System
from hjepa_cli.errors import NumericalError, UsageError

LOOP_VERSION = 6  # raise it whenever a measured number changes: cached curves then expire
_DRAWS_KEY, _LINK_KEY = 0xD4A5, 0x11A7
GOLDEN = (math.sqrt(5) - 1) / 2  # its multiples, modulo 1, spread evenly however many are taken


class Controller(Protocol):
    """Is the remote side, which has no way to the plant: packets come in, forces go out."""

    def act(self, delivered: Bools, packets: Any) -> Floats:
        """Return the forces of one step in newton [n, *A].

        Of the devices ``delivered`` [n] packets arrive, which carry ``packets``
        [delivered.sum(), ...]; ``None`` when there are none. A controller that has a third argument
        ``ages``, integers [delivered.sum()] or by default ``None``, is told at every step of a link
        that may be late how many steps ago each packet was sensed. Another takes them for fresh.

        One that has ``ahead_n()``, too, tells devices the forces [n, L, *A] of this step and of the
        next ones without a packet; of others a device holds the last force that reaches it. One
        that has ``stride_steps`` is given late packets whole strides old, and one that has
        ``give_up(devices)`` is told of which [n] nothing will be heard again.
        """
        ...


Sensor = Callable[[Floats], Any]
"""The device side makes packets [m, ...] of the last states of m devices [m, 16, S], the present
one last.

Those before a device was switched on are copies of its first; see
:func:`~hjepa_cli.core.plants.frames.frames_seen`.
"""


def check_memory(protocol: ProtocolSettings, devices: int) -> None:
    """Raise OutOfMemory where the draws of a closed loop do not fit."""
    values = protocol.total_steps * devices * (len(protocol.half_widths) + 1)
    memory.check(16 * values, f"a loop of {devices} devices over {protocol.total_steps} steps")


@dataclasses.dataclass(frozen=True)
class Draws:
    """Holds all random numbers of the closed loop, common to all methods and curve points.

    Device i's draws come from its own generator: they do not depend on how many devices there
    are, so the first 64 of 256 devices are the 64 devices.

    Attributes:
        initial: states at k = -1 [N, S].
        noise: added to the states after each step [steps, N, S].
        delivery: uniform numbers; a packet gets through where they are below p [steps, N].
        mass_scale: two masses of each device (a cart's and its pole's) ÷ nominal [N, 2].
        warmup_steps: how many of the steps, the first ones, are not scored.
        link: of what else happens to what is sent.
    """

    initial: Floats
    noise: Floats
    delivery: Floats
    mass_scale: Floats
    warmup_steps: int = 0
    link: "LinkDraws" = dataclasses.field(default_factory=lambda: LinkDraws())

    @classmethod
    def make(cls, protocol: ProtocolSettings, devices: int, seed: int) -> "Draws":
        """Draw for ``devices`` devices, all derived from ``seed``."""
        check_memory(protocol, devices)
        states = len(protocol.half_widths)
        initial = np.empty((devices, states))
        noise = np.empty((protocol.total_steps, devices, states))
        delivery = np.empty((protocol.total_steps, devices))
        mass_scale = np.empty((devices, 2))
        for device in range(devices):
            start, scale, uniforms, random = device_draws(protocol, seed, device)
            initial[device], mass_scale[device], delivery[:, device] = start, scale, uniforms
            noise[:, device] = random.standard_normal((protocol.total_steps, states))
        noise *= noise_per_step(protocol)
        link = LinkDraws.make(protocol, devices, seed)
        return cls(initial, noise, delivery, mass_scale, protocol.warmup_steps, link)

    @property
    def on_device(self) -> "Draws":
        """Return the same for controllers that sit on the device, where no link is in between."""
        return dataclasses.replace(self, link=LinkDraws())

    @property
    def devices(self) -> int:
        return len(self.initial)

    @property
    def steps(self) -> int:
        return len(self.noise)

    def part(self, devices: slice) -> "Draws":
        """Take the draws of some of the devices."""
        return Draws(
            self.initial[devices],
            self.noise[:, devices],
            self.delivery[:, devices],
            self.mass_scale[devices],
            self.warmup_steps,
            self.link.part(devices),
        )


@dataclasses.dataclass(frozen=True)
class LinkDraws:
    """Tells how late each packet is and which forces are lost; nothing where that never happens.

    Attributes:
        delay_steps: what every packet takes to arrive.
        extra_steps: what it takes besides [steps, N].
        lost: whether the datagram with a step's force is lost [steps, N].
        lead_steps: how long before its step a force is decided.
    """

    delay_steps: int = 0
    extra_steps: NDArray[np.integer[Any]] | None = None
    lost: Bools | None = None
    lead_steps: int = 0

    @classmethod
    def make(cls, protocol: ProtocolSettings, devices: int, seed: int) -> "LinkDraws":
        """Draw for ``devices`` devices; a device's draws do not depend on how many there are."""
        extra, lost = [], []
        for device in range(devices):
            random, steps = generator(seed, _LINK_KEY, device), protocol.total_steps
            if protocol.jitter_steps:
                extra.append(random.integers(protocol.jitter_steps + 1, size=steps, dtype=np.int16))
            if protocol.downlink_loss:
                lost.append(generator(seed, _LINK_KEY, device, 1).random(steps))
        return cls(
            protocol.delay_steps,
            np.stack(extra, axis=1) if extra else None,
            np.stack(lost, axis=1) < protocol.downlink_loss if lost else None,
            lead_steps(protocol.downlink_loss),
        )

    def part(self, devices: slice | Integers) -> "LinkDraws":
        """Take the draws of some of the devices."""
        extra, lost = (None if of is None else of[:, devices] for of in self._drawn)
        return dataclasses.replace(self, extra_steps=extra, lost=lost)

    def tiled(self, points: int) -> "LinkDraws":
        """Repeat the draws of the devices for so many curve points."""
        extra, lost = (None if of is None else np.tile(of, (1, points)) for of in self._drawn)
        return dataclasses.replace(self, extra_steps=extra, lost=lost)

    @property
    def _drawn(self) -> tuple[Any, Any]:
        return self.extra_steps, self.lost


def takes_ages(controller: Controller) -> bool:
    """Return whether a controller wants to be told how old packets are."""
    return "ages" in inspect.signature(controller.act).parameters


def lead_of(draws: LinkDraws, controller: Controller) -> int:
    """Return how long before its step a controller decides on a force.

    One that knows no ages, or that says by ``moves_on`` that it cannot move a packet on, does so in
    that step.
    """
    able = takes_ages(controller) and getattr(controller, "moves_on", True)
    return draws.lead_steps if able else 0


class Link:
    """Carries the packets of n devices to a controller, and its forces to them.

    Where forces are lost, a controller that knows ages runs some steps ahead of the devices: each
    force is decided so long before its step that most likely one of the datagrams until then tells
    of it. To that controller all packets are so much later.

    A controller with ``stride_steps`` gets a late packet when it is whole strides old: to move it
    on by the few steps that are left costs more than to wait for so long.

    Args:
        draws: of these devices.
        controller: drives them.
        delay_steps: what packets take besides, because they are long.

    Raises:
        UsageError: a packet may be later than the controller remembers what it sent.
    """

    def __init__(self, draws: LinkDraws, controller: Controller, delay_steps: int = 0) -> None:
        delay_steps, extra_steps = delay_steps + draws.delay_steps, draws.extra_steps
        latest = delay_steps + (0 if extra_steps is None else int(extra_steps.max(initial=0)))
        self._downlink = None if draws.lost is None else Downlink(draws.lost)
        self._controller = controller
        self._lead_steps = lead_of(draws, controller)
        self._decided: deque[Floats] = deque(maxlen=self._lead_steps + 1)  # until the next step's
        stride = getattr(controller, "stride_steps", 1)
        if extra_steps is None:
            delay_steps += -(delay_steps + self._lead_steps) % stride
        else:
            extra_steps = extra_steps + -(delay_steps + self._lead_steps + extra_steps) % stride
        late = delay_steps > 0 or extra_steps is not None
        self._in_flight = InFlight(delay_steps, extra_steps) if late else None
        self._told = (late or self._lead_steps > 0) and takes_ages(controller)
        if self._told and latest > REMEMBERED_STEPS:
            raise UsageError(
                f"packets may come {latest} steps late; a controller remembers what it sent in the "
                f"last {REMEMBERED_STEPS}",
                hint=f"make delay and jitter {REMEMBERED_STEPS} steps or less together",
            )

    def forces_n(self, sent: Bools, packets: Any) -> Floats:
        """Send the packets of one step; return the forces [n, *A] that devices play in it."""
        if self._in_flight:
            sent, packets, ages = self._in_flight.pass_on(sent, packets)
        else:
            ages = np.zeros(int(sent.sum()), np.int64)
        act: Any = self._controller.act
        told = (ages + self._lead_steps,) if self._told else ()
        forces_n: Floats = act(sent, packets, *told)
        if self._downlink is None:
            return forces_n
        if not self._decided:
            self._decided.extend([np.zeros_like(forces_n)] * self._lead_steps)
        self._decided.append(forces_n.copy())
        ahead_n = getattr(self._controller, "ahead_n", lambda: forces_n[:, None])()
        decided_n = np.stack(self._decided, axis=1)
        return self._downlink.play(np.concatenate([decided_n, ahead_n[:, 1:]], axis=1))

    def planned_n(self) -> Floats:
        """Return the forces [n, *A] of the coming step if no packet comes."""
        if self._lead_steps and self._decided:
            return self._decided[1]
        planned: Any = self._controller
        return planned.planned_n()  # type: ignore[no-any-return]


def device_draws(
    protocol: ProtocolSettings, seed: int, device: int
) -> tuple[Floats, Floats, Floats, np.random.Generator]:
    """Draw a device's initial state [S], mass factors [2] and delivery uniforms [total steps].

    The stream, returned last, goes on with the standard normal noise of one step after the other.
    """
    half_widths = np.array(protocol.half_widths)
    random = generator(seed, _DRAWS_KEY, device)
    initial = random.uniform(-1, 1, half_widths.size) * half_widths
    mass_scale = 1 + protocol.plant_spread * random.uniform(-1, 1, 2)
    return initial, mass_scale, random.random(protocol.total_steps), random


def noise_per_step(protocol: ProtocolSettings) -> Floats:
    """Return the standard deviation of the process noise of one step in each state [S].

    ``velocity`` disturbs velocities, as forces would; ``isotropic`` has one standard deviation,
    that of the first velocity, in all states (the paper's n_s, whose size it leaves open).
    """
    noise = np.array(protocol.velocity_noise)
    return np.full_like(noise, noise[1]) if protocol.process_noise == "isotropic" else noise


def every_step(steps: int, devices: int) -> Bools:
    """Return the schedule of a perfect link: bool [steps, devices], all true."""
    return np.ones((steps, devices), dtype=bool)


def gap_schedule(gap_steps: float, steps: int, devices: int) -> Bools:
    """Schedule one packet every D steps: device i sends at 0, and at ⌈nD + φ_i⌉ for n = 0, 1, …

    The packet at 0 is one more than the period asks for: :func:`packets_per_step` counts it. The
    phases φ_i = D · (i · golden ratio mod 1) spread any number of devices evenly over a period.
    Returns bool [steps, devices].

    Raises:
        UsageError: a gap D, whole or fractional, that is below 1 or infinite.
    """
    if not isinstance(gap_steps, Real) or not 1 <= gap_steps < math.inf:
        raise UsageError(f"gap of {gap_steps} steps; a gap is 1 step or longer, and finite")
    phases = gap_steps * np.fmod(np.arange(devices) * GOLDEN, 1.0)
    periods = np.arange(int(steps / gap_steps) + 1)
    # 1e-9 keeps a sum that is whole up to rounding from being sent one step late.
    times = np.ceil(periods[:, None] * gap_steps + phases - 1e-9).astype(np.int64)
    schedule = np.zeros((steps, devices), dtype=bool)
    period, device = np.nonzero(times < steps)
    schedule[times[period, device], device] = True
    schedule[0] = True
    return schedule


def packets_per_step(gap_steps: npt.ArrayLike, scored_steps: int, warmup_steps: int) -> Floats:
    """Return how many packets a loop under :func:`gap_schedule` sends per scored step.

    It is 1/D in steady state, and 1/D + (1 − 1/D)/K where the K scored steps begin with the loop,
    without a warm-up, since everybody is heard once at step 0 whatever its phase.
    """
    periodic = 1.0 / np.asarray(gap_steps, np.float64)
    return periodic if warmup_steps else periodic + (1.0 - periodic) / scored_steps


def delivery_schedule(probability: float, delivery: Floats) -> Bools:
    """Schedule a packet at every step that arrives with probability p; the first always does.

    From uniform numbers [steps, devices] this makes bool [steps, devices].

    Raises:
        UsageError: p outside 0 … 1.
    """
    if not isinstance(probability, Real) or not 0 <= probability <= 1:
        raise UsageError(f"delivery probability {probability}; it lies between 0 and 1")
    schedule = delivery < probability
    schedule[0] = True
    return schedule


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Holds measurements of a simulation, averaged over its scored steps.

    Attributes:
        score: share of steps inside the band [P, N].
        cost: mean capped quadratic cost [P, N].
        lost: 1 where the loop is :attr:`ScoredPlants.lost` after the last step, else 0 [P, N].
        flagged: share of packets that the controller flagged, of all steps [P, N]; NaN or ``None``
            where it looks at none.
    """

    score: Floats
    cost: Floats
    lost: Floats
    flagged: Floats | None = None

    @classmethod
    def joined(cls, parts: Sequence["Outcome"], axis: int) -> "Outcome":
        """Join outcomes along points (axis 0) or devices (axis 1)."""
        score, cost, lost = (
            np.concatenate([getattr(one, name) for one in parts], axis)
            for name in ("score", "cost", "lost")
        )
        flagged = None
        if any(one.flagged is not None for one in parts):
            of = [
                np.full_like(one.score, np.nan) if one.flagged is None else one.flagged
                for one in parts
            ]
            flagged = np.concatenate(of, axis)
        return cls(score, cost, lost, flagged)

    def part(self, points: slice, devices: slice = slice(None)) -> "Outcome":
        """Take some of the points and devices."""
        cut: dict[str, Any] = {
            name: None if of is None else of[points, devices] for name, of in vars(self).items()
        }
        return Outcome(**cut)


def simulate(
    plant: System,
    draws: Draws,
    delivered: Bools,
    controller: Controller,
    sensor: Sensor,
    *,
    delay_steps: int = 0,
    ends: bool = True,
    tick: Callable[[], None] = lambda: None,
    watch: Callable[[int, Floats, Floats], None] = lambda k, states, forces_n: None,
) -> Outcome:
    """Run P × N closed loops at once.

    Args:
        plant: what is controlled; device masses are scaled by ``draws.mass_scale``.
        draws: initial states, noise and deliveries of N devices.
        delivered: link schedules [P, steps, N]; see :func:`gap_schedule`.
        controller: drives P · N devices, point by point; in its initial state.
        sensor: turns states into packets.
        delay_steps: how long a packet is under way besides what the draws say of it.
        ends: whether a device that has fallen is over.
        tick: called after every step, for progress.
        watch: called at every step with k, states [P · N, S] and applied forces [P · N, *A].

    Raises:
        NumericalError: the controller returned a force that is not finite.
    """
    points, steps, devices = delivered.shape
    assert (steps, devices) == draws.delivery.shape, (delivered.shape, draws.delivery.shape)
    initial, mass_scale = (
        np.tile(drawn, (points, 1)) for drawn in (draws.initial, draws.mass_scale)
    )
    noise = (np.tile(drawn, (points, 1)) for drawn in draws.noise)
    plants = ScoredPlants(plant, initial, mass_scale, noise, draws.warmup_steps, ends=ends)
    link = Link(draws.link.tiled(points), controller, delay_steps)
    give_up = getattr(controller, "give_up", None)
    for k in range(steps):
        states, fallen = plants.states, plants.fallen
        sent = delivered[:, k].reshape(-1) & ~fallen
        forces_n = link.forces_n(sent, plants.sense(sensor, sent))
        watch(k, states, plants.move(forces_n))
        if give_up and (plants.fallen > fallen).any():
            give_up(plants.fallen)
        tick()
    means = plants.means(steps - draws.warmup_steps)
    score, cost, lost = (values.reshape(points, devices) for values in means)
    flagged = share_flagged(controller)
    return Outcome(score, cost, lost, None if flagged is None else flagged.reshape(score.shape))


def share_flagged(controller: Any) -> Floats | None:
    """Return the share of flagged packets of each device [n]; ``None`` where nobody looked.

    A controller that looks has a :class:`~hjepa_cli.core.control.familiarity.PacketCheck`.
    """
    check = getattr(controller, "check", None)
    flagged, received = (getattr(check, name, None) for name in ("flagged", "received"))
    if not (isinstance(flagged, np.ndarray) and isinstance(received, np.ndarray)):
        return None
    return np.asarray(flagged / np.maximum(received, 1))


class ScoredPlants:
    """Moves plants step by step, and scores each step.

    Args:
        plant: of all devices.
        initial: states at k = -1 [N, S]; the camera needs the frame before k = 0.
        mass_scale: of each device [N, 2].
        noise: added to the states [N, S] after one step after the other.
        warmup_steps: how many steps go by before scores and costs are summed.
        ends: whether a device that has fallen is over.

    Attributes:
        states: now [N, S].
        fallen: who is beyond help, or has been [N].
        score, cost: sums over the scored steps so far [N].
    """

    def __init__(
        self,
        plant: System,
        initial: Floats,
        mass_scale: Floats,
        noise: Iterator[Floats],
        warmup_steps: int = 0,
        *,
        ends: bool = True,
    ) -> None:
        devices = len(initial)
        self.plant, self._noise, self._ends = plant, noise, ends
        self._plants = plant.simulation(devices, mass_scale=mass_scale)
        self._plants.states = initial
        switched_on = [self._plants.states] * (LONGEST - 1)
        self._plants.step(plant.no_force(devices))
        self.states = self._plants.states
        self._seen = deque([*switched_on, self.states], maxlen=LONGEST)
        self.fallen = np.zeros(devices, dtype=bool)
        self._see_who_fell()
        self.score, self.cost = np.zeros(devices), np.zeros(devices)
        self._step, self._warmup_steps = 0, warmup_steps

    @property
    def lost(self) -> Bools:
        """Return who has fallen, or whose state now costs as much as a step can: bool [N].

        The stage cost is capped (:data:`~hjepa_cli.core.plants.cost.COST_CAP`) where control has
        lost the device: a cart-pole of plant desktop whose cart is further than 1.58 m away.
        """
        at_rest = self.plant.no_force(len(self.states))
        return np.asarray(self.fallen | (self.plant.cost(self.states, at_rest) >= COST_CAP))

    def _see_who_fell(self) -> None:
        if self._ends:
            self.fallen = self.fallen | self.plant.fallen(self.states)

    def means(self, scored_steps: int) -> tuple[Floats, Floats, Floats]:
        """Return score and cost per scored step, and who is lost as 0 or 1 [N] each."""
        return self.score / scored_steps, self.cost / scored_steps, self.lost.astype(np.float64)

    def sense(self, sensor: Sensor, devices: Bools) -> Any:
        """Return the packets of some devices; ``None`` where there are none."""
        if not devices.any():
            return None
        return sensor(np.stack([states[devices] for states in self._seen], axis=1))

    def move(self, forces_n: Floats) -> Floats:
        """Score this step and go on to the next; return the forces as applied [N, *A].

        Raises:
            NumericalError: a force is not finite.
        """
        if not np.isfinite(forces_n).all():
            raise NumericalError(f"the controller's force is not finite at step {self._step}")
        forces_n = np.clip(forces_n, -self.plant.force_limit_n, self.plant.force_limit_n)
        forces_n[self.fallen] = 0.0
        if self._step >= self._warmup_steps:
            self.score += self.plant.in_band(self.states) & ~self.fallen
            cost = self.plant.cost(self.states, forces_n)
            self.cost += np.where(self.fallen, COST_CAP, cost)
        self._plants.step(forces_n)
        moved = self._plants.states + next(self._noise)
        self._plants.states = np.clip(moved, -STATE_LIMIT, STATE_LIMIT)
        self.states = self._plants.states
        self._see_who_fell()
        self._seen.append(self.states)
        self._step += 1
        return forces_n


def last_states(rollouts: Floats | Pixels, k: int) -> Any:
    """Return what a sensor gets in step k of rollouts [R, steps + 1, S], stored from k = −1 on.

    Of recordings that is frames, [R, steps + 1, H, W, C].
    """
    return rollouts[:, frames_seen(k, EVERY)]
