"""Arrays from outside are checked: networks would read other types or layouts as garbage."""

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from hjepa_cli.core.arrays import array_from, described, finite
from hjepa_cli.errors import ArrayError


def frames_from(frames: ArrayLike, shape: tuple[int, ...]) -> Tensor:
    """Return pictures uint8 [N, *shape], of any strides and also read-only, as torch takes them.

    Raises:
        ArrayError: another type or shape, such as floats from 0 to 1 or channels before rows.
        NumericalError: they are floats, and one is not finite.
    """
    array = array_from(frames, "frames")
    if array.dtype != np.uint8:
        finite(array, "frames")
    if array.dtype != np.uint8 or array.shape[1:] != shape or array.ndim != 1 + len(shape):
        wanted = ", ".join(map(str, shape))
        raise ArrayError(
            f"frames: {described(array)}; expected uint8 [N, {wanted}] from 0 to 255",
            hint="frames of hjepa_cli.Camera have the right type; others: "
            "(255 * frames).round().astype('uint8')",
        )
    return torch.from_numpy(np.require(array, requirements=["C", "W"]))


def embeddings_from(z: Any, width: int) -> Tensor:
    """Return embeddings [..., ``width``] as a floating tensor.

    Raises:
        ArrayError: another type or shape.
        NumericalError: one is not finite.
    """
    if not isinstance(z, Tensor):
        z = torch.from_numpy(np.require(finite(z, "z"), np.float32, ["C", "W"]))
    if not z.is_floating_point() or z.ndim < 2 or z.shape[-1] != width:
        raise ArrayError(f"z: {described(z.detach().cpu())}; expected floating [N, {width}]")
    if not z.isfinite().all():
        finite(z.detach().float().cpu(), "z")
    checked: Tensor = z
    return checked
