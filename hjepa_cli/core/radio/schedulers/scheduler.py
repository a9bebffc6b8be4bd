"""A scheduler is one object in a file of its own, from which everything about it follows.

It scores what the base station knows at the start of a slot; the J highest scores above 0 win the J
resource blocks.
"""

import dataclasses
from collections.abc import Callable

import numpy as np

from hjepa_cli.core.arrays import Bools, Floats, Integers
from hjepa_cli.core.control.error_growth import ErrorGrowthTable
from hjepa_cli.core.style import PLAIN, Style
from hjepa_cli.plugins import check_members


@dataclasses.dataclass(frozen=True)
class SlotView:
    """Holds one slot, in arrays over devices [N].

    Attributes:
        age: A, slots since the newest sample at the controller was taken, ≥ 1.
        waited: slots since the device's last turn, whether anything arrived or not, ≥ 1.
        gain: |H|² now.
        power: transmit power that the target SNR takes now ÷ the power limit.
        queue: Q, virtual queue of ages beyond the target (drift-plus-penalty).
        reported: last reported innovation since the newest sample, 0 without a report.
        growth: how the control error grows with age, of each device's controller.
        uncertainty: factor on f(A) by which a device's own f differs; 1 where its age alone is
            known.
    """

    age: Integers
    waited: Integers
    gain: Floats
    power: Floats
    queue: Floats
    reported: Floats
    growth: ErrorGrowthTable
    uncertainty: Floats

    @property
    def able(self) -> Bools:
        """Tell whose links hold the target SNR within the power limit."""
        return self.power <= 1.0


@dataclasses.dataclass(frozen=True)
class Scheduler:
    """Ranks the devices of a cell in every slot.

    Attributes:
        name: as in ``--scheduler``.
        score: a slot → scores [N]; a device whose score is not above 0 gets no block.
        wants_reports: devices compare the controller's force with their own and report.
        in_turn: the order is always the same, so that it can be agreed in advance.
        style: its line in figures.
    """

    name: str
    score: Callable[[SlotView], Floats]
    wants_reports: bool = False
    in_turn: bool = False
    style: Style = PLAIN

    def __post_init__(self) -> None:
        """Raise UsageError for members that are of another kind."""
        check_members(self, callable, "score")
        check_members(self, bool, "wants_reports")
        check_members(self, Style, "style")


def pick(scores: Floats, blocks: int) -> Bools:
    """Return the winners [N], at most ``blocks`` of them; ties go to the lower device number."""
    best = np.argsort(-scores, kind="stable")[:blocks]
    chosen = np.zeros(len(scores), dtype=bool)
    chosen[best] = scores[best] > 0
    return chosen
