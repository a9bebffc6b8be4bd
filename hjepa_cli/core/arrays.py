"""These arrays pass between the rooms of the core, and only fitting, finite ones enter."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hjepa_cli.errors import ArrayError, NumericalError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Integers = NDArray[np.int64]
Pixels = NDArray[np.uint8]  # of frames: [..., height, width, 3]


def finite(values: ArrayLike, name: str) -> Floats:
    """Return values of any shape as float64; the caller's own array, if it is one already.

    Raises:
        NumericalError: one is NaN or infinite; the message says which.
        ArrayError: they are no real numbers.
    """
    array = _numbers(values, name)
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0].tolist()
        raise NumericalError(
            f"{name}{first or ''} is {array[tuple(first)]}; expected finite numbers"
        )
    return array


def described(values: Any) -> str:
    """Say what an array or tensor is: ``float32 [2, 64, 128] from 0 to 0.97``."""
    shape = ", ".join(map(str, values.shape))
    text = f"{str(values.dtype).removeprefix('torch.')} [{shape}]"
    if 0 in values.shape or getattr(values.dtype, "kind", "f") not in "biuf" or "complex" in text:
        return text
    return f"{text} from {float(values.min()):.6g} to {float(values.max()):.6g}"


def check_answer(values: Any, shape: tuple[int, ...], name: str, kind: type = np.ndarray) -> None:
    """Raise ArrayError where what a function returned is no array, or tensor, of a shape.

    NumPy and torch would stretch some that do not fit: one force for all devices in place of one
    for each.
    """
    if not isinstance(values, kind):
        raise ArrayError(f"{name} is a {type(values).__name__}; expected a {kind.__name__}")
    found: Any = values
    if found.shape != shape:
        shown = f"{tuple(found.shape)} of {str(found.dtype).removeprefix('torch.')}"
        raise ArrayError(f"{name} is {shown}; expected numbers of shape {tuple(shape)}")


def array_from(values: ArrayLike, name: str) -> NDArray[Any]:
    """Return anything as an array; raise ArrayError for what is none, as lists of many lengths."""
    try:
        return np.asarray(values)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ArrayError(f"{name} is no array: {error}") from None


def _numbers(values: ArrayLike, name: str) -> Floats:
    array = array_from(values, name)
    if array.dtype.kind not in "biuf":
        raise ArrayError(f"{name}: {described(array)}; expected real numbers")
    return np.asarray(array, np.float64)
