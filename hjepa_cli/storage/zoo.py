"""The model zoo has trained models, shipped with the program and found by name.

``models/<name>/`` holds ``model.safetensors``, ``curves.json`` (its measured closed-loop curves)
and ``README.md`` (its card). The wheel carries the folder as ``hjepa_cli/zoo``; a checkout and an
editable install have it beside the package.
"""

import dataclasses
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from hjepa_cli.errors import DataError, MissingInputError, meant, shell
from hjepa_cli.storage import files, runs, seals
from hjepa_cli.storage.checkpoints import MODEL_FILE, load_checkpoint

CURVES_FILE = "curves.json"
CURVES_SCHEMA = 2  # 1 had no seal

_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,63}")


@dataclasses.dataclass(frozen=True)
class ZooModel:
    """It is verified; where it has measured curves they were measured on it."""

    name: str
    path: Path
    size_bytes: int
    digest: str
    metadata: dict[str, Any]
    has_curves: bool


def zoo_directory() -> Path:
    """Return the folder with the shipped models; it may be absent in a bare checkout."""
    packaged = Path(str(resources.files("hjepa_cli") / "zoo"))
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / "models"


def list_models() -> list[str]:
    """Return the names of the shipped models, sorted."""
    root = zoo_directory()
    names = filter(_NAME.fullmatch, files.list_names(root))
    return [name for name in names if (root / name / MODEL_FILE).is_file()]


def find_model(plant_name: str, strides: Sequence[int] = ()) -> Path | None:
    """Return the file of the zoo's first hierarchy of a plant, rather one with these strides."""
    first = None
    for path in map(resolve_model, list_models()):
        metadata = load_checkpoint(path).metadata
        found = {"kind": "hierarchy"} | metadata.get("architecture", {})
        if (metadata.get("plant"), found["kind"]) == (plant_name, "hierarchy"):
            if [found.get(name) for name in ("h", "m", "l")] == list(strides):
                return path
            first = first or path
    return first


def resolve_model(name_or_path: str | Path) -> Path:
    """Return the checkpoint file of a zoo name, a run directory or a file.

    A zoo name wins over a file of the same name in the current directory; write ``./name`` for
    the file.

    Raises:
        MissingInputError: neither; the message lists the zoo's names.
    """
    text, models = str(name_or_path), list_models()
    path = zoo_directory() / text if text in models else Path(name_or_path)
    if path.is_dir() and not (path / MODEL_FILE).is_file():
        raise MissingInputError(
            f"{path} holds no {MODEL_FILE}: not a finished training run",
            hint="name a run directory, a .safetensors file or a zoo model: hjepa models list",
        )
    if path.exists():
        return path / MODEL_FILE if path.is_dir() else path
    suggestion = meant(text, models).rstrip() or f"the zoo has {', '.join(models) or '-'}"
    raise MissingInputError(
        f"no model '{text}': neither a zoo name nor a file; {suggestion}", hint="hjepa models list"
    )


def verify_model(name_or_path: str | Path) -> ZooModel:
    """Load a model and check its sha256 and the seals beside it: of its curves and of its run.

    A seal that an older version had not is an :class:`~hjepa_cli.errors.Unsealed` warning.

    Raises:
        MissingInputError: no such model.
        DataError: damaged, or the curves belong to another checkpoint.
    """
    path = resolve_model(name_or_path)
    checkpoint = load_checkpoint(path)
    curves = path.with_name(CURVES_FILE)
    if curves.exists():
        command = shell(["hjepa", "eval", "--checkpoint", name_or_path, "--remeasure"])
        again = f"measure it again: {command}"
        document = seals.read(curves, CURVES_SCHEMA, again)
        digest = document.get("digest")
        if not isinstance(digest, dict) or digest.get("checkpoint") != checkpoint.digest:
            reason = f"{curves} was measured on another checkpoint than {path.name}"
            raise DataError(reason, hint=again)
        if seals.SEAL not in document:
            seals.warn(curves)
    if path.with_name(runs.RESULT).exists() and path.with_name(runs.ENVIRONMENT).exists():
        runs.read_result(path.parent)
    name = path.parent.name if path.name == MODEL_FILE else path.stem
    size = path.stat().st_size
    return ZooModel(name, path, size, checkpoint.digest, checkpoint.metadata, curves.exists())
