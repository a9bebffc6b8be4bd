"""``hjepa eval --dataset D`` of recordings measures what needs no simulator.

Held-out recordings and trained models → how forces err after a packet, how embeddings are predicted
under the recorded actions, and what states can be read off them. With ``--stress`` forces are
measured once more under every condition of pictures.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from hjepa_cli.config.checks import check_methods
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.datasets.dataset import Dataset, Trajectories
from hjepa_cli.core.evaluation import offline
from hjepa_cli.core.networks import health
from hjepa_cli.core.plants.conditions import actual_camera
from hjepa_cli.errors import MissingInputError, UsageError
from hjepa_cli.output.screen import Screen, in_order
from hjepa_cli.output.tables import show_offline
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages import results
from hjepa_cli.stages.inputs import brought_along, open_dataset
from hjepa_cli.stages.model_set import ModelSet, open_model_set
from hjepa_cli.stages.plan import Plan, run_directory, seconds_of
from hjepa_cli.stages.stressing import rows_of
from hjepa_cli.storage.runs import Run

NEEDS_STATES = "it asks for a plant's states or equations, and recordings have none"


def run(
    settings: Settings,
    screen: Screen,
    *,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    further: Sequence[Path] | None = None,
) -> dict[str, Any]:
    """Evaluate ``settings.methods`` on recordings; return the document of ``--json``.

    Arguments and errors are those of :func:`hjepa_cli.stages.evaluate.run`.
    """
    data, models = open_recorded(settings, screen, checkpoint, dataset, further)
    inputs = models.inputs(remeasure=False, figure=False)
    with Run.create("eval", out, models.settings.as_dict(), inputs) as record:
        result = kept = record.result
        if result is None:
            recorded = data.split(data.rollouts)
            assert recorded.frames is not None
            units = len(methods_of(models)) * (1 + len(rows_of(models.settings)))
            with screen.progress("eval", units, "methods") as bar:
                result = measured(models, data, recorded, advance=bar.advance)
            result = record.finish(result)
        with results.showing("eval", kept, record.directory):
            if kept is not None:
                screen.say(f"{record.directory} is finished; this is its result")
                for one in (result, *result.get("conditions", [])):
                    one["methods"] = in_order(one["methods"], settings.methods)
            show_offline(result, screen)
        return result


def plan(
    settings: Settings,
    *,
    checkpoint: str | Path | None = None,
    dataset: Path | None = None,
    out: Path | None = None,
    further: Sequence[Path] | None = None,
) -> Plan:
    """Plan an evaluation on recordings; arguments as of :func:`run`."""
    quiet = Screen(quiet=True)
    data, models = open_recorded(settings, quiet, checkpoint, dataset, further)
    split, methods = data.splits[data.rollouts], methods_of(models)
    rows = rows_of(models.settings)
    frames = (1 + len(rows)) * len(methods) * split["trajectories"] * (split["steps"] + 1)
    return Plan(
        command="eval",
        reads=[f"model {models.name}", f"dataset {data.path}"],
        work=[
            f"leave {', '.join(methods)} alone after one packet on {split['trajectories']} "
            f"recorded trajectories of split {data.rollouts}"
            + f", and under {len(rows)} conditions"
            * bool(rows)
        ],
        writes=[f"run {run_directory('eval', out)}"],
        writes_bytes=50_000,
        seconds=5 + seconds_of({"encoded frames": frames}),
    )


def open_recorded(
    settings: Settings,
    screen: Screen,
    checkpoint: str | Path | None,
    dataset: Path | None,
    further: Sequence[Path] | None,
) -> tuple[Dataset, ModelSet]:
    """Open recordings and the models to evaluate on them.

    Raises:
        MissingInputError: no dataset, or no model of any of the methods.
        UsageError: conditions that are not of these pictures.
        As :func:`~.model_set.open_model_set`.
    """
    check_methods(settings.methods)
    if settings.protocol.false_alarm:
        raise UsageError(
            "--false-alarm is calibrated on simulated pictures; of a recorded plant there are none",
            key="protocol.false_alarm",
        )
    data = open_dataset(dataset, settings)
    settings = brought_along(settings, data.settings, data.path)
    actual_camera(settings)
    rows_of(settings)
    models = open_model_set(settings, screen, checkpoint, data.path, further)
    for name, reason in skipped(models).items():
        screen.say(f"{name} skipped: {reason}")
    if not methods_of(models):
        reasons = skipped(models)
        raise MissingInputError(
            f"nothing to measure of {', '.join(reasons)}", hint=next(iter(reasons.values()))
        )
    return data, models


def methods_of(models: ModelSet) -> list[str]:
    """Return the methods that can be measured on recordings, in the settings' order."""
    return [name for name in models.settings.methods if name not in skipped(models)]


