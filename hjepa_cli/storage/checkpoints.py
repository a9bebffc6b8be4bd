"""A checkpoint has named tensors and everything needed to use them, sealed by a digest.

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
from hjepa_cli.storage import seals
from hjepa_cli.storage import tensors as arrays
from hjepa_cli.storage.files import (
    canonical_json,
    check_schema,
    parse_json,
    read_bytes,
    reading,
    write_bytes,
)

SCHEMA = 1
MODEL_FILE = "model.safetensors"  # the checkpoint's name in run directories and in the zoo
SIZE_LIMIT_BYTES = 4 * 2**30


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """It is verified, and holds float32 or int64 arrays by name and the writer's metadata."""

    tensors: dict[str, np.ndarray]
    metadata: dict[str, Any]
    digest: str
    path: Path


def save_checkpoint(
    path: Path,
    tensors: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any],
    *,
    narrow: bool = False,
) -> str:
    """Write float32 or int64 arrays and plain JSON data atomically, and return their sha256.

    ``narrow``: see :func:`~hjepa_cli.storage.tensors.pack`; the sha256 is the same.

    Raises:
        NumericalError: a tensor or the metadata holds NaN or an infinity.
        ValueError: another dtype, or a reserved key.
        StorageError: the disk refused; an older file at ``path`` is untouched.
    """
    if name := arrays.non_finite(tensors):
        raise NumericalError(f"refusing to write {path}: tensor '{name}' is not finite")
    if reserved := {"schema", "sha256"} & metadata.keys():
        raise ValueError(f"metadata may not use the reserved keys {sorted(reserved)}")
    try:
        canonical_json(metadata)
    except ValueError as error:
        raise NumericalError(f"refusing to write {path}: metadata: {error}") from None
    sealed = seals.sealed({**metadata, "schema": SCHEMA}, tensors)
    write_bytes(path, arrays.pack(tensors, canonical_json(sealed), narrow=narrow))
    return str(sealed[seals.SEAL])


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint and verify its digest.

    Raises:
        MissingInputError: no such file.
        DataError: truncated, foreign, tampered, not finite, or of a newer schema.
    """
    try:
        if path.is_file():
            with reading(path):
                arrays.check_header(path)
        data = read_bytes(path, limit=SIZE_LIMIT_BYTES)
    except MissingInputError:
        raise MissingInputError(
            f"checkpoint {path} does not exist", hint="hjepa models list"
        ) from None
    tensors, text = arrays.unpack(data, path)
    del data  # never more than twice the file in memory
    if not isinstance(text, str):
        raise DataError(f"{path} is not an hjepa checkpoint: it has no hjepa metadata")
    try:
        metadata = parse_json(text)
    except ValueError as error:
        raise DataError(f"checkpoint {path} has damaged metadata: {error}") from None
    check_schema(metadata.get("schema"), SCHEMA, f"checkpoint {path}")
    again = "train it again, or restore the original file"
    seals.check(metadata, f"checkpoint {path}", again, tensors)
    if name := arrays.non_finite(tensors):
        raise DataError(f"checkpoint {path}: tensor '{name}' is not finite")
    del metadata["schema"]
    return Checkpoint(tensors, metadata, metadata.pop(seals.SEAL), path)


def check_tensors(checkpoint: Checkpoint, expected: arrays.Shapes) -> None:
    """Raise DataError unless a checkpoint has exactly these tensors."""
    if reason := arrays.difference(checkpoint.tensors, expected):
        raise DataError(f"checkpoint {checkpoint.path} does not fit its architecture: {reason}")
