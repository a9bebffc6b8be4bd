"""The law ``duty``: devices send by turns, and power control holds every link at γ̄.

A slot carries c packets one after the other, and a loop that needs one packet every D* slots uses
1/c of a slot each time: N = ⌊D* c⌋.
"""

import numpy as np
import numpy.typing as npt

from hjepa_cli.core.arrays import Integers
from hjepa_cli.core.control.loop import packets_per_step
from hjepa_cli.core.radio.capacity import whole_devices
from hjepa_cli.core.radio.cell import Link
from hjepa_cli.core.radio.channel import positive
from hjepa_cli.core.radio.laws.closed_form import ClosedFormLaw
from hjepa_cli.core.radio.laws.requirement import GAP, LinkRequirement
from hjepa_cli.errors import UsageError


def duty_devices(tolerance_gap_steps: npt.ArrayLike, packets_per_slot: npt.ArrayLike) -> Integers:
    """Return N = ⌊D* c⌋.

    Args:
        tolerance_gap_steps: D* ≥ 0 (real), the longest gap between packets that the loop survives.
        packets_per_slot: c, from :func:`~hjepa_cli.core.radio.capacity.slot_capacity`.

    Raises:
        UsageError: a gap or a c that is impossible.
    """
    gap = np.asarray(tolerance_gap_steps, np.float64)
    if not np.all((gap >= 0) & np.isfinite(gap)):
        raise UsageError(f"gap tolerance {tolerance_gap_steps!r} must be finite and not negative")
    return whole_devices(gap * positive("packets per slot", packets_per_slot))


def _period_slots(gap_steps: float, loop: LinkRequirement, link: Link) -> float:
    """Return the mean slots between the packets of a loop that tolerates gaps that long."""
    if not loop.delay_steps:  # else the tolerance was measured with packets that late
        # A packet that is late on arrival has used up that much of the gap it could bridge.
        gap_steps = max(gap_steps - link.carried.late_slots, 0.0)
    if gap_steps < 1:
        return gap_steps
    return float(1 / packets_per_step(gap_steps, loop.scored_steps, loop.warmup_steps))


def _devices(gap_steps: float, loop: LinkRequirement, link: Link) -> int:
    if link.packets_per_slot == 0:
        return 0
    return int(duty_devices(_period_slots(gap_steps, loop, link), link.packets_per_slot))


def _why_nobody(gap_steps: float, loop: LinkRequirement, link: Link) -> str:
    return f"{link.carried.described} and serves for {gap_steps:.3g}"


DUTY = ClosedFormLaw(
    name="duty",
    help="by turns at controlled power",
    axis=GAP,
    devices=_devices,
    packets_per_slot=lambda *at: 1 / _period_slots(*at),
    why_nobody=_why_nobody,
    delay_slots=lambda link: link.carried.late_slots,
)
