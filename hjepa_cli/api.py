"""These functions do what the commands do, and return plain objects: the public interface.

Errors are those of :mod:`hjepa_cli.errors`. Values of settings are given by their dotted names, as
in a TOML file: ``settings={"protocol.steps": 200}``; ``hjepa config show`` lists them.
"""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hjepa_cli.config.checks import check_count, check_schedulable, check_uplink, resolve
from hjepa_cli.config.schema import RECORDED, Settings
from hjepa_cli.core.arrays import Floats, check_answer
from hjepa_cli.core.control.drivers import build_driver, planner_of
from hjepa_cli.core.control.loop import Draws, delivery_schedule, gap_schedule, simulate
from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.core.evaluation import cell_simulation as cell_loop
from hjepa_cli.core.evaluation.load_simulator import CALIBRATION_SEED
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.networks.outside import embeddings_from
from hjepa_cli.core.plants.conditions import actual_plant
from hjepa_cli.core.radio.uplink import Access
from hjepa_cli.errors import UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.plugins import STAGES
from hjepa_cli.storage import zoo
from hjepa_cli.storage.peeking import any_of

Values = Mapping[str, Any]


def load_model(name_or_path: str | Path, *, device: str = "cpu") -> Model:
    """Load a trained model, verified; it has ``encode(frames)`` and ``actor(z)``.

    Args:
        name_or_path: a name of the zoo (``hjepa models list``), a run directory, or a file.
        device: ``"cpu"``, ``"cuda"`` or ``"auto"``.

    Raise MissingInputError without one, and DataError for a damaged one, or for an encoder alone.
    """
    return Model.load(zoo.resolve_model(name_or_path), device)


def load_dataset(path: str | Path) -> datasets.Dataset:
    """Open a dataset directory; ``.split("train")`` reads its trajectories, verified.

    Raise MissingInputError without one, and DataError where it is not intact.
    """
    return datasets.load_dataset(Path(path))


