"""What happened to devices over a while, ready to be drawn."""

import dataclasses

from hjepa_cli.core.arrays import Bools, Floats


@dataclasses.dataclass(frozen=True)
class Link:
    """What the radio does to n devices over K steps.

    Attributes:
        delivered: which packets arrive [K, n].
        snr_db: received SNR in each slot [K, n].
        sends_always: a packet in every slot, so that one that does not arrive was lost.
        label: one line for people.
    """

    delivered: Bools
    snr_db: Floats
    sends_always: bool
    label: str


@dataclasses.dataclass(frozen=True)
class Film:
    """What happened to the devices of one method.

    Attributes:
        method: its name.
        states: true states [K, n, S].
        believed: states read from the controller's embedding [K, n, S].
        score: whether each step was inside the band [K, n].
    """

    method: str
    states: Floats
    believed: Floats
    score: Bools
