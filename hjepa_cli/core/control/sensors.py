"""Sensors of devices see their state, what their camera sees, or embeddings of that."""

from collections.abc import Callable
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.control.spoilt import spoilt
from hjepa_cli.core.plants.frames import Camera, frames_back, frames_of

if TYPE_CHECKING:
    from hjepa_cli.core.networks.model import Gaze, Model

SENSOR_BATCH = 256  # inputs rendered and encoded at a time: 24 MiB of four frames


def is_pixels(seen: Floats | Pixels) -> TypeGuard[Pixels]:
    """Tell whether recorded frames came in place of states."""
    return seen.dtype == np.uint8


def true_state(seen: Floats) -> Floats:
    """Return the state itself, exact: of the last states [m, 16, S] the present ones [m, S]."""
    return seen[:, -1]


def camera_sensor(
    model: "Model", camera: Camera | None = None
) -> Callable[[Floats | Pixels], Pixels]:
    """Return a function from the last states [m, 16, S] to frames uint8 [m, κ, H, W, C].

    κ are as many as the model's network sees, taken by the camera that the model was trained with
    if none is given. What was recorded comes as frames uint8 [m, 16, H, W, C] in place of states.
    """
    camera, back = camera or model.camera, frames_back(model.look)

    def look(seen: Floats | Pixels) -> Pixels:
        last = seen[:, back]
        if not is_pixels(last):
            return frames_of(camera, last, SENSOR_BATCH)
        return retaken(camera, last)

    return look


def retaken(camera: Camera, frames: Pixels) -> Pixels:
    """Return recorded frames [m, κ, H, W, C] under a camera's conditions; as they are without."""
    retake: Callable[[Pixels], Pixels] | None = getattr(camera, "retake", None)
    if retake is None or not len(frames):
        return frames
    starts = range(0, len(frames), SENSOR_BATCH)
    return np.concatenate([retake(frames[start : start + SENSOR_BATCH]) for start in starts])


def embedding_sensor(
    model: "Model", send: Callable[[Tensor], Tensor] | None = None, camera: Camera | None = None
) -> Callable[[Floats | Pixels], Tensor]:
    """Return a function from the last states [m, 16, S], or frames, to received embeddings [m, D].

    They are as ``send`` makes them arrive, [n, D] → [n, D]; without it those that the device has.
    """
    eyes = Eyes(model, camera)

    def sense(seen: Floats | Pixels) -> Tensor:
        received = []
        for start in range(0, len(seen), SENSOR_BATCH):
            z = eyes.encode(seen[start : start + SENSOR_BATCH])
            received.append(send(z) if send else z)
        return torch.cat(received).to(model.device)

    return sense


def checking_sensor(
    model: "Model", send: Callable[[Tensor], Tensor], camera: Camera, most: float
) -> Callable[[Floats | Pixels], Tensor]:
    """Return an :func:`embedding_sensor` of devices that look at their pictures first.

    Of those that are :func:`~hjepa_cli.core.control.spoilt.spoilt` NaN arrives: that there was a
    packet, and nothing in it.
    """
    look = camera_sensor(model, camera)

    def sense(seen: Floats | Pixels) -> Tensor:
        received = []
        for start in range(0, len(seen), SENSOR_BATCH):
            frames = look(seen[start : start + SENSOR_BATCH])
            z = send(model.encode(frames))
            received.append(z.where(~torch.from_numpy(spoilt(frames, most))[:, None], torch.nan))
        return torch.cat(received).to(model.device)

    return sense


class Eyes:
    """They encode what devices see: the same, up to rounding, sooner where all send at every step.

    Then all pictures but one were there a step ago. A camera that has ``film`` takes those of a
    packet together, and all anew.
    """

    def __init__(self, model: "Model", camera: Camera | None = None) -> None:
        self._model, self._camera = model, camera or model.camera
        self._look, self._longest = camera_sensor(model, camera), model.look[0] + 1
        self._films = hasattr(self._camera, "film")
        self._states: Floats | Pixels = np.zeros((0, 0, 0))
        self._gaze: Gaze | None = None

    def encode(self, seen: Floats | Pixels) -> Tensor:
        """Return the embeddings [m, D] of the last states [m, 16, S] or frames."""
        if is_pixels(seen) or self._films:
            return self._model.encode(self._look(seen))
        states = seen[:, -self._longest :]
        again = np.array_equal(states[:, :-1], self._states[:, 1:])
        self._states = states
        if not again or "decoder" in self._model.networks:
            self._gaze = None
            return self._model.encode(self._look(seen))
        if self._gaze is None:
            self._gaze = self._model.gaze(frames_of(self._camera, states, SENSOR_BATCH))
        else:
            self._gaze.go_on(frames_of(self._camera, states[:, -1:], SENSOR_BATCH))
        return self._gaze.embeddings()
