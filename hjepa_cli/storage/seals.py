"""A sealed file carries the sha256 of its own content, so that no change goes unnoticed.

A seal shows that nothing was changed since it was written, not who wrote it.
"""

import hashlib
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.errors import DataError, Unsealed
from hjepa_cli.storage.files import canonical_json, check_schema, read_json
from hjepa_cli.storage.tensors import plain_array

SEAL = "sha256"


def warn(where: object, consequence: str = "it may have been changed since") -> None:
    """Say that ``where`` has no seal, as is usual in a file of an older version."""
    warnings.warn(f"{where} has no seal, an older hjepa wrote it: {consequence}", Unsealed, 2)


def sealed(
    document: Mapping[str, Any], tensors: Mapping[str, np.ndarray] | None = None
) -> dict[str, Any]:
    """Return ``document`` with a seal over it, then each tensor's name, dtype, shape and bytes.

    It covers the content, not the file: another writer of the same values has the same seal.

    Raises:
        ValueError: a NaN or an infinity in ``document``.
    """
    digest = hashlib.sha256(canonical_json({**document, SEAL: ""}).encode())
    for name, array in sorted((tensors or {}).items()):
        array = plain_array(array, name)
        digest.update(canonical_json([name, array.dtype.name, array.shape]).encode())
        digest.update(array.data if array.size else b"")
    return {**document, SEAL: digest.hexdigest()}


def check(
    document: Mapping[str, Any],
    where: object,
    again: str,
    tensors: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Raise DataError, with the hint ``again``, unless a document is as it was sealed."""
    if document.get(SEAL) != sealed(document, tensors)[SEAL]:
        reason = "its sha256 does not match" if SEAL in document else "it has no sha256"
        raise DataError(f"{where} was changed after it was written: {reason}", hint=again)


def verified(document: Mapping[str, Any], schema: int, where: object, again: str) -> dict[str, Any]:
    """Return a document of this schema, its seal checked, or of the one before, without a seal.

    Which one it is, :data:`SEAL` in it tells. One without a schema is of the first.

    Raises:
        DataError: another schema, or not as it was sealed.
    """
    document = {"schema": 1, **document}
    former = SEAL not in document and document["schema"] == schema - 1
    try:
        check_schema(document["schema"], schema - former, str(where))
    except DataError as error:
        error.hint = error.hint or again
        raise
    if not former:
        check(document, where, again)
    return document


def read(path: Path, schema: int, again: str) -> dict[str, Any]:
    """Read a JSON file as :func:`verified` takes it; its errors have the hint ``again``."""
    try:
        document = read_json(path)
    except DataError as error:
        error.hint = again
        raise
    return verified(document, schema, path, again)
