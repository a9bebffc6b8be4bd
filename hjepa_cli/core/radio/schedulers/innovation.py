"""Devices report innovations: when the controller's prediction has gone wrong, and how far.

A device that runs no predictor still knows what force the controller plays, from the downlink. It
compares it with the force that its actor wants and reports the difference, a few bits, when it is
beyond δ. e² in the force is the cost of an estimation error in linear quadratic control, up to a
constant.
"""

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.radio.schedulers.scheduler import Scheduler, SlotView
from hjepa_cli.core.style import Style

UNREPORTED = 1e-6  # of what devices without a report may err by: they come after all that have one


def score(view: SlotView) -> Floats:
    """Return the reported e²; a little of the expected error for devices without a report.

    What has become of an error since its report is not guessed: one that has doubled is reported
    again, and one that has waited long is often of a loop that is out of its band anyway.
    """
    value = view.reported**2 + UNREPORTED * view.growth.at(view.age) * view.uncertainty
    return np.where(view.able, value, 0.0)


INNOVATION = Scheduler("innovation", score, wants_reports=True, style=Style("#0072B2", "o"))
