"""TS-JEPA's Lyapunov scheduler weighs age and its virtual queue against transmit power."""

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.radio.schedulers.scheduler import Scheduler, SlotView
from hjepa_cli.core.style import Style

POWER_WEIGHT = 1000.0  # V, ours: the paper gives none. At the power limit it offsets ages up to 31


def score(view: SlotView) -> Floats:
    """Return −C = (A + 1)² − 1 + 2 Q A − V p (TS-JEPA, Algorithm 2); p = 1 is the power limit."""
    age = view.age.astype(np.float64)
    value = (age + 1.0) ** 2 - 1.0 + 2.0 * view.queue * age
    value = value - POWER_WEIGHT * np.minimum(view.power, 1.0)
    return np.where(view.able, value, 0.0)


LYAPUNOV = Scheduler("drift-plus-penalty", score, style=Style("#CC79A7", "v", "--", hollow=True))
