"""``hjepa eval`` measures each method's prediction error, control score and tolerated losses.

A trained model (a run's or the zoo's) → closed-loop curves of every method, kept under a digest of
all they depend on, and tables. ``scale`` takes the same curves (:mod:`hjepa_cli.stages.measuring`).
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import changed, check_gaps, check_methods
from hjepa_cli.config.schema import IDEAL_LINK, RECORDED, Settings, declared, flag_of
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.core.plants.named import plant
from hjepa_cli.errors import MissingInputError, UsageError, require
from hjepa_cli.output.looks import Looks
from hjepa_cli.output.screen import Screen, in_order
from hjepa_cli.output.tables import show_evaluation, show_stress
from hjepa_cli.stages import evaluate_offline, results
from hjepa_cli.stages.measuring import curves_for, plan_curves
from hjepa_cli.stages.model_set import ModelSet, open_model_set
from hjepa_cli.stages.plan import Plan, run_directory
from hjepa_cli.stages.stressing import measure_stress, plan_stress, rows_of
from hjepa_cli.storage.runs import Run

# Settings of the protocol that recordings cannot follow.
OF_LOOPS = [f"protocol.{key}" for key in (*IDEAL_LINK, "plant_spread", "process_noise")]


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    further: Sequence[Path] | None = None,
    figure: bool = False,
    title: str | None = None,
    labels: Sequence[str] | None = None,
    log: bool | None = None,
) -> dict[str, Any]:
    """Evaluate ``settings.methods``; return the document of ``--json``.

    Args:
        checkpoint: zoo name, run directory or file; default: the newest run of the plant, else
            the zoo.
        dataset: take the clean rollouts for the NMAE from here instead of making them again.
        out: run directory; an interrupted one is continued after the last finished method.
        remeasure: do not use cached curves.
        further: models of methods that the first one does not hold; ``None`` looks for them.
        figure: draw the paper's Fig. 3, or scores under ``settings.stress``, into the run's
            directory.
        title, labels, log: of the figure, as :meth:`hjepa_cli.output.looks.Looks.of`.

    Raises:
        UsageError: unknown method or condition, or how a figure looks that is not drawn.
        MissingInputError: no such checkpoint or dataset, no model of any of the methods, or no
            matplotlib for ``figure``.
        DataError: a damaged file, one of another plant, or a figure of models of different seeds.
    """
    asked = Looks.of(title, labels, log)
    asked.check_drawn(figure, "hjepa eval --figure")
    if settings.plant == RECORDED:
        refuse_closed_loop(settings, remeasure=remeasure, figure=figure)
        found = {"checkpoint": checkpoint, "dataset": dataset, "out": out, "further": further}
        return evaluate_offline.run(settings, screen, **found)
    models = open_measurable(settings, screen, checkpoint, dataset, further, figure=figure)
    inputs = models.inputs(remeasure=remeasure, figure=figure)
    with Run.create("eval", out, settings.as_dict(), inputs) as record:
        result = recorded = record.result
        if result is None:
            if settings.stress:
                result = record.finish(stress_for(models, screen, record))
            else:
                result = record.finish(curves_for(models, screen, record, remeasure=remeasure))
        with results.showing("eval", recorded, record.directory):
            if recorded is not None:
                screen.say(f"{record.directory} is finished; this is its result")
                for key in ("methods", "checkpoints"):  # stored in the order of the alphabet
                    result[key] = in_order(result.get(key, {}), settings.methods)
                if "stress" in result:
                    of = result["stress"]["methods"]
                    result["stress"]["methods"] = in_order(of, settings.methods)
            show_evaluation(result, screen)
            if "stress" in result:
                show_stress(result, screen)
            if figure:
                result["figures"] = draw(result, settings, asked, record.directory, screen)
        return result


def plan(
    settings: Settings,
    *,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    remeasure: bool = False,
    further: Sequence[Path] | None = None,
    figure: bool = False,
    labels: Sequence[str] | None = None,
) -> Plan:
    """Plan the loops of the methods whose curves are not there yet; arguments as of :func:`run`."""
    Looks.of(labels=labels)
    if settings.plant == RECORDED:
        refuse_closed_loop(settings, remeasure=remeasure, figure=figure)
        found = {"checkpoint": checkpoint, "dataset": dataset, "out": out, "further": further}
        return evaluate_offline.plan(settings, **found)
    quiet = Screen(quiet=True)
    models = open_measurable(settings, quiet, checkpoint, dataset, further, figure=figure)
    if settings.stress:
        work, seconds = plan_stress(models)
    else:
        measured = models.measurable(settings.methods)
        work, seconds = plan_curves(models, measured, remeasure=remeasure)
    return Plan(
        command="eval",
        reads=reads_of(models),
        work=work,
        writes=[f"run {run_directory('eval', out)}"],
        writes_bytes=200_000,
        seconds=5 + seconds,
    )


def refuse_closed_loop(settings: Settings, **flags: bool) -> None:
    """Raise UsageError for what is about closed loops, where there are recordings alone."""
    given: dict[str, str | None] = {f"--{name}": None for name, value in flags.items() if value}
    for key in changed(settings.protocol, "protocol"):
        if key in OF_LOOPS and (flag := flag_of(declared()[key])):
            given[flag.name] = key
    if given:
        name, key = next(iter(given.items()))
        raise UsageError(
            f"{name} is about closed loops; a recorded plant has none",
            hint="hjepa eval --dataset DIR, without it",
            key=key,
        )


def reads_of(models: ModelSet) -> list[str]:
    """Return the lines of a plan about what is measured."""
    path = models.dataset.path if models.dataset else None
    rollouts = f"dataset {path}" if path else "no dataset: clean rollouts come from the seed"
    return [f"model {models.name}", rollouts]


def open_measurable(
    settings: Settings,
    screen: Screen,
    checkpoint: str | Path | None,
    dataset: Path | None,
    further: Sequence[Path] | None = None,
    *,
    figure: bool = False,
) -> ModelSet:
    """Open what :func:`run` evaluates, and refuse what cannot be before anything is written."""
    check_methods(settings.methods)
    check_gaps(settings.protocol)
    actual_camera(settings)
    rows_of(settings)
    if figure:
        require("matplotlib", "a figure needs matplotlib", "plot")
    models = open_model_set(settings, screen, checkpoint, dataset, further, one_seed=figure)
    rows_of(models.settings)  # of its pictures, which may be grey
    skipped = models.skipped(settings.methods)
    if len(skipped) == len(settings.methods):
        raise MissingInputError(
            f"no model for {', '.join(skipped)}", hint=next(iter(skipped.values()))
        )
    clean = models.dataset.splits["clean"] if models.dataset else {}
    check_horizon(settings.protocol.horizon, clean.get("steps", settings.collect.clean_steps))
    if figure:
        models.check_one_training_seed()
    return models


def stress_for(models: ModelSet, screen: Screen, record: Run) -> dict[str, Any]:
    """Measure what ``--stress`` asks for; return the document of ``--json``."""
    settings = models.settings
    methods = models.measurable(settings.methods)
    return {
        **models.described(methods),
        "methods": {},
        "skipped": models.skipped(settings.methods),
        "stress": measure_stress(models, screen, record),
    }


def draw(
    result: dict[str, Any], settings: Settings, asked: Looks, directory: Path, screen: Screen
) -> list[Path]:
    """Write the paper's Fig. 3, or scores under stress, as ``.png``, ``.svg`` and ``.pdf``."""
    from hjepa_cli.output.comparison import comparison_figure
    from hjepa_cli.output.figures import save, stress_figure

    usual = f"{result['plant']}, seed {result['seed']}, 95 % CI"
    name, asked = "comparison", dataclasses.replace(asked, title=asked.titled(usual))
    if "stress" in result:
        name, drawn = "stress", stress_figure(result["stress"], asked)
    else:
        drawn = comparison_figure(
            result["methods"],
            acceptable_score=result["acceptable_score"],
            step_s=plant(settings.plant).step_s,
            asked=asked,
        )
    paths = [save(drawn, directory / f"{name}.{kind}") for kind in ("png", "svg", "pdf")]
    screen.say(f"written: {', '.join(map(str, paths))}")
    return paths


def check_horizon(horizon: int, steps: int) -> None:
    """Raise UsageError where clean rollouts of so many steps end before the horizon."""
    if steps <= horizon:
        raise UsageError(
            f"protocol.horizon = {horizon} needs clean rollouts of {horizon + 1} steps; "
            f"they have {steps}"
        )
