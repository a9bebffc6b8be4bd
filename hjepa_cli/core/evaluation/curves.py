"""Measured curves on disk, each file sealed to what it was measured with.

``curves.json`` holds one entry per method, exactly as ``eval --json`` prints it, under a digest of
the checkpoint, of the protocol and of the code's version of the closed loop. An entry is reused
where all three agree, and of an anchor where it was fitted to the same trajectories besides;
otherwise it counts as not there.
"""

import contextlib
import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import ANCHORS
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.core.evaluation.protocol import BESIDE
from hjepa_cli.core.plants.conditions import altered
from hjepa_cli.core.plants.named import definition
from hjepa_cli.errors import DataError, HjepaError
from hjepa_cli.storage import files
from hjepa_cli.storage.runs import ROOT
from hjepa_cli.storage.zoo import CURVES_FILE

SCHEMA = 1
AGAIN = "measure them again with --remeasure, or delete the file"

Entry = dict[str, Any]

Check = Callable[[Any], bool]

LARGEST = 1e12  # beyond anything that is measured; keeps arithmetic in range
RANGES = ("x_m", "x_dot_m_s", "theta_rad", "theta_dot_rad_s")  # of starts, in ``collect``
CLEAN = ("clean_trajectories", "clean_steps", *RANGES)  # what clean rollouts depend on
FITTED = ("trajectories", "test_trajectories", "steps", "exploration_n", "exploration_hold_steps")


@dataclasses.dataclass(frozen=True)
class Digest:
    """What curves were measured with.

    Attributes:
        checkpoint: sha256 of the model; ``None`` without one (true-state methods alone).
        protocol: sha256 of everything else that a user can set.
        fitted: sha256 of what the trajectories depend on that anchors are fitted to, beside the
            settings in ``protocol``. It concerns these methods alone.
        loop_version: :data:`hjepa_cli.core.control.loop.LOOP_VERSION`.
    """

    checkpoint: str | None
    protocol: str
    fitted: str = ""
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

        Raises:
            DataError: the dataset does not say how its clean rollouts were made.
        """
        values = settings.as_dict()
        source = values if dataset is None else dataset
        try:
            collected = source["collect"]
            clean = [source["seed"], *(collected[key] for key in CLEAN)]
            clean += collected.get("start", [])
            starts = _starts(collected)
            conditions = altered(values)
            if (theirs := altered(source)) != conditions:
                clean.append(theirs)
        except (LookupError, TypeError, AttributeError):
            raise DataError(
                "the dataset does not say how its clean rollouts were made",
                hint="leave --dataset out: they are made again",
            ) from None
        measured = {
            "plant": values["plant"],
            "seed": values["seed"],
            "protocol": values["protocol"],
            "embedding": values["encoder"]["embedding"],
            "clean": clean,
        }
        if system := definition(values["plant"]):
            measured["system"] = system
        if conditions:  # or digests would not be those of before there were conditions
            measured["conditions"] = conditions
        fitted = [values["collect"][key] for key in FITTED]
        if _starts(values["collect"]) != starts:  # the dataset's are in ``clean``, these nowhere
            fitted.append(_starts(values["collect"]))
        if values["protocol"]["payload"].startswith("pca"):  # components are fitted to them, too
            measured["fitted"] = fitted
        return cls(checkpoint, _sha256(measured), _sha256(fitted))

    def as_dict(self) -> dict[str, Any]:
        """As it stands in a file, for all of its methods."""
        return {name: value for name, value in vars(self).items() if name != "fitted"}


def _starts(collected: Mapping[str, Any]) -> list[Any]:
    return [*(collected[key] for key in RANGES), *collected.get("start", [])]


def read(path: Path, digest: Digest) -> dict[str, Entry]:
    """Return the entries in ``path`` by method; none if it is not there or of another digest.

    Raises:
        DataError: not a file of curves.
        StorageError: the disk refused.
    """
    if not path.exists():
        return {}
    try:
        document = files.read_json(path)
    except DataError as error:
        error.hint = AGAIN
        raise
    files.check_schema(document.get("schema"), SCHEMA, str(path))
    if not isinstance(document.get("methods"), dict):
        raise _damaged(path, "no methods")
    if document.get("digest") != digest.as_dict():
        return {}
    for name, entry in document["methods"].items():
        if reason := flaw(entry, complete=digest.loop_version == LOOP_VERSION):
            raise _damaged(path, f"method '{name}': {reason}")
    return {
        name: entry
        for name, entry in document["methods"].items()
        if name not in ANCHORS or entry.get("fitted_to") == digest.fitted
    }


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


def further_file(digest: Digest) -> str:
    """The file in a run for curves of another model than the first one."""
    return f"{Path(CURVES_FILE).stem}-{(digest.checkpoint or '')[:12]}.json"


def write(path: Path, digest: Digest, entries: Mapping[str, Entry]) -> None:
    """Add entries to ``path``, keeping those of the same digest, replacing all others.

    Raises:
        StorageError: the disk refused; the file is what it was before.
    """
    with files.taking_turns(path.parent):  # two evaluations may share a model's file
        kept: dict[str, Entry] = {}
        with contextlib.suppress(DataError):  # damaged curves are replaced like foreign ones
            kept = read(path, digest)
        methods = files.jsonable(kept | dict(entries))
        for name in methods.keys() & set(ANCHORS):
            methods[name]["fitted_to"] = digest.fitted
        document = {"schema": SCHEMA, "digest": digest.as_dict(), "methods": methods}
        files.write_json(path, document)


def _sha256(value: object) -> str:
    return hashlib.sha256(files.canonical_json(value).encode()).hexdigest()


def _newest_first(*stages: Path) -> list[Path]:
    """The curve files of these stages' runs."""
    runs = (stage / name for stage in stages for name in files.list_names(stage))
    paths = (path for run in runs for path in run.glob(f"{Path(CURVES_FILE).stem}*.json"))
    return sorted(
        (path for path in paths if path.is_file()),
        key=lambda path: path.stat().st_mtime_ns,
        reverse=True,
    )


