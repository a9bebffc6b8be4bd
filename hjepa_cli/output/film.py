"""A film holds what happened to devices over a while, ready to be drawn."""

import dataclasses
import functools

import numpy as np

from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.link import InFlight
from hjepa_cli.core.control.loop import LinkDraws


@dataclasses.dataclass(frozen=True)
class Link:
    """The radio does this to n devices over K steps."""

    sent: Bools  # which packets get through, by when they are sent [K, n]
    snr_db: Floats  # received, in each slot [K, n]
    sends_always: bool  # in every slot, so that a packet that does not arrive was lost
    label: str  # one line for people
    draws: LinkDraws  # how late they are
    late: str = ""  # the same in words, after a comma

    @property
    def delivered(self) -> Bools:
        """Return when packets arrive [K, n]."""
        return self._arrivals[0]

    @property
    def age_steps(self) -> Integers:
        """Return how long ago the newest packet that has arrived was sent [K, n]; −1: none has."""
        return self._arrivals[1]

    @functools.cached_property
    def _arrivals(self) -> tuple[Bools, Integers]:
        in_flight = InFlight(self.draws.delay_steps, self.draws.extra_steps)
        age, arrived, ages = np.full(self.sent.shape[1], -1), [], []
        for sent in self.sent:
            now, _, late = in_flight.pass_on(sent, sent[sent])
            age = np.where(age < 0, age, age + 1)
            age[now] = late
            arrived.append(now)
            ages.append(age)
        return np.stack(arrived), np.stack(ages)


@dataclasses.dataclass(frozen=True)
class Film:
    """This happened to the devices of one method."""

    method: str
    states: Floats  # true [K, n, S]
    believed: Floats  # read from the controller's embedding [K, n, S]
    score: Bools  # whether each step was inside the band [K, n]
    flagged: Bools | None = None  # which packets looked like nothing in training [K, n]