@torch.inference_mode()
def predict(model: Model, z: Tensor, steps: int, *, method: str = "hjepa") -> tuple[Tensor, Tensor]:
    """Return what a controller does when packets stop coming, and the embedding it ends at.

    Args:
        model: of :func:`load_model`.
        z: the last received embeddings [n, d], a tensor or an array.
        steps: control steps, at least 1; they are played in whole strides.
        method: a predictor that the model holds.

    Returns:
        Forces in newton [n, steps, *A], and the embeddings [n, D] after the last stride, which is
        ``steps`` rounded up to a multiple of the stride ahead.

    Raises:
        UsageError: no such predictor, or no step.
        ArrayError: ``z`` is of another type or shape.
        NumericalError: an embedding is not finite.
    """
    check_count("steps", steps)
    planner = planner_of(model, method)
    z = embeddings_from(z, model.architecture["embedding"]).to(model.device)
    forces_n = []
    for _ in range(-(-steps // planner.stride)):
        played, reached = planner.plan(z)
        check_answer(played, (len(z), planner.stride, *model.action_shape), "plan(…)", Tensor)
        check_answer(reached, z.shape, "the embeddings of plan(…)", Tensor)
        forces_n.append(played.float())
        z = reached
    return torch.cat(forces_n, dim=1)[:, :steps].cpu(), z.float().cpu()


def drive(
    method: str,
    *,
    model: Model | None = None,
    gap_steps: float | None = None,
    delivery: float | None = None,
    devices: int = 4,
    preset: str | None = None,
    settings: Values | None = None,
) -> dict[str, Floats]:
    """Drive some devices in closed loop over one link and return what happened.

    One that has fallen, as its plant says, sends nothing more and gets no force.

    Args:
        method: as on the command line; those on embeddings need ``model``. Packets of ``hold+9``
            come 9 steps later than the settings' ``protocol.delay_steps`` say; ``hjepa`` takes
            late ones when they are whole strides old.
        model: of :func:`load_model`, of the same plant. It brings along the law that it learned and
            the camera that it was trained with.
        gap_steps: a packet every so many steps; or
        delivery: a packet at every step that arrives with this probability. Neither: all arrive.
        devices: n.
        preset, settings: plant, seed and protocol: K steps, its warm-up and those it scores.

    Returns:
        ``states`` [K, n, S] and ``forces_n`` [K, n, *A] of all steps; of those that are scored
        ``score`` [n] (share inside the band) and ``cost`` [n] (mean capped quadratic cost).

    Raises:
        UsageError: unknown method, both kinds of link, no device, or packets that come later than
            the controller remembers.
        DataError: ``model`` is of another plant.
    """
    check_count("devices", devices)
    if gap_steps is not None and delivery is not None:
        raise UsageError("give gap_steps or delivery, not both")
    chosen = _settings(preset, None, settings)
    draws = Draws.make(chosen.protocol, devices, chosen.seed)
    if delivery is not None:
        schedule = delivery_schedule(delivery, draws.delivery)
    else:
        schedule = gap_schedule(1 if gap_steps is None else gap_steps, draws.steps, devices)
    how = build_driver(method, chosen, model)
    seen: list[tuple[Floats, Floats]] = []
    outcome = simulate(
        actual_plant(chosen.plant, chosen.conditions),
        how.draws(draws),
        (schedule if how.uses_link else np.ones_like(schedule))[None],
        how.controller(devices),
        how.sensor,
        delay_steps=how.delay_steps,
        watch=lambda k, now, forces_n: seen.append((now.copy(), forces_n.copy())),
    )
    states, forces_n = map(np.stack, zip(*seen, strict=True))
    score, cost = outcome.score[0], outcome.cost[0]
    return {"states": states, "forces_n": forces_n, "score": score, "cost": cost}


def simulate_cell(
    method: str,
    *,
    devices: int,
    blocks: int = 1,
    scheduler: str = "round-robin",
    model: Model | None = None,
    preset: str | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Drive devices that compete for one uplink, as ``hjepa scale --law scheduled`` does.

    Args:
        method: one that sends packets of a slot; those on embeddings need ``model``.
        devices: N, how many compete.
        blocks: J resource blocks in every slot, each as long as a packet.
        scheduler: who gets them.
        model: of :func:`load_model`, of the same plant.
        preset, settings: plant, seed and protocol; of ``radio``, the power margin,
            how long fades last and the share of transmissions that fail, none of which is repeated;
            nothing else of it may be set.

    Returns:
        ``score`` [N] (share of steps inside the band), ``cost`` [N] (mean capped quadratic cost),
        ``packets`` [N] that arrived, ``reports`` of all devices to a scheduler that asks for them;
        all of them in the scored steps.

    Raises:
        UsageError: unknown method or scheduler, a method without packets of a slot, more blocks
            than devices, fewer than two steps, or a setting of ``radio`` that is not read here.
        DataError: ``model`` is of another plant.
    """
    check_count("devices", devices)
    check_count("blocks", blocks)
    chosen = _settings(preset, None, settings)
    check_schedulable([method], chosen.protocol.total_steps)
    kind = actual_plant(chosen.plant, chosen.conditions)
    protocol, radio = chosen.protocol, chosen.radio
    check_uplink(radio)
    how = build_driver(method, chosen, model)
    access = Access(
        scheduler=scheduler,
        blocks=blocks,
        margin_db=radio.power_margin_db,
        k_factor_db=-math.inf,
        coherence_slots=radio.coherence_slots,
        round_errors=(radio.block_error,),
        growth=cell_loop.measure_growth(kind, protocol, chosen.seed + CALIBRATION_SEED, how),
        seed=chosen.seed,
    )
    outcome = cell_loop.simulate_cell(kind, protocol, chosen.seed, devices, access, how)
    return {key: getattr(outcome, key) for key in ("score", "cost", "packets", "reports")}


def collect(
    *,
    out: str | Path | None = None,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> datasets.Dataset:
    """Simulate trajectories and store them, as ``hjepa collect``; return the dataset."""
    made = _call("collect", preset, config, settings, out=out)
    return load_dataset(made["dataset"])


def train_encoder(
    *,
    dataset: str | Path | None = None,
    out: str | Path | None = None,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Learn an encoder, as ``hjepa train-encoder``; return the document of ``--json``."""
    return _call("train-encoder", preset, config, settings, out=out, dataset=_path(dataset))


def train_hierarchy(
    *,
    dataset: str | Path | None = None,
    encoder: str | Path | None = None,
    out: str | Path | None = None,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Train predictors and actor, as ``hjepa train-hierarchy``; return the ``--json`` document."""
    inputs = {"dataset": _path(dataset), "encoder": encoder}
    return _call("train-hierarchy", preset, config, settings, out=out, **inputs)


def train_reflex(
    *,
    dataset: str | Path | None = None,
    checkpoint: str | Path | None = None,
    out: str | Path | None = None,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Train rivals that predict nothing, as ``hjepa train-reflex``; return the document."""
    inputs = {"dataset": _path(dataset), "checkpoint": checkpoint}
    return _call("train-reflex", preset, config, settings, out=out, **inputs)


def evaluate(
    *,
    checkpoint: str | Path | None = None,
    dataset: str | Path | None = None,
    methods: Sequence[str] | None = None,
    out: str | Path | None = None,
    remeasure: bool = False,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Measure methods in closed loop, or on recordings, as ``hjepa eval``; return the document."""
    values = _with(settings, methods=methods)
    inputs = {"checkpoint": checkpoint, "dataset": _path(dataset), "remeasure": remeasure}
    return _call("eval", preset, config, values, out=out, **inputs)


def scale(
    *,
    snr: str | None = None,
    law: str | None = None,
    tolerance_steps: float | None = None,
    checkpoint: str | Path | None = None,
    methods: Sequence[str] | None = None,
    out: str | Path | None = None,
    remeasure: bool = False,
    preset: str | None = None,
    config: str | Path | None = None,
    settings: Values | None = None,
) -> dict[str, Any]:
    """Count the devices of a cell, as ``hjepa scale``; return the document of ``--json``."""
    values = _with(settings, **{"methods": methods, "radio.snr_db": snr, "radio.law": law})
    inputs = {"checkpoint": checkpoint, "remeasure": remeasure, "tolerance_steps": tolerance_steps}
    return _call("scale", preset, config, values, out=out, **inputs)


def _call(
    stage: str,
    preset: str | None,
    config: str | Path | None,
    values: Values | None,
    *,
    out: str | Path | None,
    **inputs: Any,
) -> dict[str, Any]:
    """Run a stage without notes, progress or tables: its result is returned."""
    silent = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    named = (inputs.get(name) for name in ("dataset", "encoder", "checkpoint"))
    if "plant" not in (values or {}) and any_of(RECORDED, named):
        values = {**(values or {}), "plant": RECORDED}
    settings = _settings(preset, config, values)
    return STAGES[stage].run(settings, silent, out=_path(out), **inputs)


def _with(values: Values | None, **given: Any) -> Values:
    """Return values with those that were given as arguments."""
    return {**(values or {}), **{key: value for key, value in given.items() if value is not None}}


def _settings(preset: str | None, config: str | Path | None, values: Values | None) -> Settings:
    return resolve(preset, _path(config), {"plant": None, **(values or {})})


def _path(path: str | Path | None) -> Path | None:
    return None if path is None else Path(path)
