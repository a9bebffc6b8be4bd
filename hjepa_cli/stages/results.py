"""The result of a finished run is checked before it is shown: it may be anybody's.

A seal tells that a result was not changed; only its values tell that it is one of its stage.
"""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.plugins import LAWS
from hjepa_cli.storage import runs

LARGEST = 1e100  # bounds beyond anything that is measured keep arithmetic in range

Number = Annotated[float, Meta(ge=-LARGEST, le=LARGEST)]
NotNegative = Annotated[float, Meta(ge=0, le=LARGEST)]
Positive = Annotated[float, Meta(gt=1e-100, le=LARGEST)]
Probability = Annotated[float, Meta(ge=0, le=1)]
Whole = Annotated[int, Meta(ge=0, le=10**18)]
Interval = tuple[NotNegative, NotNegative]
Windows = dict[str, Number | None]


class _Gate(msgspec.Struct):
    value: Number | None
    threshold: Number
    passed: bool


class _Strides(msgspec.Struct):
    h: Whole | str
    m: Whole | str
    l: Whole | str


class _Decay(msgspec.Struct):
    gain: Number | None = None
    tau_steps: Number | None = None


class _Reflex(_Decay, kw_only=True):
    law: _Decay


class _Row(msgspec.Struct):
    snr_db: Number
    method: str
    devices: NotNegative | None
    devices_ci95: Interval | None
    at_least: bool | None
    bits_per_s: NotNegative | None
    bits_per_transmission: NotNegative | None = None
    ratio_to_limit: NotNegative | None = None
    scheduler: str | None = None
    reason: str | None = None
    load_per_block: NotNegative | None = None
    load_ci95: Interval | None = None
    tolerance: NotNegative | None = None
    tolerance_ci95: Interval | None = None
    delay_steps: NotNegative | None = 0
    reports_per_block_slot: NotNegative | None = None
    coverage: Probability | None = None


class _Gain(msgspec.Struct):
    method: str
    over: str
    snr_db: Number
    ratio: NotNegative | None
    ratio_ci95: tuple[NotNegative | None, NotNegative | None]


class _Trained(msgspec.Struct):
    checkpoint: str
    seconds: NotNegative


class _Encoder(_Trained):
    gates: dict[str, _Gate]


class _Hierarchy(_Trained):
    strides: _Strides
    nmae_windows: Windows
    method: str = "hjepa"


class _Reflexes(_Trained):
    reflex: _Reflex
    nmae_windows: Annotated[dict[str, Windows], Meta(min_length=1)]
    n_rollouts: Whole


class _Fusion(_Trained):
    packets: Whole
    distances: dict[str, Number]


class _StressPoint(msgspec.Struct):
    score: Number
    ci95: tuple[Number, Number]
    relative: Number | None
    relative_ci95: tuple[Number, Number] | None
    flagged: Number | None = None


class _StressRow(msgspec.Struct):
    condition: str
    points: list[_StressPoint]


class _StressEntry(msgspec.Struct):
    nominal: Annotated[list[_StressPoint], Meta(min_length=1)]
    rows: list[_StressRow]
    means: list[_StressPoint]


class _Stress(msgspec.Struct):
    """The result of ``eval --stress``, of a simulated plant."""

    gaps: Annotated[list[Whole], Meta(min_length=1)]
    conditions: list[str]
    n_devices: Whole
    warmup_steps: Whole
    scored_steps: Whole
    methods: dict[str, _StressEntry]


class _Evaluation(msgspec.Struct):
    plant: str
    seed: Whole
    checkpoint: str | None
    methods: dict[str, dict[str, Any]]
    checkpoints: dict[str, str] = {}
    acceptable_score: Number = 0.0
    acceptable_lq_ratio: Number = 0.0
    source: str = ""
    stress: _Stress | None = None
    link: dict[str, Number] = {}


class _OfflineEntry(msgspec.Struct):
    n_rollouts: Whole
    nmae: list[NotNegative]
    nmae_ci95: list[Interval]
    nmae_windows: Windows
    nmae_every_step: NotNegative | None
    steps_within: dict[str, Whole]
    bits_per_transmission: NotNegative


