"""Checkpoints: named tensors plus everything needed to use them, sealed by a digest.

One safetensors file; its single metadata key holds canonical JSON with the schema version, the
digest and whatever the writer describes (architecture, normalisation, seed, health). Nothing in
it is executed on load.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.errors import DataError, MissingInputError, NumericalError
from hjepa_cli.storage import tensors as arrays
from hjepa_cli.storage.files import (
    canonical_json,
    check_schema,
    parse_json,
    read_bytes,
    write_bytes,
)

SCHEMA = 1
MODEL_FILE = "model.safetensors"  # the checkpoint's name in run directories and in the zoo
SIZE_LIMIT_BYTES = 4 * 2**30


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """A verified checkpoint: float32 or int64 arrays by name, and the writer's metadata."""

    tensors: dict[str, np.ndarray]
    metadata: dict[str, Any]
    digest: str
    path: Path


def save_checkpoint(
    path: Path, tensors: Mapping[str, np.ndarray], metadata: Mapping[str, Any]
) -> str:
    """Write a checkpoint atomically and return its sha256.

    Args:
        path: the file to replace.
        tensors: float32 or int64 arrays.
        metadata: plain JSON data; ``schema`` and ``sha256`` are added here.

    Raises:
        NumericalError: a tensor or the metadata holds NaN or an infinity.
        ValueError: another dtype, or a reserved key.
        StorageError: the disk refused; an older file at ``path`` is untouched.
    """
    if name := arrays.non_finite(tensors):
        raise NumericalError(f"refusing to write {path}: tensor '{name}' is not finite")
    if reserved := {"schema", "sha256"} & metadata.keys():
        raise ValueError(f"metadata may not use the reserved keys {sorted(reserved)}")
    sealed = {**metadata, "schema": SCHEMA, "sha256": ""}
    try:
        canonical_json(sealed)
    except ValueError as error:
        raise NumericalError(f"refusing to write {path}: metadata: {error}") from None
    digest = arrays.content_digest(sealed, tensors)
    write_bytes(path, arrays.pack(tensors, canonical_json({**sealed, "sha256": digest})))
    return digest


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint and verify its digest.

    Raises:
        MissingInputError: no such file.
        DataError: truncated, foreign, tampered, not finite, or of a newer schema.
    """
    try:
        data = read_bytes(path, limit=SIZE_LIMIT_BYTES)
    except MissingInputError:
        raise MissingInputError(
            f"checkpoint {path} does not exist", hint="hjepa models list"
        ) from None
    tensors, text = arrays.unpack(data, path)
    del data  # never more than twice the file in memory
    sealed = _metadata(text, path)
    check_schema(sealed.get("schema"), SCHEMA, f"checkpoint {path}")
    digest = arrays.content_digest({**sealed, "sha256": ""}, tensors)
    if sealed.get("sha256") != digest:
        raise DataError(
            f"checkpoint {path} was changed after it was written: its sha256 does not match",
            hint="train it again, or restore the original file",
        )
    if name := arrays.non_finite(tensors):
        raise DataError(f"checkpoint {path}: tensor '{name}' is not finite")
    metadata = {key: value for key, value in sealed.items() if key not in ("schema", "sha256")}
    return Checkpoint(tensors, metadata, digest, path)


def check_tensors(
    checkpoint: Checkpoint, expected: Mapping[str, tuple[str, tuple[int, ...]]]
) -> None:
    """Demand exactly these tensors: name to (dtype name, shape), nothing missing or extra.

    Raises:
        DataError: naming the first difference.
    """
    found = checkpoint.tensors
    for name in sorted(expected.keys() | found.keys()):
        if name not in found:
            reason = f"tensor '{name}' is missing"
        elif name not in expected:
            reason = f"tensor '{name}' is unexpected"
        else:
            is_ = (found[name].dtype.name, found[name].shape)
            should = (expected[name][0], tuple(expected[name][1]))
            if is_ == should:
                continue
            reason = f"tensor '{name}' is {is_[0]} {is_[1]}; expected {should[0]} {should[1]}"
        raise DataError(f"checkpoint {checkpoint.path} does not fit its architecture: {reason}")


def _metadata(text: object, path: Path) -> dict[str, Any]:
    if not isinstance(text, str):
        raise DataError(f"{path} is not an hjepa checkpoint: it has no hjepa metadata")
    try:
        return parse_json(text)
    except ValueError as error:
        raise DataError(f"checkpoint {path} has damaged metadata: {error}") from None
