"""What a controller plays that nobody interrupts."""

from typing import Any

import numpy as np

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.loop import Controller


def play(
    controller: Controller, packets: Any, devices: int, steps: int, *, delay_steps: int = 0
) -> Floats:
    """Return the forces [devices, steps, *A] after a single packet, sent at k = 0."""
    arrives = np.ones(devices, dtype=bool)
    forces = [
        controller.act(*((arrives, packets) if k == delay_steps else (~arrives, None)))
        for k in range(steps)
    ]
    return np.stack(forces, axis=1)
