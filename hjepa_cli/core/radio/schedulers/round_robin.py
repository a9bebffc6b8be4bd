"""Round robin: everybody in turn, blind to the channel; a blocked device loses its turn."""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View


def score(view: View) -> NDArray[np.float64]:
    """Slots since the last turn."""
    return view.waited.astype(np.float64)
