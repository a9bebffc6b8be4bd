"""Named numpy arrays become safetensors bytes and back, without the library's traps.

safetensors 0.8 silently scrambles arrays that are not C-contiguous, and more than one metadata
key makes the bytes random. All array files of this program therefore pass through here.
"""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors import numpy as safetensors_numpy

from hjepa_cli.errors import DataError
from hjepa_cli.storage.files import parse_json

METADATA_KEY = "hjepa"
HEADER_LIMIT_BYTES = 2**20
DTYPES = ("float32", "int64", "uint8")

Shapes = Mapping[str, tuple[str, tuple[int, ...]]]
"""It maps names of tensors to dtype and shape."""

_LFS_POINTER = b"version https://git-lfs"
_MALFORMED = (
    SafetensorError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,  # a dimension beyond what numpy counts with
)


def pack(tensors: Mapping[str, np.ndarray], metadata: str | None = None) -> bytes:
    """Return the safetensors file holding ``tensors`` and the text ``metadata``.

    Equal arrays give equal bytes, whatever their strides or byte order.

    Raises:
        ValueError: a dtype other than :data:`DTYPES`, or more text than :func:`unpack` accepts.
    """
    plain = {name: plain_array(array, name) for name, array in tensors.items()}
    data = safetensors_numpy.save(plain, None if metadata is None else {METADATA_KEY: metadata})
    if (length := int.from_bytes(data[:8], "little")) > HEADER_LIMIT_BYTES:
        raise ValueError(f"a header of {length} bytes; readers accept {HEADER_LIMIT_BYTES}")
    return data


def unpack(data: bytes, path: Path) -> tuple[dict[str, np.ndarray], str | None]:
    """Return the tensors and the metadata text in ``data``; ``path`` is only for messages.

    Raises:
        DataError: truncated, malformed, or with a dtype other than :data:`DTYPES`.
    """
    if data.startswith(_LFS_POINTER):
        raise DataError(f"{path} is a git-lfs pointer, not the file", hint="git lfs pull")
    try:
        length = int.from_bytes(data[:8], "little")
        if not length <= min(HEADER_LIMIT_BYTES, len(data) - 8):
            raise ValueError("the header is longer than the file or the limit")
        header = parse_json(data[8 : 8 + length])
        foreign = {entry["dtype"] for name, entry in header.items() if name != "__metadata__"}
        if foreign - {"F32", "I64", "U8"}:
            raise ValueError(f"unexpected dtype {', '.join(sorted(foreign))}")
        metadata = header.get("__metadata__", {}).get(METADATA_KEY)
        return safetensors_numpy.load(data), metadata
    except _MALFORMED as error:
        reason = str(error).partition("\n")[0]
        raise DataError(f"{path} is damaged or not a safetensors file: {reason}") from None


def check_header(path: Path) -> None:
    """Read no more of a file than says whether it can be one of tensors, however large it is.

    Raises:
        DataError: it cannot be one.
        OSError: it cannot be read.
    """
    with open(path, "rb") as file:
        begun, size = file.read(8), os.fstat(file.fileno()).st_size
        length = int.from_bytes(begun, "little")
        if length > min(HEADER_LIMIT_BYTES, size - 8):
            unpack(begun + file.read(len(_LFS_POINTER)), path)  # says so
        try:
            header = parse_json(file.read(length))
            ends = [e["data_offsets"][1] for name, e in header.items() if name != "__metadata__"]
            if 8 + length + max(ends, default=0) != size:
                raise ValueError("its tensors do not fill it")
        except _MALFORMED as error:
            reason = str(error).partition("\n")[0]
            raise DataError(f"{path} is damaged or not a safetensors file: {reason}") from None


def plain_array(array: np.ndarray, name: str) -> np.ndarray:
    """Return ``array`` C-contiguous in native byte order, shape kept (also zero-dimensional)."""
    if array.dtype.name not in DTYPES:
        raise ValueError(f"tensor '{name}' is {array.dtype}; expected {', '.join(DTYPES)}")
    return np.asarray(array, dtype=array.dtype.newbyteorder("="), order="C")


def non_finite(tensors: Mapping[str, np.ndarray]) -> str | None:
    """Return the name of the first tensor holding a NaN or an infinity, if any."""
    floats = (name for name in sorted(tensors) if tensors[name].dtype.kind == "f")
    return next((name for name in floats if not np.isfinite(tensors[name]).all()), None)


def difference(found: Mapping[str, np.ndarray], expected: Shapes) -> str | None:
    """Name the first tensor that is missing, unexpected or of another dtype or shape, if any."""
    for name in sorted(expected.keys() | found.keys()):
        if name not in found:
            return f"tensor '{name}' is missing"
        if name not in expected:
            return f"tensor '{name}' is unexpected"
        (dtype, shape), has = expected[name], found[name]
        if (has.dtype.name, has.shape) != (dtype, tuple(shape)):
            has_text = f"{has.dtype.name} {has.shape}"
            return f"tensor '{name}' is {has_text}; expected {dtype} {tuple(shape)}"
    return None
