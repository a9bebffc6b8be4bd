"""One control loop requires a link: laws read the tolerances of ``eval`` so."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from hjepa_cli.config.checks import split_late


@dataclasses.dataclass(frozen=True)
class Axis:
    """Names a property of the link that is made worse until the score is just acceptable.

    Attributes:
        key: of the tolerance in ``eval --json``; ``prefix`` is that of what is said about it.
        point: key of a measured point; ``kind`` is what such points are of.
        label, point_label, digits: in tables.
        fails_at: the tolerance of loops that fail with a packet in every slot.
    """

    key: str
    prefix: str
    point: str
    kind: str
    label: str
    point_label: str
    digits: int
    fails_at: float

    @property
    def larger_is_worse(self) -> bool:
        """Tell whether larger values are the worse link, and a larger tolerance the better loop."""
        return self.fails_at == 0.0

    def packets_per_slot(self, tolerance: float) -> float:
        """Return how many packets of a loop arrive at its tolerance: 1/D* or p*."""
        return 1 / tolerance if self.larger_is_worse else tolerance

    @property
    def bound(self) -> str:
        """Return the sign before a tolerance that was not measured further."""
        return "≥" if self.larger_is_worse else "≤"


GAP = Axis(
    *("tolerance_gap_steps", "tolerance_gap", "d", "gap", "gap D* [steps]", "gap [steps]"),
    digits=1,
    fails_at=0.0,
)
DELIVERY = Axis(
    *("tolerance_p", "tolerance_p", "p", "delivery", "delivery p*", "p"),
    digits=4,
    fails_at=1.0,
)


@dataclasses.dataclass(frozen=True)
class LinkRequirement:
    """Holds the worst link on which a loop of a method stays at the acceptable score.

    Attributes:
        method: its name, without how late it is.
        tolerance: on an :class:`Axis`; ``None`` for a method without a link.
        interval: its 95 % interval, ordered so that device counts ascend.
        at_least: the score was still acceptable where the measured range ends; there may be more.
        payload_bits: b.
        delay_steps: how late its packets were when the tolerance was measured.
        warmup_steps, scored_steps: of the loops that the tolerance was measured on.
    """

    method: str
    tolerance: float | None
    interval: tuple[float, float] | None
    at_least: bool
    payload_bits: int | None
    delay_steps: int
    warmup_steps: int
    scored_steps: int

    @classmethod
    def measured(cls, axis: Axis, method: str, entry: Mapping[str, Any]) -> "LinkRequirement":
        """Read the entry of ``eval --json`` of a method, on time or late."""
        name, delay_steps = split_late(method)
        ends = sorted(entry[f"{axis.prefix}_ci95"] or (), reverse=not axis.larger_is_worse)
        return cls(
            method=name,
            tolerance=entry[axis.key],
            interval=(ends[0], ends[1]) if ends else None,
            at_least=bool(entry[f"{axis.prefix}_censored"]),
            payload_bits=entry["bits_per_transmission"],
            delay_steps=delay_steps,
            warmup_steps=entry["warmup_steps"],
            scored_steps=entry["scored_steps"],
        )
