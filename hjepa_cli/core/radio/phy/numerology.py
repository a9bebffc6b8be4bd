"""Subcarrier spacings, carriers, duplexing and processing times are those that the standard lists.

Frequency range 1: TS 38.101-1, Table 5.3.2-1; TS 38.211, clause 4.3; TS 38.214, Table 6.4-1.
"""

import dataclasses

from hjepa_cli.core.radio.phy.transport_block import SLOT_SYMBOLS, SUBCARRIERS
from hjepa_cli.errors import UsageError

# PRBs of a carrier by subcarrier spacing [kHz] and channel bandwidth [MHz].
CARRIER_PRBS = {
    15: {5: 25, 10: 52, 15: 79, 20: 106, 25: 133, 30: 160, 35: 188, 40: 216, 45: 242, 50: 270},
    30: {
        5: 11, 10: 24, 15: 38, 20: 51, 25: 65, 30: 78, 35: 92, 40: 106, 45: 119, 50: 133, 60: 162,
        70: 189, 80: 217, 90: 245, 100: 273,
    },
    60: {
        10: 11, 15: 18, 20: 24, 25: 31, 30: 38, 35: 44, 40: 51, 45: 58, 50: 65, 60: 79, 70: 93,
        80: 107, 90: 121, 100: 135,
    },
}  # fmt: skip
# Symbols in which a device prepares a PUSCH, N2 of processing capability 1.
PREPARATION_SYMBOLS = {15: 10, 30: 12, 60: 23}
LONGEST_PATTERN = 40  # slots


@dataclasses.dataclass(frozen=True)
class Carrier:
    """Has a spacing, a bandwidth, and slots for the uplink.

    Attributes:
        spacing_khz: of subcarriers.
        bandwidth_hz: of the channel.
        duplex: ``FDD``, or a TDD pattern of slots: D downlink, U uplink, S special (guard, no
            data here).

    Raises:
        UsageError: a bandwidth that the standard does not list with this spacing, or a pattern
            that is none or has no uplink.
    """

    spacing_khz: int
    bandwidth_hz: float
    duplex: str = "FDD"

    def __post_init__(self) -> None:
        if self.spacing_khz not in CARRIER_PRBS:
            spacings = ", ".join(map(str, CARRIER_PRBS))
            raise UsageError(f"--scs {self.spacing_khz}: choose a spacing of {spacings} kHz")
        listed = CARRIER_PRBS[self.spacing_khz]
        if self.bandwidth_hz / 1e6 not in listed:
            raise UsageError(
                f"--bandwidth-mhz {self.bandwidth_hz / 1e6:g}: at {self.spacing_khz} kHz TS "
                f"38.101-1 lists {', '.join(map(str, listed))}"
            )
        if self.duplex != "FDD":
            if set(self.duplex) - set("DSU") or not 1 <= len(self.duplex) <= LONGEST_PATTERN:
                raise UsageError(
                    f"--duplex {self.duplex[:50]!r}: choose FDD, or a TDD pattern of at most "
                    f"{LONGEST_PATTERN} slots D, S and U, as DDDSU"
                )
            if "U" not in self.duplex:
                raise UsageError(
                    f"--duplex {self.duplex}: a pattern without uplink (U) carries no packet; "
                    "choose FDD or one like DDDSU"
                )

    @property
    def prbs(self) -> int:
        """Return how many PRBs there are."""
        return CARRIER_PRBS[self.spacing_khz][round(self.bandwidth_hz / 1e6)]

    @property
    def prb_hz(self) -> float:
        """Return the width of one PRB."""
        return SUBCARRIERS * self.spacing_khz * 1e3

    @property
    def slot_s(self) -> float:
        """Return how long one slot of 14 symbols lasts: 1 ms at 15 kHz."""
        return 15e-3 / self.spacing_khz

    @property
    def uplink_share(self) -> float:
        """Return the share of slots that are the uplink's."""
        return 1.0 if self.duplex == "FDD" else self.duplex.count("U") / len(self.duplex)

    def seconds(self, symbols: float) -> float:
        """Return how long some symbols last, cyclic prefixes included."""
        return symbols / SLOT_SYMBOLS * self.slot_s

    @property
    def processing_s(self) -> float:
        """Return how long a device takes before a PUSCH, and as long the base station after it.

        Half of N2 each, as evaluations of the user plane's latency have it (TR 37.910).
        """
        return self.seconds(PREPARATION_SYMBOLS[self.spacing_khz] / 2)
