"""Innovation-triggered: devices say when the controller's prediction has gone wrong, and how far.

A device that runs no predictor still knows what force the controller plays, from the downlink. It
compares it with the force that its actor wants and reports the difference, a few bits, when it is
beyond δ. e² in the force is the cost of an estimation error in linear quadratic control, up to a
constant.
"""

import numpy as np
from numpy.typing import NDArray

from hjepa_cli.core.radio.schedulers.view import View

UNTOLD = 1e-6  # of what devices without a report may err by: they come after all that have one


def score(view: View) -> NDArray[np.float64]:
    """The reported e²; a little for what devices without a report have come to.

    What has become of an error since its report is not guessed: one that has doubled is reported
    again, and one that has waited long is often of a loop that is out of its band anyway.
    """
    value = view.reported**2 + UNTOLD * view.growth.at(view.age) * view.doubt
    return np.where(view.able, value, 0.0)
