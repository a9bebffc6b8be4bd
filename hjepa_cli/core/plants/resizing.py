"""Pictures are resized by area: a new pixel is the mean of the old picture inside its square.

So a motion of a hundredth of a pixel still changes what comes out, as it does in the camera.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.core.arrays import Floats, Pixels
from hjepa_cli.core.plants.frames import Camera

LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


class Resized:
    """A camera's pictures have another size, and are grey if that has one channel.

    Args:
        camera: takes RGB pictures.
        frame_shape: (H, W, C) of what comes out.
    """

    def __init__(self, camera: Camera, frame_shape: tuple[int, int, int]) -> None:
        self._camera, self.frame_shape = camera, frame_shape

    def render(self, states: ArrayLike) -> Pixels:
        """Return frames ``[n, H, W, C]`` of states ``[n, S]``."""
        return fitted(self._camera.render(states), self.frame_shape)

    def manifest(self) -> dict[str, Any]:
        """Return the camera's manifest with the size."""
        return self._camera.manifest() | {"frame_shape": list(self.frame_shape)}

    def sketch_px(self, state: ArrayLike) -> list[Floats]:
        """Return the camera's sketch, in its own pixels."""
        return self._camera.sketch_px(state)


def fitted(frames: Pixels, frame_shape: tuple[int, int, int]) -> Pixels:
    """Return frames uint8 [n, h, w, c] in size (H, W) and with C channels, [n, H, W, C].

    Grey ones are repeated for three channels; of three, one is made by their luma (BT.601). Those
    that fit already come back as they are.
    """
    height, width, channels = frame_shape
    if frames.shape[1:] == frame_shape:
        return frames
    values: NDArray[Any] = frames
    if frames.shape[-1] > channels:
        values = (frames.astype(np.float32) @ LUMA)[..., None]
    values = area_means(area_means(values, 1, height), 2, width)
    if values.dtype != np.uint8:
        values = np.rint(values).clip(0, 255).astype(np.uint8)
    return np.broadcast_to(values, (*values.shape[:-1], channels)).copy()


def area_means(values: NDArray[Any], axis: int, size: int) -> NDArray[Any]:
    """Return means over ``size`` equal parts of an axis, whose borders may lie inside a value.

    The integral along the axis is linear between values, and a mean is the difference of two of
    its points. Where there are as many parts as values these come back.
    """
    length = values.shape[axis]
    if length == size:
        return values
    border = np.arange(size + 1) * length / size
    whole = np.minimum(border.astype(int), length - 1)
    share = np.expand_dims(border - whole, tuple(range(1, values.ndim))).astype(np.float32)
    exact = np.int32 if values.dtype == np.uint8 else np.float64
    along = np.moveaxis(values, axis, 0)
    before = np.zeros((length + 1, *along.shape[1:]), exact)
    np.cumsum(along, axis=0, dtype=exact, out=before[1:])
    integral = before[whole] + share * along[whole]
    return np.moveaxis(np.diff(integral, axis=0) * np.float32(size / length), 0, axis)
