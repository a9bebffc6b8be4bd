"""A physical layer says how many packets a slot carries, how many are lost and how late they are.

A slot is a control step τ_o of the plants; what a standard calls a slot is said to be a carrier's.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple, Protocol

from hjepa_cli.config.schema import NrSettings, RadioSettings
from hjepa_cli.plugins import check_members

Noise = Literal["fixed", "scaled"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Carried:
    """Tells what slots of the whole band carry of packets of one size at one SNR.

    Attributes:
        packets_per_slot: c, that get through: each takes as many transmissions as it needs.
        transmissions_per_slot: that can be sent.
        resource_transmissions: that there would be room for, were each granted for free.
        round_errors: share that fails of first transmissions of a sample, of second ones, given
            that the first failed, … One entry: none is repeated.
        latency_s: from a sample to the end of its first transmission, processing included.
        late_slots: how late packets are on average; 0 for those that arrive in their slot.
        round_trip_slots: from one transmission of a sample to the next.
        allocation_hz: the part of the band that one transmission is on.
        details: what rows of ``scale --json`` say besides.
        described: how large a packet is, or why none can be sent at all.
    """

    packets_per_slot: float
    transmissions_per_slot: float
    resource_transmissions: float
    round_errors: tuple[float, ...] = (0.0,)
    latency_s: float = 0.0
    late_slots: float = 0.0
    round_trip_slots: int = 1
    allocation_hz: float
    details: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    described: str = ""


class Reports(NamedTuple):
    """Tells what innovation reports are made of, and which shares of a slot they take.

    Attributes:
        bits: of one report.
        share_each: that one report takes.
        share_reserved: that is kept for reports whether there are some or not.
        levels: that a report tells apart, each twice the one below, from δ on; 0: 8 bits.
        delay_slots: until a report has led to a transmission.
    """

    bits: float
    share_each: float = 0.0
    share_reserved: float = 0.0
    levels: int = 0
    delay_slots: int = 0


class PhysicalLayer(Protocol):
    """Is a physical layer with the settings of one cell.

    Attributes:
        overhead_bits: that it sends with each packet, headers and checks.
    """

    @property
    def overhead_bits(self) -> int: ...

    def carries(
        self, payload_bits: float, snr_db: float, *, dynamic: bool | None = None
    ) -> Carried:
        """Return what slots carry of packets of b bits, power-controlled to an SNR.

        ``dynamic`` tells whether each transmission is granted by itself, where that makes a
        difference; ``None``: as the settings say.
        """
        ...

    def shared_by(self, delivery: float, payload_bits: float, snr_db: float, noise: Noise) -> int:
        """Return how many send in every slot and get through with this probability at least.

        All have equal parts of the band; the SNR is a mean over Rayleigh fading, on the whole band
        where the noise is ``scaled`` with a device's part.
        """
        ...

    def delivery_alone(self, payload_bits: float, snr_db: float) -> float:
        """Return the probability that a device gets through which has the band for itself."""
        ...

    def reports(self, devices: int, snr_db: float) -> Reports:
        """Return what innovation reports take in a cell of so many devices."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Phy:
    """Makes physical layers of one kind.

    Attributes:
        name: as in ``--phy``.
        help: what it is, in a few words.
        layer: builds one of the settings of the cell and the slot in seconds.
        uses: settings of ``scale`` that mean nothing under others that do not list them.
        check: raises UsageError for settings that it cannot be built of, before anything is read.
    """

    name: str
    help: str
    layer: Callable[[RadioSettings, NrSettings, float], PhysicalLayer]
    uses: tuple[str, ...] = ()
    check: Callable[[RadioSettings, NrSettings], None] = lambda radio, nr: None

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, str, "help")
        check_members(self, callable, "layer", "check")
        check_members(self, tuple, "uses")
