"""``hjepa compare RUN…`` shows evaluations of several trainings in one table and one figure.

Runs of ``eval`` whose models were trained with different seeds → per method the mean over
trainings with Student's 95 % interval, and the first method against every other one, paired
within a training. Runs that do not belong into one picture are refused.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from hjepa_cli.config.checks import check_methods, needs_model, without_model
from hjepa_cli.config.schema import dotted
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.curves import Entry
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.statistics import student_interval
from hjepa_cli.errors import DataError, MissingInputError, UsageError, require, shell
from hjepa_cli.output.looks import Looks
from hjepa_cli.output.screen import Screen, span, tolerance
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.report import NO_RESULT, found_runs, stage_of
from hjepa_cli.stages.results import check_config
from hjepa_cli.storage import runs

AVERAGED = {  # of an entry of ``eval --json``, and where its interval goes
    "nmae": "nmae_ci95",
    "nmae_every_step": "nmae_every_step_ci95",
    "score": "score_ci95",
    "tolerance_gap_steps": "tolerance_gap_ci95",
    "tolerance_p": "tolerance_p_ci95",
}
LARGEST = ("bits_per_transmission", "tolerance_gap_censored", "tolerance_p_censored")
ALIKE = ("plant", "loop_version", "horizon", "acceptable_score", "acceptable_lq_ratio")

ByMethod = dict[str, dict[int, Entry]]
"""Entries by method and seed: of the training, or without one of the evaluation."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """It is a finished run of ``eval``; its models, if any, come from one training seed."""

    directory: Path
    result: Mapping[str, Any]
    config: Mapping[str, Any]
    dataset: str | None
    training_seed: int | None
    grids: Mapping[str, Any]

    def seed_of(self, method: str) -> int:
        """Return the training's seed, or of a method without a model the evaluation's."""
        if not needs_model(method) or self.training_seed is None:
            return int(self.result["seed"])
        return self.training_seed

    def alike(self) -> dict[str, Any]:
        """Return what must agree in all runs that are compared."""
        sections = {name: self.config[name] for name in ("protocol", "conditions", "collect")}
        sections["sensor"] = self.config.get("sensor", {})
        clean = (*curves.CLEAN, "start")
        sections["collect"] = {k: v for k, v in sections["collect"].items() if k in clean}
        return {key: self.result[key] for key in ALIKE} | dotted(sections) | self.grids

    def draws(self) -> dict[str, Any]:
        """Return what must agree within a training besides: methods share their draws there."""
        return {"seed": self.result["seed"], "dataset": self.dataset}


class _Result(msgspec.Struct):
    """A comparison relies on this much of a result of ``eval``."""

    plant: str
    loop_version: int
    horizon: list[int]
    acceptable_score: float
    acceptable_lq_ratio: float
    seed: int
    training_seeds: dict[str, Any]
    methods: dict[str, Any]


class _Config(msgspec.Struct):
    protocol: dict[str, Any]
    conditions: dict[str, Any]
    collect: dict[str, Any]


def run(
    screen: Screen,
    paths: Sequence[Path],
    *,
    methods: Sequence[str] | None = None,
    figures: Path | None = None,
    formats: Sequence[str] = ("pdf",),
    title: str | None = None,
    labels: Sequence[str] | None = None,
    log: bool | None = None,
) -> dict[str, Any]:
    """Compare evaluations; return the document of ``--json``.

    Args:
        screen: shows the tables.
        paths: runs of ``eval``, or directories that hold some; none: ``runs/eval``.
        methods: these, in this order, the first against the others; default: all that were found.
        figures, formats: a directory for the paper's Fig. 3, with bands over trainings, and how.
        title, labels, log: of the figure, as :meth:`hjepa_cli.output.looks.Looks.of`.

    Raises:
        UsageError: no such method, or how a figure looks that is not drawn.
        MissingInputError: no runs, fewer than two trainings, or a method that a training lacks.
        DataError: runs of different plants, protocols or versions, two models of one seed, or a
            result that no ``eval`` wrote.
    """
    if methods is not None:
        check_methods(tuple(methods))
    asked = Looks.of(title, labels, log)
    asked.check_drawn(figures is not None, "hjepa compare --figures DIR")
    if figures is not None:
        require("matplotlib", "a figure needs matplotlib", "plot")
    found = [open_evaluation(directory, methods) for directory in evaluations(paths)]
    if any(one.config["preset"] == runs.SMOKE for one in found):
        screen.say(NO_RESULT)
    check_alike(found)
    by_method, seeds = collected(found, methods)
    first = found[0].result
    document = {
        "plant": first["plant"],
        "training_seeds": seeds,
        "acceptable_score": first["acceptable_score"],
        "horizon": first["horizon"],
        "methods": {
            name: averaged(list(of.values()))
            | {"n_trainings": 0 if not needs_model(name) else len(of)}
            for name, of in by_method.items()
        },
        "differences": differences(by_method),
        "runs": [one.directory for one in found],
    }
    show(document, screen)
    document["figures"] = []
    if figures is not None:
        document["figures"] = draw(document, asked, figures, formats, screen)
    return document


def evaluations(paths: Sequence[Path]) -> list[Path]:
    """Return the finished runs of ``eval`` among and below ``paths``. Raises MissingInputError."""
    places = list(paths) or [runs.ROOT / "eval"]
    found = [one for one in found_runs(places, "hjepa eval") if stage_of(one) == "eval"]
    if not found:
        where = ", ".join(map(str, places))
        raise MissingInputError(f"no finished run of eval in {where}", hint="hjepa eval")
    return found


def open_evaluation(directory: Path, methods: Sequence[str] | None) -> Evaluation:
    """Open one run, reduced to ``methods``.

    Raise DataError for no result of ``eval``, an older one, or models of several trainings.
    """
    result, config = runs.read_result(directory), runs.read_config(directory)
    check_config("eval", config, directory)
    environment = runs.read_environment(directory)
    if reason := flaw(result, config):
        again = runs.anew(environment, directory / runs.CONFIG)
        given = () if environment["inputs"].get("remeasure") is True else ("--remeasure",)
        again += f" {shell([*given, '--out', f'{directory}-again'])}"
        raise DataError(
            f"{directory / runs.RESULT}: {reason}",
            hint=f"leave it out, or in its place: {again}",
        )
    all_of = result["methods"]
    entries = {name: all_of[name] for name in all_of if methods is None or name in methods}
    dataset = environment["inputs"].get("dataset")
    return Evaluation(
        directory,
        result | {"methods": entries},
        config | {"preset": environment.get("preset")},
        dataset["sha256"] if isinstance(dataset, dict) else None,
        training_seed(directory, result["training_seeds"], entries),
        _grids(next(iter(all_of.values()))) if all_of else {},
    )


def flaw(result: Mapping[str, Any], config: Mapping[str, Any]) -> str | None:
    """Say why a run cannot be compared with others, if anything is wrong with it."""
    if result.get("offline"):
        return "it was measured on recordings, without closed loops to compare"
    try:
        msgspec.convert(result, _Result)
        msgspec.convert(config, _Config)
        plant(result["plant"])
    except UsageError as error:
        return error.message
    except msgspec.ValidationError as error:
        return f"{error} (an older version?)"
    steps, first = len(result["horizon"]), next(iter(result["methods"].values()), None)
    for name, entry in result["methods"].items():
        if reason := curves.flaw(entry):
            return f"method '{name}': {reason}"
        for key in ("nmae_every_step", "nmae_windows_ci95"):
            if key not in entry:
                return f"method '{name}': no '{key}' (an older version?)"
        if not steps == len(entry["nmae"]) == len(entry["nmae_ci95"]):
            return f"method '{name}': 'nmae' is not over the horizon"
        if _grids(entry) != _grids(first):
            return f"method '{name}' was not measured at the points of the others"
    return None


def _grids(entry: Entry) -> dict[str, Any]:
    """Return where a method was measured: windows of steps, gaps, delivery probabilities."""
    return {
        "windows": sorted(entry["nmae_windows"]),
        "gaps": [point["d"] for point in entry["gap_curve"]],
        "probabilities": [point["p"] for point in entry["delivery_curve"]],
    }


def training_seed(
    directory: Path, seeds: Mapping[str, Any], entries: Mapping[str, Entry]
) -> int | None:
    """Return the one seed of the models of ``entries``; None if they need no model.

    Raise DataError where it is not known, or where there are several.
    """
    of = {name: seeds.get(name) for name in entries if needs_model(name)}
    for name, seed in of.items():
        if type(seed) is not int:
            raise DataError(
                f"the model of {name} in {directory} does not say with which seed it was trained",
                hint="leave the run or the method (--methods) out, or train the model again",
            )
    if len(set(of.values())) > 1:
        named = ", ".join(f"{name}: {seed}" for name, seed in of.items())
        raise DataError(
            f"the models of {directory} were trained with different seeds ({named})",
            hint="choose --methods of one seed, or hjepa eval --checkpoint PATH --methods … for "
            "the models of each",
        )
    return next(iter(of.values()), None)


def check_alike(found: Sequence[Evaluation]) -> None:
    """Refuse what is not measured alike. Raises DataError naming the difference."""
    of_training: dict[int, Evaluation] = {}
    for other in found:
        checks = [(found[0], found[0].alike(), other.alike())]
        if other.training_seed is not None:
            peer = of_training.setdefault(other.training_seed, other)
            checks.append((peer, peer.draws(), other.draws()))
        for one, ours, theirs in checks:
            for key in dict.fromkeys((*ours, *theirs)):
                if ours.get(key) != theirs.get(key):
                    raise DataError(
                        f"{key} is {ours.get(key)!r} in {one.directory}, {theirs.get(key)!r} in "
                        f"{other.directory}: not to be compared",
                        hint="name runs that were measured alike, or measure one again",
                    )


def collected(
    found: Sequence[Evaluation], methods: Sequence[str] | None
) -> tuple[ByMethod, list[int]]:
    """Return entries by method and seed, and the training seeds, one set for all trained methods.

    Raise MissingInputError for fewer than two trainings, or not the same ones for every method, and
    DataError for two models of one method and one seed.
    """
    by_method: ByMethod = {}
    sources: dict[tuple[str, int], Path] = {}
    for one in found:
        for name, entry in one.result["methods"].items():
            seed = one.seed_of(name)
            source = sources.setdefault((name, seed), one.directory)
            known = by_method.setdefault(name, {}).setdefault(seed, entry)
            # Measured again elsewhere, what needs no model may differ in the last digits.
            if needs_model(name) and known != entry:
                raise DataError(
                    f"two measurements of {name} with training seed {seed}: {source} and "
                    f"{one.directory}",
                    hint="hjepa compare RUN…, with the runs that belong together",
                )
    seeds = sorted({one.training_seed for one in found if one.training_seed is not None})
    if len(seeds) < 2:
        of = f"these are all of seed {seeds[0]}" if seeds else "these have no model at all"
        raise MissingInputError(
            f"a comparison over trainings needs two of them; {of}",
            hint="train and evaluate with another --seed (docs/how-to/studies.md), or hjepa report",
        )
    others = sorted(by_method.keys() - set(METHODS))
    order = methods or [*(name for name in METHODS if name in by_method), *others]
    for name in order:
        known_seeds = by_method.get(name, {})
        missing = [seed for seed in seeds if seed not in known_seeds]
        if not needs_model(name) and not known_seeds:
            raise MissingInputError(f"{name} was not measured", hint=f"hjepa eval --methods {name}")
        if needs_model(name) and missing:
            raise MissingInputError(
                f"{name} was not measured with training seed {', '.join(map(str, missing))}",
                hint=f"hjepa eval --methods {name} with a model of that seed, or leave it out: "
                "--methods",
            )
    return {name: dict(sorted(by_method[name].items())) for name in order}, seeds


def averaged(entries: Sequence[Entry]) -> Entry:
    """Return the entry of a method over its trainings: means, Student's intervals over trainings.

    Of a single entry (what needs no training, measured on the same draws every time) the interval
    stays its own, over devices or rollouts.
    """
    windows = ("nmae_windows", "nmae_windows_ci95")
    if len(entries) == 1:
        kept = (*LARGEST, *windows, "gap_curve", "delivery_curve", *AVERAGED, *AVERAGED.values())
        return {key: entries[0][key] for key in kept}
    mean: Entry = {name: {} for name in windows}
    for key in LARGEST:
        values = [entry[key] for entry in entries]
        mean[key] = None if None in values else max(values)
    for key, interval in AVERAGED.items():
        values, most = [entry[key] for entry in entries], 1.0 if key == "tolerance_p" else np.inf
        mean[key], mean[interval] = over_trainings(values, 0.0, most)
    for window in entries[0]["nmae_windows"]:
        values = [entry["nmae_windows"][window] for entry in entries]
        for name, value in zip(windows, over_trainings(values, 0.0), strict=True):
            mean[name][window] = value
    for curve, where in (("gap_curve", "d"), ("delivery_curve", "p")):
        mean[curve] = []
        for points in zip(*(entry[curve] for entry in entries), strict=True):
            score, ci95 = over_trainings([point["score"] for point in points], 0.0)
            mean[curve].append({where: points[0][where], "score": score, "ci95": ci95})
    return mean


def over_trainings(
    values: Sequence[Any], least: float = -np.inf, most: float = np.inf
) -> tuple[Any, Any]:
    """Return mean and 95 % interval of numbers or of equally long lists of them; None stays None.

    The interval is cut to ``least`` … ``most``, the range of the values.
    """
    if None in values:
        return None, None
    array = np.array(values, float)
    interval = np.clip(student_interval(array), least, most)
    return array.mean(axis=0).tolist(), interval.T.tolist()


def differences(
    by_method: Mapping[str, Mapping[int, Entry]], left_out: Sequence[str] | None = None
) -> list[dict[str, Any]]:
    """Compare the first method with each other one, paired within trainings.

    Methods without a model, or those ``left_out``, are not paired: no training of theirs differs.

    Returns:
        Per other method: ``nmae_windows`` and ``nmae_every_step``, first minus other;
        ``tolerance_gap_ratio``, D* of the first ÷ the other's; and ``tolerance_p_ratio``, p* of the
        other ÷ the first's, so that more than 1 is the first method's lead in both. Each has
        ``mean`` and ``ci95``; of a ratio the geometric mean, its interval taken on the logarithm,
        and ``None`` where a tolerance is a bound only.
    """
    first, *others = by_method
    found: list[dict[str, Any]] = []
    for other in others:
        if {first, other} & set(without_model() if left_out is None else left_out):
            continue
        pairs = [(by_method[first][s], by_method[other][s]) for s in by_method[first]]
        both = [(a["nmae_windows"], b["nmae_windows"]) for a, b in pairs]
        every = [a["nmae_every_step"] - b["nmae_every_step"] for a, b in pairs]
        found.append(
            {
                "method": first,
                "over": other,
                "nmae_windows": {w: _described([a[w] - b[w] for a, b in both]) for w in both[0][0]},
                "nmae_every_step": _described(every),
                "tolerance_gap_ratio": _ratio(pairs, "gap_steps", "gap"),
                "tolerance_p_ratio": _ratio([(b, a) for a, b in pairs], "p", "p"),
            }
        )
    return found


def _ratio(pairs: Sequence[tuple[Entry, Entry]], key: str, kind: str) -> dict[str, Any] | None:
    """Return the geometric mean of the ratio of a tolerance, first ÷ second, with its interval."""
    values = [tuple(entry[f"tolerance_{key}"] for entry in pair) for pair in pairs]
    censored = any(entry[f"tolerance_{kind}_censored"] for pair in pairs for entry in pair)
    nothing_suffices = {"gap_steps": 0.0, "p": 1.0}[key]
    if censored or any(nothing_suffices in pair for pair in values):
        return None
    mean, ci95 = over_trainings([math.log(a / b) for a, b in values])
    return {"mean": math.exp(mean), "ci95": [math.exp(end) for end in ci95]}


def _described(values: Sequence[float]) -> dict[str, Any]:
    return dict(zip(("mean", "ci95"), over_trainings(values), strict=True))


def show(document: Mapping[str, Any], screen: Screen) -> None:
    """Print the means, then the differences."""
    entries = document["methods"]
    windows = list(next(iter(entries.values()))["nmae_windows"])
    seeds = ", ".join(map(str, document["training_seeds"]))
    screen.table(
        f"{document['plant']}, training seeds {seeds}: mean (95 % CI over trainings; of methods "
        f"without a model over draws), tolerances at score "
        f"{document['acceptable_score']:g}",
        ["method", *(f"NMAE {w}" for w in windows), "every packet", "gap D* [steps]", "p*"],
        [
            [
                name,
                *(
                    span(entry["nmae_windows"][w], entry["nmae_windows_ci95"][w], 4)
                    for w in windows
                ),
                span(entry["nmae_every_step"], entry["nmae_every_step_ci95"], 4),
                tolerance(entry, "gap_steps", "gap", 1, "≥"),
                tolerance(entry, "p", "p", 4, "≤"),
            ]
            for name, entry in entries.items()
        ],
    )
    found = document["differences"]
    if not found:
        return
    screen.table(
        f"{found[0]['method']} minus the other, in NMAE; its gap D* ÷ the other's, and the other's "
        "p* ÷ its own: mean (95 % CI), paired within trainings",
        ["other", *(f"NMAE {w}" for w in windows), "every packet", "D* ratio", "p* ratio"],
        [
            [
                one["over"],
                *(_spanned(one["nmae_windows"][w], 4) for w in windows),
                _spanned(one["nmae_every_step"], 4),
                _spanned(one["tolerance_gap_ratio"], 3),
                _spanned(one["tolerance_p_ratio"], 3),
            ]
            for one in found
        ],
    )


def _spanned(found: Mapping[str, Any] | None, decimals: int) -> str | None:
    return None if found is None else span(found["mean"], found["ci95"], decimals)


def draw(
    document: Mapping[str, Any],
    asked: Looks,
    directory: Path,
    formats: Sequence[str],
    screen: Screen,
) -> list[Path]:
    """Write the paper's Fig. 3, bands over trainings, as ``trainings.<format>``."""
    from hjepa_cli.output.comparison import comparison_figure
    from hjepa_cli.output.figures import save
    from hjepa_cli.storage.files import make_directory

    trainings = len(document["training_seeds"])
    usual = f"{document['plant']}, mean of {trainings} trainings, 95 % CI"
    drawn = comparison_figure(
        document["methods"],
        acceptable_score=document["acceptable_score"],
        step_s=plant(document["plant"]).step_s,
        asked=dataclasses.replace(asked, title=asked.titled(usual)),
    )
    make_directory(directory)
    paths = [save(drawn, directory / f"trainings.{kind}") for kind in formats]
    screen.say(f"written: {', '.join(map(str, paths))}")
    return paths
