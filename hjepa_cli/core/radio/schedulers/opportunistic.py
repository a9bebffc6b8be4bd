"""The opportunistic scheduler takes whoever has the best channel, blind to the loops."""

import numpy as np

from hjepa_cli.core.radio.schedulers.scheduler import Scheduler
from hjepa_cli.core.style import DASH_DOT_DOT, Style

OPPORTUNISTIC = Scheduler(
    "opportunistic",
    lambda view: np.where(view.able, view.gain, 0.0),
    style=Style("#E69F00", "D", DASH_DOT_DOT, hollow=True),
)
