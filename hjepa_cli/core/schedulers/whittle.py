"""Whittle's index of the measured growth of the control error with age (value of information)."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.schedulers.view import View


def score(view: View) -> NDArray[np.float64]:
    """A f(A + 1) − Σ_{j ≤ A} f(j) for devices that can send now (they then succeed for certain)."""
    return np.where(view.able, view.growth.index(view.age), 0.0)