def flaw(entry: object, *, complete: bool = False) -> str | None:
    """Say what keeps an entry from being used, if anything.

    Args:
        entry: of a method, as read from a file.
        complete: it is of the present version, and must have all that came later too.
    """
    if not isinstance(entry, dict):
        return "not an object"
    for key, check in (_CHECKS | _LATER).items():
        if key not in entry:
            if key in _LATER and not complete:
                continue
            return f"'{key}' is missing"
        if not check(entry[key]):
            return f"'{key}' is {str(entry[key])[:40]!r}"
    return None


def _is_number(value: object) -> bool:
    return type(value) in (int, float) and abs(value) <= LARGEST  # type: ignore[arg-type]


def _is_count(value: object) -> bool:
    return type(value) is int and 0 < value <= LARGEST


def _is_flag(value: object) -> bool:
    return isinstance(value, bool)


def _is_tolerance(value: object) -> bool:
    return value is None or (_is_number(value) and value >= 0)  # type: ignore[operator]


def _is_numbers(value: object) -> bool:
    return isinstance(value, list) and all(map(_is_number, value))


def _is_interval(value: object) -> bool:
    return _is_numbers(value) and len(value) == 2  # type: ignore[arg-type]


def _is_curve(value: object) -> bool:
    """Points with a gap ``d`` or a probability ``p``, and a score."""
    return isinstance(value, list) and all(
        isinstance(point, dict)
        and _is_number(point.get("score"))
        and _is_number(point.get("d", point.get("p")))
        for point in value
    )


def _or_none(check: Check) -> Check:
    return lambda value: value is None or check(value)


_CHECKS: dict[str, Check] = {
    "score": _is_number,
    "score_ci95": _is_interval,
    "lq_ratio": _is_number,
    "nmae": _is_numbers,
    "nmae_ci95": lambda value: isinstance(value, list) and all(map(_is_interval, value)),
    "nmae_windows": lambda value: (
        isinstance(value, dict) and all(_or_none(_is_number)(entry) for entry in value.values())
    ),
    "gap_curve": _is_curve,
    "delivery_curve": _is_curve,
    "tolerance_gap_steps": _is_tolerance,
    "tolerance_gap_ci95": _or_none(_is_interval),
    "tolerance_gap_censored": _or_none(_is_flag),
    "tolerance_gap_lq_steps": _is_tolerance,
    "tolerance_p": _is_tolerance,
    "tolerance_p_ci95": _or_none(_is_interval),
    "tolerance_p_censored": _or_none(_is_flag),
    "bits_per_transmission": lambda value: value is None or value == 0 or _is_count(value),
    "n_devices": _is_count,
    "n_curve_devices": _is_count,
    "n_rollouts": _is_count,
}

_LATER: dict[str, Check] = {  # older results of eval are without these
    "nmae_every_step": _is_number,
    "nmae_every_step_ci95": _is_interval,
    **{f"tolerance_{kind}_{key}": _or_none(_is_number) for kind in ("gap", "p") for key in BESIDE},
    "warmup_steps": lambda value: type(value) is int and 0 <= value <= LARGEST,
    "scored_steps": _is_count,
}


def _damaged(path: Path, reason: str) -> DataError:
    return DataError(f"{path} holds no valid curves: {reason}", hint=AGAIN)
