"""What a base station knows at the start of a slot, before it hands out the resource blocks."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.error_growth import Growth


@dataclasses.dataclass(frozen=True)
class View:
    """One slot; arrays over devices [N].

    Attributes:
        age: A, slots since the newest sample at the controller was taken, ≥ 1.
        waited: slots since the device's last turn, whether anything arrived or not, ≥ 1.
        gain: |H|² now.
        power: transmit power that the target SNR takes now ÷ the power limit.
        queue: Q, virtual queue of ages beyond the target (drift-plus-penalty).
        reported: last reported innovation since the newest sample, 0 without a report.
        growth: how the control error grows with age, of each device's controller.
        doubt: what a device's own uncertainty is of f at its age; 1 where only the age is known.
    """

    age: NDArray[np.int64]
    waited: NDArray[np.int64]
    gain: Floats
    power: Floats
    queue: Floats
    reported: Floats
    growth: Growth
    doubt: Floats

    @property
    def able(self) -> NDArray[np.bool_]:
        """Whose link holds the target SNR within the power limit."""
        return self.power <= 1.0
