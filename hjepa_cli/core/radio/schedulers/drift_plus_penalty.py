"""TS-JEPA's Lyapunov scheduler: age and its virtual queue against transmit power."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View

POWER_WEIGHT = 1000.0  # V, ours: the paper gives none. At the power limit it offsets ages up to 31


def score(view: View) -> NDArray[np.float64]:
    """−C = (A + 1)² − 1 + 2 Q A − V p (TS-JEPA, Algorithm 2); p = 1 is the power limit."""
    age = view.age.astype(np.float64)
    value = (age + 1.0) ** 2 - 1.0 + 2.0 * view.queue * age
    value = value - POWER_WEIGHT * np.minimum(view.power, 1.0)
    return np.where(view.able, value, 0.0)
