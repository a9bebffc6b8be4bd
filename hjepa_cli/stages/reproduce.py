"""``hjepa reproduce``: all five stages into one folder, then the report.

Settings → ``runs/reproduce/<nnnn>/`` with the dataset, one run per stage and ``report.html``. Each
stage reads what the one before it left in the folder and nothing else; the same command with
``--out`` and the folder goes on after the last finished stage.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hjepa_cli.config.checks import LINKLESS, TRUE_STATE, check_gaps, check_schedulable
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.networks.model import offered
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import (
    collect,
    evaluate,
    plan,
    report,
    scale,
    train_encoder,
    train_hierarchy,
)
from hjepa_cli.stages.evaluate import check_horizon
from hjepa_cli.stages.inputs import check_stride
from hjepa_cli.stages.model_set import how_to_train
from hjepa_cli.storage.checkpoints import MODEL_FILE
from hjepa_cli.storage.runs import Run

Result = dict[str, Any]


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> Result:
    """Run the whole pipeline; returns the document of ``--json``.

    Raises:
        As :func:`check` and the stages; what is finished stays.
    """
    check(settings)
    with Run.create("reproduce", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            return record.result
        folder = record.directory
        if settings.preset == report.SMOKE:
            screen.say(report.NO_RESULT)
        for name in left_out(settings):
            how = how_to_train(name, settings)
            screen.say(f"{name} left out, no model of it is trained here: {how}")
        work = stages(settings, screen, folder)
        parts = plan.reproduce_parts(settings)
        expected_s = {name: round(seconds) for name, (_, seconds) in parts.items()}
        results: Result = {}
        with screen.progress("all stages", sum(expected_s.values())) as bar:
            for number, (name, stage) in enumerate(work.items(), start=1):
                screen.say(f"stage {number} of {len(work)}: {name}")
                results[name] = stage()
                record.event("finished", stage=name)
                bar.advance(expected_s[name])
        made = report.run(screen, [folder], out=folder / "report.html", figures=folder / "figures")
        return record.finish({"folder": folder, **results, "report": made["report"]})


def check(settings: Settings) -> None:
    """Refuse at once what a late stage would refuse after the others have worked for it.

    Raises:
        UsageError: a baseline in place of the encoder, no method of which a model is trained here
            or that has a link to schedule, too few slots for it, trajectories too short for the
            strides or the horizon, a bad SNR grid.
    """
    method, collected = settings.encoder.method, settings.collect
    if method != "jepa":
        raise UsageError(
            f"encoder.method = {method!r}; reproduce trains a hierarchy, which needs 'jepa'",
            hint=f"hjepa train-encoder --method {method}",
        )
    missing = left_out(settings)
    if len(missing) == len(settings.methods):
        raise UsageError(
            f"no model of {', '.join(missing)} is trained here; "
            f"choose --methods from {', '.join(servable(settings))}",
            hint=f"train it on its own: {how_to_train(missing[0], settings)}",
        )
    if settings.radio.law == "scheduled":
        linked = [name for name in settings.methods if name not in (*missing, *LINKLESS)]
        if not linked:
            raise UsageError(
                f"law scheduled has nothing to schedule for {', '.join(settings.methods)}",
                hint="choose --methods that have a link, as hjepa, or radio.law = 'duty'",
            )
        check_schedulable(linked, settings.protocol.total_steps)
    check_stride(max(settings.encoder.h, settings.hierarchy.h), collected.steps)
    check_horizon(settings.protocol.horizon, collected.clean_steps)
    check_gaps(settings.protocol)
    parse_snr(settings.radio.snr_db)


def left_out(settings: Settings) -> list[str]:
    """The methods of the settings that no model drives which is trained here."""
    served = servable(settings)
    return [name for name in settings.methods if name not in served]


def servable(settings: Settings) -> tuple[str, ...]:
    """The methods that the hierarchy of these settings can drive, and those without a model."""
    strides = settings.hierarchy
    kind = "flat" if strides.h == strides.m == strides.l else "hierarchy"
    states = len(plant(settings.plant).state_names)
    return (*offered({"kind": kind, "h": strides.h}, states), *TRUE_STATE)


def stages(settings: Settings, screen: Screen, folder: Path) -> dict[str, Callable[[], Result]]:
    """The five stages, each bound to what it reads and writes in ``folder``."""
    data, model = folder / "data", str(folder / "train-hierarchy")
    driven = tuple(name for name in settings.methods if name not in left_out(settings))
    measured = dataclasses.replace(settings, methods=driven)

    def trained_hierarchy() -> Result:
        return train_hierarchy.run(
            settings,
            screen,
            dataset=data,
            encoder=str(folder / "train-encoder" / MODEL_FILE),
            out=folder / "train-hierarchy",
        )

    return {
        "collect": lambda: collect.run(settings, screen, out=data),
        "train-encoder": lambda: train_encoder.run(
            settings, screen, dataset=data, out=folder / "train-encoder"
        ),
        "train-hierarchy": trained_hierarchy,
        "eval": lambda: evaluate.run(
            measured, screen, checkpoint=model, dataset=data, out=folder / "eval"
        ),
        "scale": lambda: scale.run(
            measured, screen, checkpoint=model, dataset=data, out=folder / "scale"
        ),
    }