class _OfflineRow(msgspec.Struct):
    condition: str
    methods: dict[str, _OfflineEntry]


class _Latent(msgspec.Struct):
    steps: list[Whole]
    error: list[Number]
    still: list[Number]


class _Offline(msgspec.Struct):
    """The result of ``eval`` of a recorded plant."""

    plant: str
    seed: Whole
    step_s: Positive
    checkpoint: str | None
    dataset: str
    split: str
    methods: Annotated[dict[str, _OfflineEntry], Meta(min_length=1)]
    latent: dict[str, _Latent]
    probe_r2: Windows
    conditions: list[_OfflineRow] = []


class _Scale(msgspec.Struct):
    rows: Annotated[list[_Row], Meta(min_length=1)]
    seed: Whole
    acceptable_score: Number
    law: str
    bandwidth_hz: Positive
    slot_s: Positive
    n_devices: Whole
    limit_bits_per_s: NotNegative
    paper_gain_percent: Number
    gains: list[_Gain]
    csv: str = ""
    figures: list[str] = []
    phy: str = "shannon"
    noise: str = "fixed"
    tolerance_steps: Positive | None = None
    link: dict[str, Number] = {}


class _Lost(msgspec.Struct):
    gap_steps: Positive
    p_lost: Probability
    p_lost_ci95: tuple[Probability, Probability]
    p_left_band: Probability
    back_steps_median: NotNegative | None
    back_steps_p95: NotNegative | None


class _Losses(msgspec.Struct):
    method: str
    interval_steps: Positive
    points: Annotated[list[_Lost], Meta(min_length=1)]


class _SurvivalTime(msgspec.Struct):
    method: str
    transfer_interval_s: Positive
    loss_probability: Probability
    how: str
    at_least: bool
    survival_steps: NotNegative
    survival_ci95: tuple[NotNegative, NotNegative | None]
    tolerance_gap_steps: NotNegative | None
    availability: Probability | None
    tolerated_loss: Probability
    tolerated_loss_bursts: Probability
    devices: Whole
    snr_db: Number


class _Survival(msgspec.Struct):
    plant: str
    seed: Whole
    step_s: Positive
    n_loops: Annotated[int, Meta(ge=1, le=10**18)]
    phy: str
    bandwidth_hz: Positive
    mean_time_h: Positive
    rows: Annotated[list[_SurvivalTime], Meta(min_length=1)]
    curves: Annotated[list[_Losses], Meta(min_length=1)]
    figures: list[str] = []
    link: dict[str, Number] = {}


class _Wire(msgspec.Struct):
    model: str
    method: str
    plant: str
    seed: Whole
    devices: Whole
    steps: Whole
    lockstep: bool
    period_ms: Positive | None
    score_link: Number
    score_link_ci95: tuple[Number, Number]
    score_simulated: Number
    score_simulated_ci95: tuple[Number, Number]
    score_difference: Number
    score_difference_ci95: tuple[Number, Number]
    n_devices: Whole
    n_steps: Whole
    missing_share: NotNegative
    late_answers_share: NotNegative
    ages: dict[str, Whole]
    sources: dict[str, Whole]
    skipped_strides: Whole
    theta_difference_rad: dict[str, NotNegative] = {}
    fallen_share: NotNegative | None = None
    taken_up_after_s: NotNegative | None = None


RESULTS = {
    "train-encoder": _Encoder,
    "train-hierarchy": _Hierarchy,
    "train-reflex": _Reflexes,
    "train-fusion": _Fusion,
    "eval": _Evaluation,
    "scale": _Scale,
    "survive": _Survival,
    "bench-link": _Wire,
}


class _Protocol(msgspec.Struct):
    acceptable_score: Number


class _Config(msgspec.Struct):
    """A report draws with this much of a run's settings."""

    plant: str
    methods: list[str]
    protocol: _Protocol


@contextlib.contextmanager
def showing(stage: str, result: Mapping[str, Any] | None, directory: Path) -> Iterator[None]:
    """Check a recorded result, none of a new run, and turn what it lacks inside into DataError."""
    if result is not None and stage in RESULTS:
        check(stage, result, directory)
    try:
        yield
    except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError) as error:
        if result is None:
            raise
        raise damaged(directory, stage, error) from None


