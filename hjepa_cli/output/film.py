"""A film holds what happened to devices over a while, ready to be drawn."""

import dataclasses

from hjepa_cli.core.arrays import Bools, Floats


@dataclasses.dataclass(frozen=True)
class Link:
    """The radio does this to n devices over K steps."""

    delivered: Bools  # which packets arrive [K, n]
    snr_db: Floats  # received, in each slot [K, n]
    sends_always: bool  # in every slot, so that a packet that does not arrive was lost
    label: str  # one line for people


@dataclasses.dataclass(frozen=True)
class Film:
    """This happened to the devices of one method."""

    method: str
    states: Floats  # true [K, n, S]
    believed: Floats  # read from the controller's embedding [K, n, S]
    score: Bools  # whether each step was inside the band [K, n]
    flagged: Bools | None = None  # which packets looked like nothing in training [K, n]
