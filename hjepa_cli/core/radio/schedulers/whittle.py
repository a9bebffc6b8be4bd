"""Whittle's index values information by the measured growth of the control error with age."""

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.radio.schedulers.scheduler import Scheduler, SlotView
from hjepa_cli.core.style import Style


def score(view: SlotView) -> Floats:
    """Return A f(A + 1) − Σ_{j ≤ A} f(j) of devices that can send now, and so surely succeed.

    Where a device's own uncertainty is known, its f is that much larger at every age.
    """
    return np.where(view.able, view.growth.index(view.age) * view.uncertainty, 0.0)


WHITTLE = Scheduler("whittle", score, style=Style("#D55E00", "s", "--"))
