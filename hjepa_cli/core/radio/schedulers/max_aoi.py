"""Largest age of information among the devices that can send now."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View


def score(view: View) -> NDArray[np.float64]:
    """The age A."""
    return np.where(view.able, view.age.astype(np.float64), 0.0)
