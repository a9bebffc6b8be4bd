"""A link may be late in both directions, out of order, and lose forces on their way back.

What it loses on the way up is the schedule's, :mod:`hjepa_cli.core.control.loop`. A delay is that
from a packet's capture to the step whose force answers it, so the way back is in it.
"""

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.config.schema import IDEAL_LINK, ProtocolSettings
from hjepa_cli.core.arrays import Bools, Floats, Integers

AHEAD_STEPS = 16  # forces in a datagram at most: its step's, and those of the next ones
UNTOLD = 1 / 32  # share of devices that may play a force that was planned before the last packet
MOST_LEAD_STEPS = AHEAD_STEPS // 2 - 1
REMEMBERED_STEPS = 512  # in which controllers know what they sent: no packet may be later
LINK_VERSION = 2  # raise it whenever a number measured over a link that is not ideal changes
STEP_BITS = FORCE_BITS = 16  # step numbers start again after 65,536


def lead_steps(downlink_loss: float) -> int:
    """Return how many steps before its own a force is decided, where a share of datagrams is lost.

    So many that at most one device in 32 has not been told by then, and at most half a datagram:
    without this a device that missed the answer to a packet plays what was planned before it.
    """
    if downlink_loss <= 0:
        return 0
    tellings = math.ceil(math.log(UNTOLD) / math.log(downlink_loss))
    return min(tellings - 1, MOST_LEAD_STEPS)


def confirmation_bits(protocol: ProtocolSettings, forces: int) -> int:
    """Return the bits by which a packet is longer where the link is not ideal.

    The controller has to know when the packet was captured, and what had been played by then: so it
    tells its step, the last forces applied and the step of the datagram that they came from.
    """
    return 0 if protocol.ideal_link else 2 * STEP_BITS + forces * FORCE_BITS


def facts(protocol: ProtocolSettings, forces: int) -> dict[str, float]:
    """Return what ``eval --json`` and ``scale --json`` say of the link."""
    known = {key: getattr(protocol, key) for key in IDEAL_LINK}
    return known | {"confirmation_bits": confirmation_bits(protocol, forces)}


def described(link: Mapping[str, float]) -> str:
    """Say in words, each part after a comma, in what the link of :func:`facts` is not ideal."""
    delay, jitter, loss = (link.get(key, 0) for key in IDEAL_LINK)
    steps = f"{delay} to {delay + jitter}" if jitter else f"{delay}"
    late = f", packets {steps} steps late" if delay or jitter else ""
    return late + (f", {100 * loss:g} % of the forces lost" if loss else "")


class InFlight:
    """Holds packets that are under way; one that a newer one overtook is never handed out.

    Args:
        delay_steps: from a packet's capture to its arrival.
        extra_steps: what each packet takes besides, by step and device [steps, n]; ``None``: all
            take the same.
    """

    def __init__(self, delay_steps: int, extra_steps: NDArray[np.integer[Any]] | None) -> None:
        self._delay_steps, self._extra_steps = delay_steps, extra_steps
        longest = 0 if extra_steps is None else int(extra_steps.max(initial=0))
        self._waiting: deque[tuple[int, Bools, Any]] = deque(maxlen=delay_steps + longest + 1)
        self._newest: Integers | None = None  # the capture of what each has received [n]
        self._k = 0

    def pass_on(self, sent: Bools, packets: Any) -> tuple[Bools, Any, Integers]:
        """Take the packets [sent.sum(), ...] of one step, and hand out those that arrive in it.

        Returns:
            Which of the devices a packet arrived from [n], these packets, ``None`` where there are
            none, and how many steps ago each was captured.
        """
        k, self._k = self._k, self._k + 1
        self._waiting.append((k, sent, packets))
        if self._extra_steps is None:
            due = k - self._delay_steps
            if due < 0 or not self._waiting[0][1].any():
                return np.zeros_like(sent), None, np.zeros(0, np.int64)
            _, arrived, packets = self._waiting[0]
            return arrived, packets, np.full(int(arrived.sum()), self._delay_steps)
        if self._newest is None:
            self._newest = np.full(len(sent), -1)
        pieces, captures = [], np.full(len(sent), -1)
        for captured, of, held in self._waiting:
            arrives = of & (captured + self._delay_steps + self._extra_steps[captured] == k)
            arrives &= captured > self._newest
            if arrives.any():
                pieces.append((np.flatnonzero(arrives), held, np.cumsum(of) - 1))
                captures[arrives] = captured  # the newest of those that arrive together
        arrived = captures >= 0
        if not pieces:
            return arrived, None, np.zeros(0, np.int64)
        self._newest[arrived] = captures[arrived]
        place, collected = np.cumsum(arrived) - 1, None
        for devices, held, rows in pieces:
            if collected is None:
                collected = _empty_like(held, int(arrived.sum()))
            collected[place[devices]] = held[rows[devices]]
        return arrived, collected, k - captures[arrived]


def _empty_like(packets: Any, count: int) -> Any:
    shape = (count, *packets.shape[1:])
    if isinstance(packets, np.ndarray):
        return np.empty(shape, packets.dtype)
    return packets.new_empty(shape)  # a tensor: torch is not imported for its name


class Downlink:
    """Devices play what the newest datagram says of a step, and its last force after its end.

    Args:
        lost: whether the datagram of each step is lost on its way to each device [steps, n].
    """

    def __init__(self, lost: Bools) -> None:
        self._lost, self._k = lost, 0
        self._plans: Floats | None = None
        self._ages = np.zeros(lost.shape[1], dtype=np.int64)

    def play(self, plans_n: Floats) -> Floats:
        """Send plans [n, L, *A], from this step on; return the forces [n, *A] that are played.

        Whom no datagram has reached yet plays 0 N.
        """
        plans_n = plans_n[:, :AHEAD_STEPS]
        if self._plans is None:
            self._plans = np.zeros_like(plans_n)
        reached = ~self._lost[self._k]
        self._plans[reached], self._ages[reached] = plans_n[reached], 0
        at = np.minimum(self._ages, plans_n.shape[1] - 1)
        self._ages += 1
        self._k += 1
        return np.asarray(self._plans[np.arange(len(at)), at])


class SentForces:
    """Remembers the forces that n devices were sent in their last steps."""

    def __init__(self, devices: int, steps: int, action_shape: tuple[int, ...]) -> None:
        self._forces_n = np.zeros((steps, devices, *action_shape))
        self._k = 0

    def note(self, forces_n: Floats) -> None:
        """Take the forces [n, *A] of a step."""
        self._forces_n[self._k % len(self._forces_n)] = forces_n
        self._k += 1

    def since(self, devices: Integers, ages: Integers) -> Floats:
        """Return the forces [m, L, *A] of m devices from so many steps ago on, L the largest age.

        Behind the last step of a younger one are zeros, and so are forces before the first step.
        """
        steps = np.arange(int(ages.max(initial=0)))
        at = (self._k - ages)[:, None] + steps
        forces_n = self._forces_n[at % len(self._forces_n), devices[:, None]]
        forces_n[(at < 0) | (at >= self._k)] = 0.0
        return np.asarray(forces_n)
