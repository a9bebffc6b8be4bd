"""Some laws count devices by a formula, from what one loop tolerates.

The rows, those of ``scale --json``, put the count beside the bits that control needs in theory.
"""

import dataclasses
import math
from collections.abc import Callable
from numbers import Integral, Real
from typing import Any

from hjepa_cli.core.plants.guarded import guarded
from hjepa_cli.core.radio.cell import Cell, Link
from hjepa_cli.core.radio.laws.law import HELD_LINKS, Row, SharingLaw
from hjepa_cli.core.radio.laws.requirement import Axis, LinkRequirement
from hjepa_cli.plugins import LAWS, check_members


def _too_crowded(tolerance: float, loop: LinkRequirement, link: Link) -> str:
    return f"{link.carried.described}; one device alone does not fit"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClosedFormLaw(SharingLaw):
    """Counts by formulas of a tolerance, the loop that it was measured on and the link.

    Attributes:
        uses: as of :class:`SharingLaw`. Without :data:`HELD_LINKS` links fade around γ̄, and rows
            do not say what a packet is sent on at γ̄.
        axis: of the tolerance that it reads.
        devices: how many share the cell when each tolerates as much.
        packets_per_slot: how many of a device's packets then arrive; by default 1/D* or p*.
        why_nobody: says why there are none where a loop does not fail with every packet.
        delay_slots: how late the packets are that a method must be measured with.
    """

    uses: tuple[str, ...] = ("remeasure", "dataset", *HELD_LINKS)
    axis: Axis
    devices: Callable[[float, LinkRequirement, Link], int]
    packets_per_slot: Callable[[float, LinkRequirement, Link], float] | None = None
    why_nobody: Callable[[float, LinkRequirement, Link], str] = _too_crowded
    delay_slots: Callable[[Link], float] = lambda link: 0.0

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        super().__post_init__()
        check_members(self, Axis, "axis")
        check_members(self, callable, "devices", "why_nobody", "delay_slots")
        check_members(self, callable, "packets_per_slot", optional=True)

    def asked(self, member: str, *at: Any) -> Any:
        """Return what a function of the law says; raise UsageError where it may not say that."""
        value = guarded(LAWS, self.name, getattr(self, member))(*at)
        if member == "why_nobody":
            fits, wanted = isinstance(value, str), "text"
        else:
            whole = member == "devices"
            fits = isinstance(value, Integral if whole else Real) and 0 <= float(value) < math.inf
            wanted = f"a {'whole' if whole else 'finite'} number of at least 0"
        if not fits:
            says = f"law '{self.name}': {member}(…) = {value!r}; expected {wanted}"
            raise LAWS.fault(self.name, says)
        return value

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
        row["devices"] = self.asked("devices", *at)
        if loop.interval is not None:
            row["devices_ci95"] = [self.asked("devices", end, loop, link) for end in loop.interval]
        if set(HELD_LINKS) <= set(self.uses):
            row |= link.carried.details
            if link.packets_per_slot == 0:
                return row | {"reason": link.carried.described}
        if link.packets_per_slot:
            row["load_per_block"] = row["devices"] / link.packets_per_slot
        if row["devices"] == 0:
            # The range of a method ends at its best link, too, if it was measured nowhere else.
            fails = loop.tolerance == self.axis.fails_at and not loop.at_least
            failure = "below the acceptable score even with a packet in every slot"
            return row | {"reason": failure if fails else self.asked("why_nobody", *at)}
        given = self.packets_per_slot
        arriving = (
            self.asked("packets_per_slot", *at)
            if given
            else self.axis.packets_per_slot(loop.tolerance)
        )
        row["bits_per_s"] = loop.payload_bits * arriving / cell.slot_s
        if cell.limit_bits_per_s > 0:
            row["ratio_to_limit"] = row["bits_per_s"] / cell.limit_bits_per_s
        return row
