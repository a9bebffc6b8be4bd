"""``hjepa reproduce`` runs all five stages into one folder, then the report.

Settings → ``runs/reproduce/<nnnn>/`` with the dataset, one run per stage and ``report.html``. Each
stage reads what the one before it left in the folder and nothing else; the same command with
``--out`` and the folder goes on after the last finished stage.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hjepa_cli.compute import memory
from hjepa_cli.config.checks import check_cell, check_gaps, check_schedulable, without_model
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import offered_methods
from hjepa_cli.core.control.loop import check_memory
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.capacity import parse_snr
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import METHODS, STAGES
from hjepa_cli.stages import report, train_hierarchy
from hjepa_cli.stages.evaluate import check_horizon
from hjepa_cli.stages.measuring import seconds_of_curves
from hjepa_cli.stages.model_set import how_to_train
from hjepa_cli.stages.plan import Plan, run_directory
from hjepa_cli.stages.scale import plan_searches
from hjepa_cli.stages.training import check_stride
from hjepa_cli.storage.checkpoints import MODEL_FILE
from hjepa_cli.storage.runs import SMOKE, Run

MEASURING = ("eval", "scale")  # the stages that drive a model


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Run the whole pipeline; return the document of ``--json``.

    It raises as :func:`check` and the stages; what is finished stays.
    """
    check(settings)
    planned = parts(settings)
    memory.check(memory_bytes(planned), "reproduce")
    with Run.create("reproduce", out, settings.as_dict()) as record:
        if record.result is not None:
            screen.say(f"{record.directory} is finished; this is its result")
            return record.result
        folder = record.directory
        if settings.preset == SMOKE:
            screen.say(report.NO_RESULT)
        for name in left_out(settings):
            how = how_to_train(name, settings)
            screen.say(f"{name} left out, no model of it is trained here: {how}")
        given = inputs_in(folder)
        expected_s = {part.command: round(part.seconds) for part in planned}
        results: dict[str, Any] = {}
        with screen.progress("all stages", sum(expected_s.values())) as bar:
            for number, (name, inputs) in enumerate(given.items(), start=1):
                screen.say(f"stage {number} of {len(given)}: {name}")
                chosen = measured(settings) if name in MEASURING else settings
                results[name] = STAGES[name].run(chosen, screen, **inputs)
                record.event("finished", stage=name)
                bar.advance(expected_s[name])
        made = report.run(screen, [folder], out=folder / "report.html", figures=folder / "figures")
        return record.finish({"folder": folder, **results, "report": made["report"]})


def plan(settings: Settings, *, out: Path | None = None) -> Plan:
    """Plan all stages; all curves are measured, as none can be of a model that is not there yet."""
    check(settings)
    planned = parts(settings)
    return Plan(
        command="reproduce",
        reads=[],
        work=[f"{part.command}: {line}" for part in planned for line in part.work],
        writes=[f"folder {run_directory('reproduce', out)} with a report and its figures"],
        writes_bytes=sum(part.writes_bytes for part in planned),
        seconds=15 + sum(part.seconds for part in planned),
        memory_bytes=memory_bytes(planned),
    )


def memory_bytes(planned: Sequence[Plan]) -> float:
    """Return what the stage takes that takes most: they come one after the other."""
    return max(part.memory_bytes for part in planned)


def parts(settings: Settings) -> list[Plan]:
    """Return the plan of each stage."""
    methods = measured(settings).methods
    curves = [f"measure the curves of {', '.join(methods)}"]
    curves_s = seconds_of_curves(methods, settings.protocol)
    counting, counting_s = ["count devices"], 0.0
    if settings.radio.law == "scheduled":
        linked = [name for name in methods if METHODS[name].needs_link]
        counting, counting_s = plan_searches(settings, linked)
    return [
        *(STAGES[name].plan(settings) for name in ("collect", "train-encoder")),
        train_hierarchy.plan_on(lambda *_: (None, "encoder: the one before"), settings),
        Plan("eval", [], curves, [], 200_000, 5 + curves_s),
        Plan("scale", [], counting, [], 300_000, 5 + counting_s),
    ]


def inputs_in(folder: Path) -> dict[str, dict[str, Any]]:
    """Return the stages in their order, with what each reads and writes in the folder."""
    data, encoder, model = (folder / name for name in ("data", "train-encoder", "train-hierarchy"))
    measured = {"checkpoint": model, "dataset": data}
    return {
        "collect": {"out": data},
        "train-encoder": {"dataset": data, "out": encoder},
        "train-hierarchy": {"dataset": data, "encoder": encoder / MODEL_FILE, "out": model},
        **{name: {**measured, "out": folder / name} for name in MEASURING},
    }


def measured(settings: Settings) -> Settings:
    """Return the settings with those methods only that a model which is trained here drives."""
    left = left_out(settings)
    driven = tuple(name for name in settings.methods if name not in left)
    return dataclasses.replace(settings, methods=driven)


def check(settings: Settings) -> None:
    """Refuse at once what a late stage would refuse after the others have worked for it.

    Raises:
        UsageError: a baseline in place of the encoder, no method of which a model is trained here
            or that has a link to schedule, too few slots for it, trajectories too short for the
            strides or the horizon, a bad SNR grid.
        OutOfMemory: a closed loop that does not fit.
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
        linked = [name for name in measured(settings).methods if METHODS[name].needs_link]
        if not linked:
            raise UsageError(
                f"law scheduled has nothing to schedule for {', '.join(settings.methods)}",
                hint="choose --methods that have a link, as hjepa, or radio.law = 'duty'",
            )
        check_schedulable(linked, settings.protocol.total_steps)
    check_stride(max(settings.encoder.h, settings.hierarchy.h), collected.steps)
    check_horizon(settings.protocol.horizon, collected.clean_steps)
    check_gaps(settings.protocol)
    check_memory(
        settings.protocol, max(settings.protocol.curve_devices, settings.protocol.bracket_devices)
    )
    parse_snr(settings.radio.snr_db)
    check_cell(settings.radio, nr=settings.nr)


def left_out(settings: Settings) -> list[str]:
    """Return the methods of the settings that no model drives which is trained here."""
    served = servable(settings)
    return [name for name in settings.methods if name not in served]


def servable(settings: Settings) -> tuple[str, ...]:
    """Return the methods that the settings' hierarchy can drive, and those without a model."""
    strides = settings.hierarchy
    kind = "flat" if strides.h == strides.m == strides.l else "hierarchy"
    offered = offered_methods({"kind": kind, "h": strides.h}, plant(settings.plant))
    return (*offered, *without_model())
