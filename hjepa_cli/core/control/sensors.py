"""Sensors of devices see their state, what their camera sees, or embeddings of that."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.plants.frames import frames_back, frames_of
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import Camera

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

SENSOR_BATCH = 256  # inputs of two frames rendered and encoded at a time: 12 MiB


def true_state(seen: Floats) -> Floats:
    """Return the state itself, exact: of the last states [m, 16, S] the present ones [m, S]."""
    return seen[:, -1]


def camera_sensor(
    model: "Model", camera: Camera | None = None
) -> Callable[[Floats], NDArray[np.uint8]]:
    """Return a function from the last states [m, 16, S] to frames uint8 [m, κ, 64, 128, 3].

    κ are as many as the model's network sees, taken by the camera that the model was trained with
    if none is given.
    """
    camera, back = camera or plant(model.plant_name).camera(), frames_back(*model.look)
    return lambda seen: frames_of(camera, seen[:, back], SENSOR_BATCH)


def embedding_sensor(
    model: "Model", send: Callable[[Tensor], Tensor] | None = None, camera: Camera | None = None
) -> Callable[[Floats], Tensor]:
    """Return a function from the last states [m, 16, S] to received embeddings [m, D].

    They are as ``send`` makes them arrive, [n, D] → [n, D]; without it those that the device has.
    """
    look = camera_sensor(model, camera)

    def sense(seen: Floats) -> Tensor:
        received = []
        for start in range(0, len(seen), SENSOR_BATCH):
            z = model.encode(look(seen[start : start + SENSOR_BATCH]))
            received.append(send(z) if send else z)
        return torch.cat(received).to(model.device)

    return sense
