"""``hjepa compare RUN…``: evaluations of several trainings as one table and one figure.

Runs of ``eval`` whose models were trained with different seeds → per method the mean over
trainings with Student's 95 % interval, and the first method against every other one, paired
within a training. Runs that do not belong into one picture are refused.
"""

import dataclasses
import math
import shlex
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.config.checks import METHODS, TRUE_STATE, check_methods
from hjepa_cli.core.evaluation import curves
from hjepa_cli.core.evaluation.curves import Entry
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.statistics import student_interval
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen, span, tolerance
from hjepa_cli.stages.report import (
    FIGURE_FORMATS,
    NO_RESULT,
    SMOKE,
    found_runs,
    inputs_of,
    stage_of,
)
from hjepa_cli.storage import runs

AVERAGED = {  # of an entry of ``eval --json``, where the interval of it goes, and its range
    "nmae": ("nmae_ci95", (0.0, None)),
    "nmae_every_step": ("nmae_every_step_ci95", (0.0, None)),
    "score": ("score_ci95", (0.0, None)),
    "tolerance_gap_steps": ("tolerance_gap_ci95", (0.0, None)),
    "tolerance_p": ("tolerance_p_ci95", (0.0, 1.0)),
}
ALIKE = ("plant", "loop_version", "horizon", "acceptable_score", "acceptable_lq_ratio")

ByMethod = dict[str, dict[int, Entry]]
"""Entries by method and seed: of the training, or without one of the evaluation."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A finished run of ``eval`` whose models, if it has any, come from one training seed."""

    directory: Path
    result: Mapping[str, Any]
    config: Mapping[str, Any]
    dataset: str | None
    training_seed: int | None

    def seed_of(self, method: str) -> int:
        """The training's, or of a method without a model the evaluation's."""
        if method in TRUE_STATE or self.training_seed is None:
            return int(self.result["seed"])
        return self.training_seed


def run(
    screen: Screen,
    paths: Sequence[Path],
    *,
    methods: Sequence[str] | None = None,
    figures: Path | None = None,
    formats: Sequence[str] = FIGURE_FORMATS,
) -> dict[str, Any]:
    """Compare evaluations; returns the document of ``--json``.

    Args:
        screen: where to say so.
        paths: runs of ``eval``, or directories that hold some; none: ``runs/eval``.
        methods: these, in this order, the first against the others; default: all that were found.
        figures: also draw the paper's Fig. 3 with bands over trainings into this directory.
        formats: of this figure.

    Raises:
        UsageError: no such method.
        MissingInputError: no runs, fewer than two trainings, or a method that a training lacks.
        DataError: runs of different plants, protocols or versions, two models of one seed, or a
            result that no ``eval`` wrote.
    """
    if methods is not None:
        check_methods(tuple(methods))
    if figures is not None and find_spec("matplotlib") is None:
        raise MissingInputError(
            "a figure needs matplotlib, which is not installed", hint='pip install "hjepa[plot]"'
        )
    found = [opened(directory, methods) for directory in evaluations(paths)]
    if any(one.config["preset"] == SMOKE for one in found):
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
            name: averaged(list(of.values())) | {"n_trainings": count(name, of)}
            for name, of in by_method.items()
        },
        "differences": differences(by_method),
        "runs": [one.directory for one in found],
    }
    show(document, screen)
    document["figures"] = [] if figures is None else draw(document, figures, formats, screen)
    return document


def evaluations(paths: Sequence[Path]) -> list[Path]:
    """The finished runs of ``eval`` among and below ``paths``. Raises MissingInputError."""
    places = list(paths) or [runs.ROOT / "eval"]
    made_by = "hjepa eval"
    found = [one for one in found_runs(places, made_by) if stage_of(one) == "eval"]
    if not found:
        where = ", ".join(map(str, places))
        raise MissingInputError(f"no finished run of eval in {where}", hint=made_by)
    return found


def opened(directory: Path, methods: Sequence[str] | None) -> Evaluation:
    """One run, reduced to ``methods``.

    Raises:
        DataError: no result of ``eval``, an older one, or models of several trainings.
    """
    result, config = runs.read_result(directory), runs.read_config(directory)
    environment = runs.read_environment(directory)
    if reason := flaw(result, config):
        again = ["hjepa", "eval", "--config", str(directory / runs.CONFIG)]
        again += [*inputs_of(environment), "--out", f"{directory}-again", "--remeasure"]
        raise DataError(
            f"{directory / runs.RESULT}: {reason}",
            hint=f"leave it out, or in its place: {shlex.join(again)}",
        )
    entries = {
        name: entry
        for name, entry in result["methods"].items()
        if methods is None or name in methods
    }
    dataset = environment["inputs"].get("dataset")
    return Evaluation(
        directory,
        result | {"methods": entries},
        config | {"preset": environment["preset"]},
        dataset["sha256"] if isinstance(dataset, dict) else None,
        training_seed(directory, result["training_seeds"], entries),
    )


