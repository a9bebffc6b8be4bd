"""Whittle's index of the measured growth of the control error with age (value of information)."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View


def score(view: View) -> NDArray[np.float64]:
    """A f(A + 1) − Σ_{j ≤ A} f(j) for devices that can send now (they then succeed for certain).

    Where a device's own uncertainty is known, its f is that much larger at every age.
    """
    return np.where(view.able, view.growth.index(view.age) * view.doubt, 0.0)
