"""Measured curves on disk, each file sealed to what it was measured with.

``curves.json`` holds one entry per method, exactly as ``eval --json`` prints it, under a digest of
the checkpoint, of the protocol and of the code's version of the closed loop. An entry is reused
where all three agree; otherwise it counts as not there.
"""

import contextlib
import dataclasses
import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.core.loop import LOOP_VERSION
from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.settings import Settings
from hjepa_cli.storage import files
from hjepa_cli.storage.runs import ROOT
from hjepa_cli.storage.zoo import CURVES_FILE

SCHEMA = 1

Entry = dict[str, Any]

_NUMBERS = ("score", "lq_ratio")
_TOLERANCES = ("tolerance_gap_steps", "tolerance_p", "bits_per_transmission")
_LISTS = ("nmae", "nmae_ci95", "score_ci95", "gap_curve", "delivery_curve")
_CLEAN = (
    "clean_trajectories",
    "clean_steps",
    "x_m",
    "x_dot_m_s",
    "theta_rad",
    "theta_dot_rad_s",
)


@dataclasses.dataclass(frozen=True)
class Digest:
    """What curves were measured with.

    Attributes:
        checkpoint: sha256 of the model; ``None`` without one (true-state methods alone).
        protocol: sha256 of everything else that a user can set.
        loop_version: :data:`hjepa_cli.core.loop.LOOP_VERSION`.
    """

    checkpoint: str | None
    protocol: str
    loop_version: int = LOOP_VERSION

    @classmethod
    def of(
        cls,
        checkpoint: str | None,
        settings: Settings,
        dataset: Mapping[str, Any] | None = None,
    ) -> "Digest":
        """Digest for a checkpoint, the settings that matter, and the rollouts behind the NMAE.

        Args:
            checkpoint: the model's sha256.
            settings: plant, seed, protocol, embedding and clean rollouts count.
            dataset: settings of the dataset whose clean rollouts are used, if any. One that was
                collected as the settings say gives the same rollouts, and the same digest.
        """
        values = settings.as_dict()
        source = values if dataset is None else dataset
        measured = {
            "plant": values["plant"],
            "seed": values["seed"],
            "protocol": values["protocol"],
            "embedding": values["encoder"]["embedding"],
            "clean": [source["seed"], *(source["collect"][key] for key in _CLEAN)],
        }
        text = files.canonical_json(measured)
        return cls(checkpoint, hashlib.sha256(text.encode()).hexdigest())


def read(path: Path, digest: Digest) -> dict[str, Entry]:
    """Return the entries in ``path`` by method; none if it is not there or of another digest.

    Raises:
        DataError: not a file of curves.
        StorageError: the disk refused.
    """
    if not path.exists():
        return {}
    document = files.read_json(path)
    if document.get("schema") != SCHEMA or not isinstance(document.get("methods"), dict):
        raise _damaged(path, f"schema {document.get('schema')!r}, expected {SCHEMA}")
    if document.get("digest") != dataclasses.asdict(digest):
        return {}
    for name, entry in document["methods"].items():
        if reason := _flaw(entry):
            raise _damaged(path, f"method '{name}': {reason}")
    return dict(document["methods"])


def find(
    digest: Digest, methods: Iterable[str], places: Iterable[Path], *, root: Path = ROOT
) -> dict[str, tuple[Entry, Path]]:
    """Look for methods in ``places``, then in the runs of ``eval`` and ``scale``, newest first.

    Returns:
        Entry and the file it came from, for the methods that were found.

    Raises:
        DataError: a file of ``places`` is damaged; damaged files of old runs are passed over.
        StorageError: the disk refused.
    """
    missing = list(methods)
    found: dict[str, tuple[Entry, Path]] = {}

    def take(path: Path) -> None:
        entries = read(path, digest)
        for name in [name for name in missing if name in entries]:
            found[name] = (entries[name], path)
            missing.remove(name)

    for path in places:
        take(path)
    for path in _newest_first(root / "eval", root / "scale") if missing else []:
        with contextlib.suppress(HjepaError):
            take(path)
    return found


def write(path: Path, digest: Digest, entries: Mapping[str, Entry]) -> None:
    """Add entries to ``path``, keeping those of the same digest, replacing all others.

    Raises:
        StorageError: the disk refused; the file is what it was before.
    """
    kept: dict[str, Entry] = {}
    with contextlib.suppress(DataError):  # damaged curves are replaced like foreign ones
        kept = read(path, digest)
    methods = files.jsonable(kept | dict(entries))
    document = {"schema": SCHEMA, "digest": dataclasses.asdict(digest), "methods": methods}
    files.write_json(path, document)


def _newest_first(*stages: Path) -> list[Path]:
    """The curve files of these stages' runs."""
    paths = (stage / name / CURVES_FILE for stage in stages for name in files.list_names(stage))
    return sorted(
        (path for path in paths if path.is_file()),
        key=lambda path: path.stat().st_mtime_ns,
        reverse=True,
    )


def _flaw(entry: object) -> str | None:
    """What keeps an entry from being used, if anything."""
    if not isinstance(entry, dict):
        return "not an object"
    for keys, kinds in (
        (_NUMBERS, (int, float)),
        (_TOLERANCES, (int, float, type(None))),
        (_LISTS, (list,)),
    ):
        for key in keys:
            if key not in entry:
                return f"'{key}' is missing"
            if not isinstance(entry[key], kinds) or isinstance(entry[key], bool):
                return f"'{key}' is {entry[key]!r}"
    return None


def _damaged(path: Path, reason: str) -> DataError:
    return DataError(
        f"{path} holds no valid curves: {reason}",
        hint="measure them again with --remeasure, or delete the file",
    )
