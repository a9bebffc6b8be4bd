"""These arrays pass between the rooms of the core, and only finite ones enter."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.errors import NumericalError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Pixels = NDArray[np.uint8]  # of frames: [..., height, width, 3]


def finite(values: ArrayLike, name: str) -> Floats:
    """Return values of any shape as float64; the caller's own array, if it is one already.

    Raises:
        NumericalError: one is NaN or infinite; the message says which.
    """
    array = np.asarray(values, float)
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0].tolist()
        raise NumericalError(
            f"{name}{first or ''} is {array[tuple(first)]}; expected finite numbers"
        )
    return array