def check(stage: str, result: Mapping[str, Any], directory: Path) -> None:
    """Raise DataError unless a result is one that the stage, one of :data:`RESULTS`, writes."""
    if reason := _flaw(stage, result):
        raise damaged(directory, stage, reason)


def check_config(stage: str, config: Mapping[str, Any], directory: Path) -> None:
    """Raise DataError unless a run's settings have what is shown with its result."""
    try:
        msgspec.convert(config, _Config)
        plant(config["plant"])
    except (msgspec.ValidationError, UsageError) as error:
        raise damaged(directory, stage, error, runs.CONFIG) from None


def damaged(directory: Path, stage: str, reason: object, name: str = runs.RESULT) -> DataError:
    """Return the error of a run whose file is not what its stage writes."""
    return DataError(
        f"{directory / name} lacks what a {stage} run has: {reason}",
        hint=runs.anew(runs.read_environment(directory), directory / runs.CONFIG),
    )


def _flaw(stage: str, result: Mapping[str, Any]) -> str | None:
    """Return what keeps a result from being shown, if anything."""
    if stage not in RESULTS:
        return "its stage is none of ours"
    offline = stage == "eval" and bool(result.get("offline"))
    try:
        msgspec.convert(result, _Offline if offline else RESULTS[stage])
    except msgspec.ValidationError as error:
        return str(error)
    if offline:
        return _offline_flaw(result)
    if stage == "eval":
        if reason := _stress_flaw(result.get("stress")):
            return reason
        entries = result["methods"]
        former = {"tolerance_gap_lq_steps": None}  # which older ones lack
        flaws = ((name, curves.flaw(former | entry)) for name, entry in entries.items())
        if found := next(((name, reason) for name, reason in flaws if reason), None):
            return f"method '{found[0]}': {found[1]}"
        return _unlike("methods", [entry["nmae_windows"] for entry in entries.values()])
    if stage == "train-reflex":
        return _unlike("methods", list(result["nmae_windows"].values()))
    if stage == "scale":
        if result["law"] not in LAWS:
            return f"law '{result['law']}' is of no plugin in force"
        at: dict[tuple[str, str | None], list[float]] = {}
        for row in result["rows"]:
            at.setdefault((row["method"], row.get("scheduler")), []).append(row["snr_db"])
        if len({tuple(sorted(snrs)) for snrs in at.values()}) > 1:
            return "its methods are not all counted at the same SNRs"
    return None


def _stress_flaw(stress: Mapping[str, Any] | None) -> str | None:
    """Return what keeps scores under conditions from being shown, if anything."""
    if stress is None:
        return None
    for name, entry in stress["methods"].items():
        if [row["condition"] for row in entry["rows"]] != stress["conditions"]:
            return f"stress of '{name}': its rows are not the conditions"
        rows = [entry["nominal"], *(row["points"] for row in entry["rows"])]
        rows += [entry["means"]] if entry["means"] else []  # none of no conditions
        if any(len(row) != len(stress["gaps"]) for row in rows):
            return f"stress of '{name}': a row has not one point for each gap"
    return None


def _offline_flaw(result: Mapping[str, Any]) -> str | None:
    """Return what keeps an evaluation on recordings from being shown, if anything."""
    entries = result["methods"]
    for name, entry in entries.items():
        if len(entry["nmae"]) != len(entry["nmae_ci95"]):
            return f"method '{name}': its errors and their intervals are not as many"
    for name, of in result["latent"].items():
        if not len(of["steps"]) == len(of["error"]) == len(of["still"]):
            return f"latent of '{name}': its lists are not equally long"
    every = [*entries.values()]
    for row in result.get("conditions", []):
        if {*row["methods"]} != {*entries}:
            return f"condition '{row['condition']}' is not of the methods"
        every += row["methods"].values()
    return _unlike("methods", [entry["nmae_windows"] for entry in every]) or _unlike(
        "methods", [entry["steps_within"] for entry in every]
    )


def _unlike(what: str, windows: list[dict[str, Any]]) -> str | None:
    """Return the complaint where not all have the same keys, windows of steps as a rule."""
    return f"its {what} have different windows" if len({*map(frozenset, windows)}) > 1 else None
