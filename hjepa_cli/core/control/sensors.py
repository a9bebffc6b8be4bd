"""What devices send: their state, what their camera saw, or embeddings of it."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.codecs import Codec
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import Camera

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Model

SENSOR_BATCH = 256  # inputs of two frames rendered and encoded at a time: 12 MiB


def true_state(seen: Floats) -> Floats:
    """The state itself, exact: of the last states [m, 4, S] the present ones [m, S]."""
    return seen[:, -1]


def camera_sensor(
    model: "Model", camera: Camera | None = None
) -> Callable[[Floats], NDArray[np.uint8]]:
    """The last κ frames, as many as the model's network looks at.

    Args:
        model: whose network that is.
        camera: what takes them; the one that the model was trained with by default.
    """
    camera = camera or plant(model.plant_name).camera()

    def look(seen: Floats) -> NDArray[np.uint8]:
        """The last states [m, 4, S] → frames uint8 [m, κ, 64, 128, 3]."""
        parts = []
        for start in range(0, len(seen), SENSOR_BATCH):
            part = seen[start : start + SENSOR_BATCH, -model.frames :]
            frames = camera.render(part.reshape(-1, part.shape[2]))
            parts.append(frames.reshape(*part.shape[:2], *frames.shape[1:]))
        return np.concatenate(parts)

    return look


def embedding_sensor(
    model: "Model", codec: Codec | None, camera: Camera | None = None
) -> Callable[[Floats], Tensor]:
    """Embeddings of the last frames, through the codec; without one, as the device has them."""
    look = camera_sensor(model, camera)

    def sense(seen: Floats) -> Tensor:
        """The last states [m, 4, S] → received embeddings [m, D]."""
        received = []
        for start in range(0, len(seen), SENSOR_BATCH):
            z = model.encode(look(seen[start : start + SENSOR_BATCH]))
            received.append(z if codec is None else codec.send(z))
        return torch.cat(received).to(model.device)

    return sense
