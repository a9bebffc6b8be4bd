"""Measured curves lie on disk, each file sealed to what it was measured with.

``curves.json`` holds one entry per method, exactly as ``eval --json`` prints it, under a digest of
the checkpoint, of the protocol and of the code's version of the closed loop. An entry is reused
where all three agree, of a method that is fitted to trajectories where they are the same besides,
and of a plugin's method where the plugin is; otherwise it counts as not there.
"""

import contextlib
import dataclasses
import hashlib
import itertools
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from hjepa_cli.config.checks import LATE
from hjepa_cli.config.schema import CollectSettings, Settings
from hjepa_cli.core.control.link import LINK_VERSION
from hjepa_cli.core.control.loop import LOOP_VERSION
from hjepa_cli.core.plants.conditions import altered
from hjepa_cli.core.plants.named import definition
from hjepa_cli.errors import DataError, HjepaError, Unsealed
from hjepa_cli.plugins import CODECS, METHODS
from hjepa_cli.storage import files, seals
from hjepa_cli.storage.runs import ROOT
from hjepa_cli.storage.zoo import CURVES_FILE, CURVES_SCHEMA

SCHEMA = CURVES_SCHEMA
AGAIN = "measure them again with --remeasure, or delete the file"
LONGEST_STEPS = 1e6  # a gap between packets

Entry = dict[str, Any]

LARGEST = 1e12
ROUNDING = 1e-9  # sums of a bootstrap are in another order
RANGES = ("x_m", "x_dot_m_s", "theta_rad", "theta_dot_rad_s")  # of starts, in ``collect``
CLEAN = ("clean_trajectories", "clean_steps", *RANGES)  # what clean rollouts depend on
FITTED = ("trajectories", "test_trajectories", "steps", "exploration_n", "exploration_hold_steps")