def flaw(result: Mapping[str, Any], config: Mapping[str, Any]) -> str | None:
    """Why a run cannot be compared with others, if anything is wrong with it."""
    for key in (*ALIKE, "seed"):
        if key not in result:
            return f"'{key}' is missing"
    for section in ("protocol", "conditions", "collect"):
        if not isinstance(config.get(section), dict):
            return f"its settings have no [{section}]"
    if not isinstance(result.get("training_seeds"), dict):
        return "it does not say with which seeds its models were trained (an older version?)"
    if not isinstance(result.get("methods"), dict):
        return "no methods"
    steps = len(result["horizon"]) if isinstance(result["horizon"], list) else 0
    for name, entry in result["methods"].items():
        if reason := curves.flaw(entry):
            return f"method '{name}': {reason}"
        if "nmae_every_step" not in entry:
            return f"method '{name}': no 'nmae_every_step' (an older version?)"
        if not steps == len(entry["nmae"]) == len(entry["nmae_ci95"]):
            return f"method '{name}': 'nmae' is not over the horizon"
    return None


def training_seed(
    directory: Path, seeds: Mapping[str, Any], entries: Mapping[str, Entry]
) -> int | None:
    """The one seed that the models of ``entries`` were trained with; None if they need no model.

    Raises:
        DataError: it is not known, or there are several.
    """
    of = {name: seeds.get(name) for name in entries if name not in TRUE_STATE}
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
    first, of_training = found[0], dict[int | None, Evaluation]()
    for other in found:
        named = [(first, key, first.result[key], other.result[key]) for key in ALIKE]
        for section in ("protocol", "conditions"):
            ours, theirs = first.config[section], other.config[section]
            named += [
                (first, f"{section}.{key}", ours.get(key), theirs.get(key))
                for key in dict.fromkeys((*ours, *theirs))
            ]
        named += [
            (first, f"collect.{key}", first.config["collect"].get(key), value)
            for key, value in other.config["collect"].items()
            if key in (*curves.CLEAN, "start")
        ]
        # Draws may differ from training to training; within one they are what methods share.
        if other.training_seed is not None:
            peer = of_training.setdefault(other.training_seed, other)
            named.append((peer, "seed", peer.result["seed"], other.result["seed"]))
            named.append((peer, "dataset", peer.dataset, other.dataset))
        for one, key, ours, theirs in named:
            if ours != theirs:
                raise DataError(
                    f"{key} is {ours!r} in {one.directory}, {theirs!r} in {other.directory}: not "
                    "to be compared",
                    hint="name runs that were measured alike, or measure one again",
                )


def collected(
    found: Sequence[Evaluation], methods: Sequence[str] | None
) -> tuple[ByMethod, list[int]]:
    """Entries by method and seed, and the training seeds, the same for all trained methods.

    Raises:
        MissingInputError: fewer than two trainings, or not the same ones for every method.
        DataError: two models of one method and one seed.
    """
    by_method: ByMethod = {}
    sources: dict[tuple[str, int], Path] = {}
    for one in found:
        for name, entry in one.result["methods"].items():
            seed = one.seed_of(name)
            source = sources.setdefault((name, seed), one.directory)
            known = by_method.setdefault(name, {}).setdefault(seed, entry)
            # Measured again elsewhere, what needs no model may differ in the last digits.
            if name not in TRUE_STATE and known != entry:
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
            hint="train and evaluate with another --seed (docs/experiments.md), or hjepa report",
        )
    others = sorted(by_method.keys() - set(METHODS))
    order = methods or [*(name for name in METHODS if name in by_method), *others]
    for name in order:
        known_seeds = by_method.get(name, {})
        missing = [seed for seed in seeds if seed not in known_seeds]
        if name in TRUE_STATE and not known_seeds:
            raise MissingInputError(f"{name} was not measured", hint=f"hjepa eval --methods {name}")
        if name not in TRUE_STATE and missing:
            raise MissingInputError(
                f"{name} was not measured with training seed {', '.join(map(str, missing))}",
                hint=f"hjepa eval --methods {name} with a model of that seed, or leave it out: "
                "--methods",
            )
    return {name: dict(sorted(by_method[name].items())) for name in order}, seeds


def count(method: str, of: Mapping[int, Entry]) -> int:
    """How many trainings a mean is over: none for methods without a model."""
    return 0 if method in TRUE_STATE else len(of)


