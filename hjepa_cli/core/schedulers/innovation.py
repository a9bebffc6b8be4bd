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
    """The reported e², grown since; a little for what devices without a report have come to."""
    now = view.growth.at(view.age)
    grown = now / view.growth.at(np.maximum(view.reported_age, 1))
    value = view.reported**2 * grown + UNTOLD * now * view.doubt
    return np.where(view.able, value, 0.0)