@dataclasses.dataclass(frozen=True)
class Digest:
    """It stands for all that curves were measured with."""

    checkpoint: str | None  # sha256 of the model; None without one (true-state methods alone)
    protocol: str  # sha256 of everything else that a user can set
    fitted: str = ""  # besides, of what trajectories depend on, for the methods fitted to them
    loop_version: int = LOOP_VERSION

    @classmethod
    def of(
        cls,
        checkpoint: str | None,
        settings: Settings,
        dataset: Mapping[str, Any] | None = None,
    ) -> "Digest":
        """Digest a checkpoint, the settings that matter, and the rollouts behind the NMAE.

        ``dataset`` has the settings of the one whose rollouts are used, if any. One that was
        collected as ``settings`` say gives the same rollouts, and the same digest.

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
        if sensor := values.get("sensor"):
            measured["sensor"] = sensor
        if system := definition(values["plant"]):
            measured["system"] = system
        if control := values.get("control"):
            measured["control"] = control
        if conditions:  # or digests would not be those of before there were conditions
            measured["conditions"] = conditions
        fitted = [values["collect"][key] for key in FITTED]
        if _starts(values["collect"]) != starts:  # the dataset's are in ``clean``, these nowhere
            fitted.append(_starts(values["collect"]))
        if wrong := _belief_steps(settings):
            fitted.append(wrong)
        if not settings.protocol.ideal_link:
            measured["link"] = LINK_VERSION
        payload = settings.protocol.payload
        if CODECS[payload].fitted or settings.protocol.false_alarm:
            measured["fitted"] = fitted
        if plugin := CODECS.source(payload):
            measured["codec"] = plugin.sha256
        return cls(checkpoint, _sha256(measured), _sha256(fitted))

    def as_dict(self) -> dict[str, Any]:
        """Return it as it stands in a file, for all of its methods."""
        return {name: value for name, value in vars(self).items() if name != "fitted"}


def _belief_steps(settings: Settings) -> dict[str, int]:
    """Return how long a tuned law goes by a wrong belief, of trajectories that it drives.

    Nothing of the usual time, which all curves have that were measured before this was looked at:
    they stay valid.
    """
    steps = settings.collect.belief_steps
    tells = bool(settings.control.gains_n) and steps != CollectSettings().belief_steps
    return {"belief_steps": steps} if tells else {}


def _starts(collected: Mapping[str, Any]) -> list[Any]:
    return [*(collected[key] for key in RANGES), *collected.get("start", [])]


def read(path: Path, digest: Digest, *, named: bool = False) -> dict[str, Entry]:
    """Return the entries in ``path`` by method; none if it is not there or of another digest.

    A file from before there were seals is no cache: without a seal there are none either, and an
    :class:`~hjepa_cli.errors.Unsealed` warning, unless a person ``named`` it.

    Raises:
        DataError: not a file of curves, or changed after it was written.
    """
    if not path.exists():
        return {}
    document = seals.read(path, SCHEMA, AGAIN)
    methods, of = document.get("methods"), document.get("digest")
    if not (isinstance(methods, dict) and isinstance(of, dict)):
        raise DataError(f"{path} holds no valid curves: no methods or no digest", hint=AGAIN)
    for name, entry in methods.items():
        if reason := flaw(entry, complete=of.get("loop_version") == LOOP_VERSION):
            raise DataError(f"{path} holds no valid curves: method '{name}': {reason}", hint=AGAIN)
    if of != digest.as_dict():
        return {}
    if seals.SEAL not in document and not named:
        seals.warn(path, "its curves are not used; --remeasure replaces them")
        return {}
    return {
        name: entry
        for name, entry in document["methods"].items()
        if _depends_on(name, digest).items() <= entry.items()
    }


def find(
    digest: Digest, methods: Iterable[str], places: Iterable[Path], *, root: Path = ROOT
) -> dict[str, tuple[Entry, Path]]:
    """Look for methods in ``places``, then in the runs of ``eval`` and ``scale``, newest first.

    Damaged files of old runs are passed over, those of ``places`` are a DataError.

    Returns:
        Entry and the file it came from, for the methods that were found.
    """
    wanted, found = list(methods), dict[str, tuple[Entry, Path]]()

    def take(path: Path) -> None:
        for name, entry in read(path, digest).items():
            if name in wanted:
                found.setdefault(name, (entry, path))

    for path in places:
        take(path)
    if found.keys() >= set(wanted):
        return found
    pattern = f"*/{Path(CURVES_FILE).stem}*.json"
    old = [path for stage in ("eval", "scale") for path in (root / stage).glob(pattern)]
    old = [path for path in old if path.is_file()]
    for path in sorted(old, key=lambda path: path.stat().st_mtime_ns, reverse=True):
        with contextlib.suppress(HjepaError), warnings.catch_warnings():
            warnings.simplefilter("ignore", Unsealed)
            take(path)
    return found


def _depends_on(name: str, digest: Digest) -> dict[str, str]:
    """Return what a method's entry must say beside the digest of its file."""
    method, late, _ = name.partition(LATE)
    link = {"link": str(LINK_VERSION)} if late else {}
    if method not in METHODS:  # of a plugin that is not in force: kept, as nobody can ask for it
        return {}
    fitted = {"fitted_to": digest.fitted} if METHODS[method].fitted else {}
    source = METHODS.source(method)
    return fitted | link | ({"plugin": source.sha256} if source else {})


def further_file(digest: Digest) -> str:
    """Name the file in a run for curves of another model than the first one."""
    return f"{Path(CURVES_FILE).stem}-{(digest.checkpoint or '')[:12]}.json"


def write(path: Path, digest: Digest, entries: Mapping[str, Entry]) -> None:
    """Add entries to ``path``, keeping those of the same digest, replacing all others."""
    with files.taking_turns(path.parent):  # two evaluations may share a model's file
        kept: dict[str, Entry] = {}
        with contextlib.suppress(DataError), warnings.catch_warnings():
            warnings.simplefilter("ignore", Unsealed)
            kept = read(path, digest)  # damaged and unsealed curves are replaced like foreign ones
        methods = files.jsonable(kept | dict(entries))
        for name, entry in methods.items():
            entry.update(_depends_on(name, digest))
        document = {"schema": SCHEMA, "digest": digest.as_dict(), "methods": methods}
        files.write_json(path, seals.sealed(document))


def _sha256(value: object) -> str:
    return hashlib.sha256(files.canonical_json(value).encode()).hexdigest()