def skipped(models: ModelSet) -> dict[str, str]:
    """Return the other methods, each with why or how that would change."""
    found = {}
    for name in models.settings.methods:
        method = METHODS[name]
        if method.sends in ("true state", "decoded state") or method.fitted:
            found[name] = NEEDS_STATES
    return found | {
        name: how
        for name, how in models.skipped(models.settings.methods).items()
        if name not in found
    }


def measured(
    models: ModelSet, data: Dataset, recorded: Trajectories, *, advance: Any = lambda count: None
) -> dict[str, Any]:
    """Measure all methods on recorded trajectories with their pictures, under all conditions.

    Args:
        models: what is evaluated, with settings.
        data: the dataset, for the training half of probes.
        recorded: the trajectories.
        advance: is told of each method that is done, without a condition or under one.

    Raises:
        UsageError: trajectories that are too short.
    """
    settings = models.settings
    protocol, seed = settings.protocol, settings.seed
    horizon = min(protocol.horizon, recorded.steps - 1)
    if horizon < 1 or recorded.frames is None:
        raise UsageError(f"recorded trajectories of {recorded.steps} steps have no horizon")
    actions, expert = (values.astype(float) for values in (recorded.applied_n, recorded.teacher_n))
    windows = offline.Recorded.cut(recorded.frames, actions, expert, horizon)
    bootstrap, camera = (protocol.bootstrap, seed), actual_camera(settings)
    methods: dict[str, Any] = {}
    latent: dict[str, Any] = {}
    z_of: dict[str, Any] = {}
    for name in methods_of(models):
        model = models.of(name).model
        assert model is not None
        methods[name] = offline.entry_of(build_driver(name, settings, model), windows, *bootstrap)
        if planner := METHODS[name].planner:
            if model.digest not in z_of:
                z_of[model.digest] = offline.embedded(model, windows.frames, camera)
            z = z_of[model.digest]
            latent[name] = offline.latent_errors(planner(model), z, windows, *bootstrap)
        advance(1)
    under = []
    for text, row in rows_of(settings).items():
        found = {}
        for name in methods:
            driver = build_driver(name, row, models.of(name).model)
            found[name] = offline.entry_of(driver, windows, *bootstrap)
            advance(1)
        under.append({"condition": text, "methods": found})
    return {
        "offline": True,
        **models.described(list(methods)),
        "step_s": settings.recorded.step_s,
        "dataset": data.path,
        "split": data.rollouts,
        "lossy": bool(data.settings.get("import", {}).get("lossy", False)),
        "horizon": list(range(horizon + 1)),
        "methods": methods,
        "latent": latent,
        "probe_r2": probes(models, data),
        "skipped": skipped(models),
        **({"conditions": under} if under else {}),
    }


def probes(models: ModelSet, data: Dataset) -> Mapping[str, float | None]:
    """Return the R² of reading states off embeddings, held out; none where no state is known."""
    model, names = models.model, data.kind.state_names
    if not names or model is None:
        return {}
    read, cameras = [], {"train": model.camera, "test": actual_camera(models.settings)}
    for split, camera in cameras.items():
        of = data.split(split)
        assert of.frames is not None
        read += [offline.embedded(model, of.frames, camera).flatten(0, 1)]
        read += [torch.from_numpy(of.states[:, 1:].reshape(-1, len(names)))]
    return health.probe_r2(*read, names)
