"""Named numpy arrays become safetensors bytes and back, without the library's traps.

safetensors 0.8 silently scrambles arrays that are not C-contiguous, and more than one metadata
key makes the bytes random. All array files of this program therefore pass through here.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, deserialize
from safetensors import numpy as safetensors_numpy

from hjepa_cli.errors import DataError
from hjepa_cli.storage.files import parse_json

METADATA_KEY = "hjepa"
HEADER_LIMIT_BYTES = 2**20
DTYPES = ("float32", "int64", "uint8")
STORED = {"F32": "<f4", "BF16": "<u2", "I64": "<i8", "U8": "u1"}

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


def pack(
    tensors: Mapping[str, np.ndarray], metadata: str | None = None, *, narrow: bool = False
) -> bytes:
    """Return the safetensors file holding ``tensors`` and the text ``metadata``.

    Equal arrays give equal bytes, whatever their strides or byte order. ``narrow`` stores float32
    arrays that fit bfloat16 exactly as such, in half the bytes; :func:`unpack` widens them again.

    Raises:
        ValueError: a dtype other than :data:`DTYPES`, or more text than :func:`unpack` accepts.
    """
    plain = {name: plain_array(array, name) for name, array in tensors.items()}
    texts = None if metadata is None else {METADATA_KEY: metadata}
    data = _save_narrow(plain, texts) if narrow else safetensors_numpy.save(plain, texts)
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
        if foreign - STORED.keys():
            raise ValueError(f"unexpected dtype {', '.join(sorted(foreign))}")
        metadata = header.get("__metadata__", {}).get(METADATA_KEY)
        return {name: _widened(stored) for name, stored in deserialize(data)}, metadata
    except _MALFORMED as error:
        reason = str(error).partition("\n")[0]
        raise DataError(f"{path} is damaged or not a safetensors file: {reason}") from None


def _save_narrow(tensors: Mapping[str, np.ndarray], texts: dict[str, str] | None) -> bytes:
    import torch  # knows bfloat16, which numpy does not
    from safetensors import torch as safetensors_torch

    stored = {}
    for name, array in tensors.items():
        stored[name] = whole = torch.from_numpy(array)
        if whole.dtype == torch.float32 and torch.equal(whole.bfloat16().float(), whole):
            stored[name] = whole.bfloat16()
    return safetensors_torch.save(stored, texts)


def _widened(stored: Mapping[str, Any]) -> np.ndarray:
    array = np.frombuffer(stored["data"], STORED[stored["dtype"]]).reshape(stored["shape"])
    if stored["dtype"] == "BF16":  # the upper half of a float32
        return (array.astype("<u4") << 16).view("<f4").astype(np.float32, copy=False)
    return array.astype(array.dtype.newbyteorder("="), copy=False)


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
