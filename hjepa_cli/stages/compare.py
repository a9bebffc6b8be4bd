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

from hjepa_cli.checks import TRUE_STATE, check_methods
from hjepa_cli.core.metrics import student_interval
from hjepa_cli.core.plant import plant
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.screen import Screen, span
from hjepa_cli.stages.report import FIGURE_FORMATS, found_runs, stage_of
from hjepa_cli.storage import runs
from hjepa_cli.storage.curves import Entry

AVERAGED = {  # of an entry of ``eval --json``, and where the interval of it goes
    "nmae": "nmae_ci95",
    "nmae_every_step": "nmae_every_step_ci95",
    "score": "score_ci95",
    "tolerance_gap_steps": "tolerance_gap_ci95",
    "tolerance_p": "tolerance_p_ci95",
}
ALIKE = ("plant", "loop_version", "horizon", "acceptable_score", "acceptable_lq_ratio")


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """A finished run of ``eval`` whose models come from one training seed."""

    directory: Path
    result: Mapping[str, Any]
    config: Mapping[str, Any]
    training_seed: int


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
        figures: also draw the paper's Fig. 3 with bands over trainings into this directory,
        formats: in these formats.

    Raises:
        UsageError: no such method.
        MissingInputError: no runs, fewer than two trainings, or a method that a training lacks.
        DataError: runs of different plants, protocols or versions, or two models of one seed.
    """
    if methods is not None:
        check_methods(tuple(methods))
    if figures is not None and find_spec("matplotlib") is None:
        raise MissingInputError(
            "a figure needs matplotlib, which is not installed", hint='pip install "hjepa[plot]"'
        )
    found = [opened(path) for path in evaluations(paths)]
    check_alike(found)
    by_method = collected(found, methods)
    seeds = sorted({one.training_seed for one in found})
    first = found[0].result
    document = {
        "plant": first["plant"],
        "training_seeds": seeds,
        "acceptable_score": first["acceptable_score"],
        "horizon": first["horizon"],
        "methods": {name: averaged(list(of.values())) for name, of in by_method.items()},
        "differences": differences(by_method),
        "runs": [one.directory for one in found],
    }
    show(document, screen)
    document["figures"] = [] if figures is None else draw(document, figures, formats, screen)
    return document


def evaluations(paths: Sequence[Path]) -> list[Path]:
    """The finished runs of ``eval`` among and below ``paths``. Raises MissingInputError."""
    places = list(paths) or [runs.ROOT / "eval"]
    found = [directory for directory in found_runs(places) if stage_of(directory) == "eval"]
    if not found:
        raise MissingInputError(
            f"no finished run of eval in {', '.join(map(str, places))}", hint="hjepa eval"
        )
    return found


def opened(directory: Path) -> Evaluation:
    """One run. Raises DataError where its models come from several trainings, or it is too old."""
    result, config = runs.read_result(directory), runs.read_config(directory)
    again = f"hjepa eval --config {shlex.quote(str(directory / runs.CONFIG))}"
    if "training_seeds" not in result:
        raise DataError(
            f"{directory} does not say with which seeds its models were trained: an older version "
            "measured it",
            hint=again,
        )
    trained = set(result["training_seeds"].values())
    if None in trained:
        raise DataError(
            f"a model of {directory} does not say with which seed it was trained", hint=again
        )
    if len(trained) > 1:
        of = ", ".join(f"{name}: {seed}" for name, seed in result["training_seeds"].items())
        raise DataError(
            f"the models of {directory} were trained with different seeds ({of})",
            hint="hjepa eval --checkpoint PATH --methods …, for the models of one seed each",
        )
    return Evaluation(directory, result, config, trained.pop() if trained else result["seed"])


def check_alike(found: Sequence[Evaluation]) -> None:
    """Refuse what is not measured alike. Raises DataError naming the difference."""
    first, of_seed = found[0], dict[int, Evaluation]()
    for other in found:
        named = [(first, key, first.result[key], other.result[key]) for key in ALIKE]
        for section in ("protocol", "conditions"):
            ours, theirs = first.config[section], other.config[section]
            named += [
                (first, f"{section}.{key}", ours.get(key), theirs.get(key))
                for key in dict.fromkeys((*ours, *theirs))
            ]
        # Seeds of the evaluation may differ from training to training, not within one.
        peer = of_seed.setdefault(other.training_seed, other)
        named.append((peer, "seed", peer.result["seed"], other.result["seed"]))
        for one, key, ours, theirs in named:
            if ours != theirs:
                raise DataError(
                    f"{key} is {ours} in {one.directory}, {theirs} in {other.directory}: not to "
                    "be compared",
                    hint="name runs that were measured alike, or measure one again",
                )


def collected(
    found: Sequence[Evaluation], methods: Sequence[str] | None
) -> dict[str, dict[int, Entry]]:
    """Entries by method and training seed, the same seeds for all.

    Raises:
        MissingInputError: fewer than two trainings, or not the same ones for every method.
        DataError: two models of one method and one seed.
    """
    by_method: dict[str, dict[int, Entry]] = {name: {} for name in methods or ()}
    sources: dict[tuple[str, int], Path] = {}
    for one in found:
        for name, entry in one.result["methods"].items():
            if methods is not None and name not in methods:
                continue
            known = by_method.setdefault(name, {})
            if known.setdefault(one.training_seed, entry) != entry:
                raise DataError(
                    f"two measurements of {name} with training seed {one.training_seed}: "
                    f"{sources[name, one.training_seed]} and {one.directory}",
                    hint="hjepa compare RUN…, with the runs that belong together",
                )
            sources.setdefault((name, one.training_seed), one.directory)
    seeds = sorted({one.training_seed for one in found})
    if len(seeds) < 2:
        raise MissingInputError(
            f"a comparison over trainings needs two of them; these are all of seed {seeds[0]}",
            hint="train and evaluate with another --seed, or hjepa report",
        )
    for name, known in by_method.items():
        if missing := [seed for seed in seeds if seed not in known]:
            raise MissingInputError(
                f"{name} was not measured with training seed {', '.join(map(str, missing))}",
                hint=f"hjepa eval --methods {name} with a model of that seed, or leave it out: "
                "--methods",
            )
    return {name: dict(sorted(known.items())) for name, known in by_method.items()}


def averaged(entries: Sequence[Entry]) -> Entry:
    """The entry of a method over its trainings: means, and Student's intervals over trainings.

    What needs no training and was measured on the same draws every time is one measurement; it
    keeps its own interval, over devices or rollouts.
    """
    if all(entry == entries[0] for entry in entries):
        return entries[0] | {"n_trainings": 1}
    mean: Entry = {
        "bits_per_transmission": entries[0]["bits_per_transmission"],
        "n_trainings": len(entries),
    }
    for key, interval in AVERAGED.items():
        values = [entry[key] for entry in entries]
        mean[key], mean[interval] = over_trainings(values)
    windows = entries[0]["nmae_windows"]
    mean["nmae_windows"], mean["nmae_windows_ci95"] = {}, {}
    for window in windows:
        values = [entry["nmae_windows"][window] for entry in entries]
        mean["nmae_windows"][window], mean["nmae_windows_ci95"][window] = over_trainings(values)
    for kind in ("gap", "p"):
        mean[f"tolerance_{kind}_censored"] = any(e[f"tolerance_{kind}_censored"] for e in entries)
    for curve, key in (("gap_curve", "d"), ("delivery_curve", "p")):
        mean[curve] = []
        for points in zip(*(entry[curve] for entry in entries), strict=True):
            score, ci95 = over_trainings([point["score"] for point in points])
            mean[curve].append({key: points[0][key], "score": score, "ci95": ci95})
    return mean


def over_trainings(values: Sequence[Any]) -> tuple[Any, Any]:
    """Mean and 95 % interval of numbers, or of equally long lists of numbers; None stays None."""
    if any(value is None for value in values):
        return None, None
    array = np.array(values, float)
    return array.mean(axis=0).tolist(), student_interval(array).T.tolist()


def differences(by_method: Mapping[str, Mapping[int, Entry]]) -> list[dict[str, Any]]:
    """The first method against each other one that is trained, paired within trainings.

    Returns:
        Per other method: ``nmae_windows`` and ``nmae_every_step``, first minus other, and
        ``tolerance_gap_ratio``, first ÷ other; each with ``mean`` and ``ci95`` (of the ratio the
        geometric mean, its interval taken on the logarithm).
    """
    first, *others = by_method
    found = []
    for other in others:
        if other in TRUE_STATE:
            continue
        pairs = [(by_method[first][s], by_method[other][s]) for s in by_method[first]]
        windows = {
            window: _described(
                [a["nmae_windows"][window] - b["nmae_windows"][window] for a, b in pairs]
            )
            for window in pairs[0][0]["nmae_windows"]
        }
        every = _described([a["nmae_every_step"] - b["nmae_every_step"] for a, b in pairs])
        gaps = [(a["tolerance_gap_steps"], b["tolerance_gap_steps"]) for a, b in pairs]
        ratio = None
        if all(a and b for a, b in gaps):
            logarithm = _described([math.log(a / b) for a, b in gaps])
            ratio = {
                "mean": math.exp(logarithm["mean"]),
                "ci95": [math.exp(end) for end in logarithm["ci95"]],
            }
        found.append(
            {
                "method": first,
                "over": other,
                "nmae_windows": windows,
                "nmae_every_step": every,
                "tolerance_gap_ratio": ratio,
            }
        )
    return found


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
        f"without training over devices or rollouts), tolerances at score "
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
                _bounded(entry, "gap_steps", "gap", 1, "≥"),
                _bounded(entry, "p", "p", 4, "≤"),
            ]
            for name, entry in entries.items()
        ],
    )
    found = document["differences"]
    if not found:
        return
    screen.table(
        f"{found[0]['method']} minus the other, in NMAE, and its gap D* ÷ the other's: mean (95 % "
        "CI), paired within trainings",
        ["other", *(f"NMAE {w}" for w in windows), "every packet", "gap ratio"],
        [
            [
                one["over"],
                *(_spanned(one["nmae_windows"][w], 4) for w in windows),
                _spanned(one["nmae_every_step"], 4),
                _spanned(one["tolerance_gap_ratio"], 3),
            ]
            for one in found
        ],
    )


def _bounded(entry: Entry, value: str, key: str, decimals: int, bound: str) -> str | None:
    censored = entry[f"tolerance_{key}_censored"]
    interval = entry[f"tolerance_{key}_ci95"]
    return span(entry[f"tolerance_{value}"], interval, decimals, bound if censored else "")


def _spanned(found: Mapping[str, Any] | None, decimals: int) -> str | None:
    return None if found is None else span(found["mean"], found["ci95"], decimals)


def draw(
    document: Mapping[str, Any], directory: Path, formats: Sequence[str], screen: Screen
) -> list[Path]:
    """Write the paper's Fig. 3, bands over trainings, as ``trainings.<format>``."""
    from hjepa_cli.comparison import comparison_figure
    from hjepa_cli.figures import save
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
