"""Round robin takes everybody in turn, blind to the channel; a blocked device loses its turn."""

import numpy as np

from hjepa_cli.core.radio.schedulers.scheduler import Scheduler
from hjepa_cli.core.style import Style

ROUND_ROBIN = Scheduler(
    "round-robin",
    lambda view: view.waited.astype(np.float64),
    in_turn=True,
    style=Style("#7F7F7F", "s", ":", hollow=True),
)
