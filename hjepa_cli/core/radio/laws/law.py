"""A sharing law says what it is called, and which settings it reads."""

import dataclasses
from typing import Any

from hjepa_cli.plugins import check_members

Row = dict[str, Any]  # of ``scale --json``

# Read of links that power control holds at γ̄, where what a packet is sent on follows from it.
HELD_LINKS = (
    *("nr.bler_target", "nr.link_adaptation", "nr.cqi_age_slots", "nr.harq_rounds"),
    *("nr.harq_rtt_slots", "nr.grants", "nr.grants_per_slot"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SharingLaw:
    """Describes a way for devices to share a band.

    Attributes:
        name: as in ``--law``.
        help: how they share it, in a few words.
        uses: settings and inputs of ``scale`` that mean nothing under laws that do not list them,
            as ``"radio.noise"`` and ``"remeasure"``.
        snr_label: names the SNR on the axis of a figure.
    """

    name: str
    help: str
    uses: tuple[str, ...] = ()
    snr_label: str = "Target SNR (dB)"

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, str, "help", "snr_label")
        check_members(self, tuple, "uses")