def averaged(entries: Sequence[Entry]) -> Entry:
    """The entry of a method over its trainings: means, and Student's intervals over trainings.

    Of a single entry (what needs no training, measured on the same draws every time) the interval
    stays its own, over devices or rollouts.
    """
    keys = ("bits_per_transmission", "tolerance_gap_censored", "tolerance_p_censored")
    if len(entries) == 1:
        kept = [*keys, "nmae_windows", "nmae_windows_ci95", "gap_curve", "delivery_curve"]
        kept += [*AVERAGED, *(interval for interval, _ in AVERAGED.values())]
        return {key: entries[0][key] for key in kept}
    mean: Entry = {}
    for key in keys:
        values = [entry[key] for entry in entries]
        mean[key] = max(values) if all(value is not None for value in values) else None
    for key, (interval, ends) in AVERAGED.items():
        mean[key], mean[interval] = over_trainings([entry[key] for entry in entries], ends)
    mean["nmae_windows"], mean["nmae_windows_ci95"] = {}, {}
    for window in entries[0]["nmae_windows"]:
        values = [entry["nmae_windows"][window] for entry in entries]
        mean["nmae_windows"][window], mean["nmae_windows_ci95"][window] = over_trainings(
            values, (0.0, None)
        )
    for curve, where in (("gap_curve", "d"), ("delivery_curve", "p")):
        mean[curve] = []
        for points in zip(*(entry[curve] for entry in entries), strict=True):
            score, ci95 = over_trainings([point["score"] for point in points], (0.0, None))
            mean[curve].append({where: points[0][where], "score": score, "ci95": ci95})
    return mean


def over_trainings(
    values: Sequence[Any], ends: tuple[float | None, float | None] = (None, None)
) -> tuple[Any, Any]:
    """Mean and 95 % interval of numbers, or of equally long lists of numbers; None stays None.

    The interval is cut where the values' range ``ends``.
    """
    if any(value is None for value in values):
        return None, None
    array = np.array(values, float)
    low, high = (-np.inf if ends[0] is None else ends[0]), (np.inf if ends[1] is None else ends[1])
    interval = np.clip(student_interval(array), low, high)
    return array.mean(axis=0).tolist(), interval.T.tolist()


def differences(
    by_method: Mapping[str, Mapping[int, Entry]], left_out: Sequence[str] = TRUE_STATE
) -> list[dict[str, Any]]:
    """Compare the first method with each other one, paired within trainings.

    Args:
        by_method: entries by training seed.
        left_out: methods that are not paired, since no training and no draw of theirs differs.

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
        if other in left_out or first in left_out:
            continue
        pairs = [(by_method[first][s], by_method[other][s]) for s in by_method[first]]
        windows = {
            window: _described(
                [a["nmae_windows"][window] - b["nmae_windows"][window] for a, b in pairs]
            )
            for window in pairs[0][0]["nmae_windows"]
        }
        every = _described([a["nmae_every_step"] - b["nmae_every_step"] for a, b in pairs])
        found.append(
            {
                "method": first,
                "over": other,
                "nmae_windows": windows,
                "nmae_every_step": every,
                "tolerance_gap_ratio": _ratio(pairs, "gap_steps", "gap"),
                "tolerance_p_ratio": _ratio([(b, a) for a, b in pairs], "p", "p"),
            }
        )
    return found


def _ratio(pairs: Sequence[tuple[Entry, Entry]], key: str, kind: str) -> dict[str, Any] | None:
    """Geometric mean of the ratio of a tolerance, first ÷ second, with its interval."""
    values = [tuple(entry[f"tolerance_{key}"] for entry in pair) for pair in pairs]
    censored = any(entry[f"tolerance_{kind}_censored"] for pair in pairs for entry in pair)
    if censored or not all(a and b for a, b in values):
        return None
    logarithm = _described([math.log(a / b) for a, b in values])
    return {
        "mean": math.exp(logarithm["mean"]),
        "ci95": [math.exp(end) for end in logarithm["ci95"]],
    }


def _described(values: Sequence[float]) -> dict[str, Any]:
    mean, ci95 = over_trainings(values)
    return {"mean": mean, "ci95": ci95}


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
    document: Mapping[str, Any], directory: Path, formats: Sequence[str], screen: Screen
) -> list[Path]:
    """Write the paper's Fig. 3, bands over trainings, as ``trainings.<format>``."""
    from hjepa_cli.output.comparison import comparison_figure
    from hjepa_cli.output.figures import save
    from hjepa_cli.storage.files import make_directory

    drawn = comparison_figure(
        document["methods"],
        acceptable_score=document["acceptable_score"],
        step_s=plant(document["plant"]).step_s,
        title=f"{document['plant']}, mean of {len(document['training_seeds'])} trainings, 95 % CI",
    )
    make_directory(directory)
    paths = [save(drawn, directory / f"trainings.{kind}") for kind in formats]
    screen.say(f"written: {', '.join(map(str, paths))}")
    return paths
