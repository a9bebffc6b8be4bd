"""This scheduler takes the largest age of information among the devices that can send now."""

import numpy as np

from hjepa_cli.core.radio.schedulers.scheduler import Scheduler
from hjepa_cli.core.style import Style

MAX_AOI = Scheduler(
    "max-aoi",
    lambda view: np.where(view.able, view.age.astype(np.float64), 0.0),
    style=Style("#009E73", "^", "-."),
)
