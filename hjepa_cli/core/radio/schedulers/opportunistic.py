"""Opportunistic: whoever has the best channel, blind to what the loops need."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View


def score(view: View) -> NDArray[np.float64]:
    """The power gain |H|²."""
    return np.where(view.able, view.gain, 0.0)