def flaw(entry: Any, *, complete: bool = False) -> str | None:
    """Return what keeps an entry from being used, if anything.

    A ``complete`` one is of the present version, and must have all that came later too.
    """
    try:
        found = msgspec.convert(entry, _Measured)
    except msgspec.ValidationError as error:
        return str(error)
    if len(found.nmae) != len(found.nmae_ci95):
        return f"{len(found.nmae)} values of 'nmae' and {len(found.nmae_ci95)} of 'nmae_ci95'"
    inside = [
        ("score", found.score, found.score_ci95),
        ("tolerance_gap_steps", found.tolerance_gap_steps, found.tolerance_gap_ci95),
        ("tolerance_p", found.tolerance_p, found.tolerance_p_ci95),
        ("nmae_every_step", found.nmae_every_step, found.nmae_every_step_ci95),
        *(("nmae", *pair) for pair in zip(found.nmae, found.nmae_ci95, strict=True)),
        *(("a point of a curve", point.score, point.ci95) for point in found.points()),
    ]
    for name, value, interval in inside:
        low, high = interval or (None, None)
        if value is not None and low is not None and high is not None:
            slack = ROUNDING * max(1.0, abs(value))
            if not (low <= high and low - slack <= value <= high + slack):
                return f"'{name}' is {value:.6g}, its interval {low:.6g} … {high:.6g}"
    known = (field.name for field in msgspec.structs.fields(_Measured) if complete)
    missing = (name for name in known if name not in entry and not name.endswith("_bracket"))
    return next((f"'{name}' is missing" for name in missing), None)


# Bounds beyond anything that is measured keep arithmetic in range.
_Number = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
_NotNegative = Annotated[float, msgspec.Meta(ge=0, le=LARGEST)]
_Count = Annotated[int, msgspec.Meta(ge=1, le=int(LARGEST))]
_CountOr0 = Annotated[int, msgspec.Meta(ge=0, le=int(LARGEST))]
_Interval = tuple[_Number, _Number]
_Gap = Annotated[float, msgspec.Meta(ge=0, le=LONGEST_STEPS)]
_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class _GapPoint(msgspec.Struct):
    d: _Gap
    score: _NotNegative
    ci95: tuple[_Number | None, _Number | None] | None = None


class _DeliveryPoint(msgspec.Struct):
    p: _Share
    score: _NotNegative
    ci95: tuple[_Number | None, _Number | None] | None = None


class _Measured(msgspec.Struct, kw_only=True):
    """It is what ``eval --json`` prints of a method; older results lack what has a default."""

    score: _NotNegative
    score_ci95: _Interval
    lq_ratio: _Number
    nmae: list[_NotNegative]
    nmae_ci95: list[_Interval]
    nmae_windows: dict[str, _Number | None]
    gap_curve: list[_GapPoint]
    delivery_curve: list[_DeliveryPoint]
    tolerance_gap_steps: _Gap | None
    tolerance_gap_ci95: _Interval | None
    tolerance_gap_censored: bool | None
    tolerance_gap_lq_steps: _Gap | None
    tolerance_p: _Share | None
    tolerance_p_ci95: _Interval | None
    tolerance_p_censored: bool | None
    bits_per_transmission: _CountOr0 | None
    n_devices: _Count
    n_curve_devices: _Count
    n_rollouts: _Count
    nmae_every_step: _Number = 0.0
    nmae_every_step_ci95: _Interval = (0.0, 0.0)
    tolerance_gap_in_band: _Share | None = None
    tolerance_gap_lq_ratio: _Number | None = None
    tolerance_gap_lost: _Share | None = None
    tolerance_p_in_band: _Share | None = None
    tolerance_p_lq_ratio: _Number | None = None
    tolerance_p_lost: _Share | None = None
    warmup_steps: _CountOr0 = 0
    scored_steps: _Count = 1
    gap_bracket: list[_GapPoint] = []
    delivery_bracket: list[_DeliveryPoint] = []

    def points(self) -> Iterable[_GapPoint | _DeliveryPoint]:
        return itertools.chain(
            self.gap_curve, self.delivery_curve, self.gap_bracket, self.delivery_bracket
        )
