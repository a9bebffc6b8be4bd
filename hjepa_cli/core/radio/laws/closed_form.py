"""Some laws count devices by a formula, from what one loop tolerates.

The rows, those of ``scale --json``, put the count beside the bits that control needs in theory.
"""

import dataclasses
from collections.abc import Callable

from hjepa_cli.core.radio.cell import Cell, Link
from hjepa_cli.core.radio.laws.law import Row, SharingLaw
from hjepa_cli.core.radio.laws.requirement import Axis, LinkRequirement


def _too_crowded(tolerance: float, loop: LinkRequirement, link: Link) -> str:
    return f"{link.carried.described}; one device alone does not fit"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClosedFormLaw(SharingLaw):
    """Counts by formulas of a tolerance, the loop that it was measured on and the link.

    Attributes:
        axis: of the tolerance that it reads.
        devices: how many share the cell when each tolerates as much.
        packets_per_slot: how many of a device's packets then arrive; by default 1/D* or p*.
        why_nobody: says why there are none where a loop does not fail with every packet.
        delay_slots: how late the packets are that a method must be measured with.
    """

    uses: tuple[str, ...] = ("remeasure", "dataset")
    axis: Axis
    devices: Callable[[float, LinkRequirement, Link], int]
    packets_per_slot: Callable[[float, LinkRequirement, Link], float] | None = None
    why_nobody: Callable[[float, LinkRequirement, Link], str] = _too_crowded
    delay_slots: Callable[[Link], float] = lambda link: 0.0

    def row(self, loop: LinkRequirement, cell: Cell, snr_db: float) -> Row:
        """Count one method's devices at one SNR; where there are none, give the reason.

        A block is what one packet takes at γ̄; ``load_per_block`` is devices ÷ blocks of a slot.
        """
        row: Row = {
            "snr_db": snr_db,
            "method": loop.method,
            "devices": None,
            "devices_ci95": None,
            "at_least": loop.at_least,
            "load_per_block": None,
            "bits_per_s": None,
            "ratio_to_limit": None,
            "bits_per_transmission": loop.payload_bits,
            "tolerance": loop.tolerance,
            "tolerance_ci95": None if loop.interval is None else sorted(loop.interval),
            "delay_steps": loop.delay_steps,
            "reason": None,
        }
        if loop.tolerance is None or loop.payload_bits is None:
            return row | {"reason": "sees every state, whatever the link does"}
        if loop.payload_bits == 0:
            return row | {"reason": "sends nothing: as many as there are, without this cell"}
        at = loop.tolerance, loop, (link := cell.link(loop.payload_bits, snr_db))
        ends = loop.interval or (loop.tolerance, loop.tolerance)
        row["devices"] = self.devices(*at)
        row["devices_ci95"] = [self.devices(end, loop, link) for end in ends]
        row |= link.carried.details
        if link.packets_per_slot == 0:
            return row | {"reason": link.carried.described}
        row["load_per_block"] = row["devices"] / link.packets_per_slot
        if row["devices"] == 0:
            # The range of a method ends at its best link, too, if it was measured nowhere else.
            fails = loop.tolerance == self.axis.fails_at and not loop.at_least
            failure = "below the acceptable score even with a packet in every slot"
            return row | {"reason": failure if fails else self.why_nobody(*at)}
        given = self.packets_per_slot
        arriving = given(*at) if given else self.axis.packets_per_slot(loop.tolerance)
        row["bits_per_s"] = loop.payload_bits * arriving / cell.slot_s
        if cell.limit_bits_per_s > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / cell.limit_bits_per_s
        return row
