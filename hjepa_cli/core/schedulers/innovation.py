"""Innovation-triggered: devices say when the controller's prediction has gone wrong, and how far.

A device that runs no predictor still knows what force the controller plays, from the downlink. It
compares it with the force that its actor wants and reports the difference, a few bits, when it is
beyond δ. e² in the force is the cost of an estimation error in linear quadratic control, up to a
constant.
"""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.schedulers.view import View

UNTOLD = 1e-6  # of what devices without a report may err by: they come after all that have one


def score(view: View) -> NDArray[np.float64]:
    """The reported e², and a little for what the others may have come to by now."""
    untold = UNTOLD * view.growth.at(view.age) * view.doubt
    return np.where(view.able, view.reported**2 + untold, 0.0)
