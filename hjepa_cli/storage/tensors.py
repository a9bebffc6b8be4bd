"""Named numpy arrays to safetensors bytes and back, without the library's traps.

safetensors 0.8 silently scrambles arrays that are not C-contiguous, and more than one metadata
key makes the bytes random. All array files of this program therefore pass through here.
"""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors import numpy as safetensors_numpy

from hjepa_cli.errors import DataError
from hjepa_cli.storage.files import canonical_json, parse_json

METADATA_KEY = "hjepa"
HEADER_LIMIT_BYTES = 2**20
DTYPES = ("float32", "int64", "uint8")

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
        header = _header(data)
        foreign = {entry["dtype"] for name, entry in header.items() if name != "__metadata__"}
        if foreign - {"F32", "I64", "U8"}:
            raise ValueError(f"unexpected dtype {', '.join(sorted(foreign))}")
        metadata = header.get("__metadata__", {}).get(METADATA_KEY)
        return safetensors_numpy.load(data), metadata
    except _MALFORMED as error:
        reason = str(error).partition("\n")[0]
        raise DataError(f"{path} is damaged or not a safetensors file: {reason}") from None


def plain_array(array: np.ndarray, name: str) -> np.ndarray:
    """Return ``array`` C-contiguous in native byte order, shape kept (also zero-dimensional)."""
    if array.dtype.name not in DTYPES:
        raise ValueError(f"tensor '{name}' is {array.dtype}; expected {', '.join(DTYPES)}")
    return np.asarray(array, dtype=array.dtype.newbyteorder("="), order="C")


def content_digest(metadata: Any, tensors: Mapping[str, np.ndarray]) -> str:
    """Return the sha256 over the metadata, then each tensor's name, dtype, shape, bytes.

    It covers the content, not the file: another writer of the same values has the same digest.
    """
    digest = hashlib.sha256(canonical_json(metadata).encode())
    for name in sorted(tensors):
        array = plain_array(tensors[name], name)
        digest.update(canonical_json([name, array.dtype.name, array.shape]).encode())
        digest.update(array.data if array.size else b"")
    return digest.hexdigest()


def non_finite(tensors: Mapping[str, np.ndarray]) -> str | None:
    """Return the name of the first tensor holding a NaN or an infinity, if any."""
    return next((name for name in sorted(tensors) if not np.isfinite(tensors[name]).all()), None)


def _header(data: bytes) -> dict[str, Any]:
    if len(data) < 8:
        raise ValueError(f"only {len(data)} bytes")
    length = int.from_bytes(data[:8], "little")
    if length > min(HEADER_LIMIT_BYTES, len(data) - 8):
        raise ValueError("the header is longer than the file or the limit")
    try:
        return parse_json(data[8 : 8 + length])
    except json.JSONDecodeError:
        raise ValueError("the header is not JSON") from None
