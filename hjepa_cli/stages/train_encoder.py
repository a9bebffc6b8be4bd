"""``hjepa train-encoder``: learn Ψ and its companion P^H from rendered frames, or a baseline.

Dataset → checkpoint. The story: render the trajectories once, train on whole sub-sampled
trajectories, look at the representation's health every epoch, and let the stage gates decide
whether the result is worth handing on. The baselines are in :mod:`hjepa_cli.stages.baselines`.
"""

import math
from pathlib import Path
from typing import Any

import torch
from torch import nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.config.settings import Settings, dotted
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import build_modules, tensors_of
from hjepa_cli.core.networks.predictors import Predictor
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training.jepa import Jepa
from hjepa_cli.core.training.optimiser import fit_actor
from hjepa_cli.core.training.ranks import Ranks, joined
from hjepa_cli.core.training.shared_norm import share_statistics
from hjepa_cli.errors import NumericalError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import baselines
from hjepa_cli.stages.frame_training import Training, standardisation_sample
from hjepa_cli.stages.inputs import (
    RenderedSplit,
    check_stride,
    embed,
    open_dataset,
    render,
    training_run,
    versions,
)
from hjepa_cli.storage.checkpoints import MODEL_FILE, save_checkpoint
from hjepa_cli.storage.runs import describe_input

REJECTED_FILE = "rejected.safetensors"  # what did not pass the gates: nothing trained is lost
PROBE_EPOCHS = 20  # of the quick probe actor that watches training …
WATCHED = 80  # … on so many training trajectories: a look must not cost more than it tells


def run(
    settings: Settings, screen: Screen, *, dataset: Path | None = None, out: Path | None = None
) -> dict[str, Any]:
    """Train, gate and save an encoder or a baseline; returns the document of ``--json``.

    Under ``torchrun`` several processes share the steps; the first does all the rest.

    Raises:
        UsageError: no such device, too many processes, or several of them for a baseline.
        MissingInputError: no dataset.
        NumericalError: training diverged, or a gate failed (see ``settings.encoder.gate``).
    """
    device = resolve_device(settings.device)  # refused before anything is read
    with joined(device, settings.encoder.batch_trajectories) as ranks:
        if ranks.size > 1 and settings.encoder.method != "jepa":
            raise UsageError(f"torchrun trains the jepa alone, not {settings.encoder.method}")
        return _run(settings, screen, dataset, out, ranks)


def _run(
    settings: Settings, screen: Screen, dataset: Path | None, out: Path | None, ranks: Ranks
) -> dict[str, Any]:
    with ranks.together():
        data = open_dataset(dataset, settings)
        recorded = {split: data.split(split) for split in ("train", "test")}
        check_stride(settings.encoder.h, recorded["train"].steps)
    inputs = {"dataset": describe_input(data.path, data.digest)}
    with training_run("train-encoder", out, settings, inputs, screen, ranks) as (record, progress):
        if record.result is not None:
            show_gates(screen, record.result["gates"], enforced=settings.encoder.gate)
            return record.result
        torch.manual_seed(settings.seed)
        screen.say(f"dataset {data.path} ({settings.plant}), run {record.directory}")
        train, test = (render(of, settings, screen, split) for split, of in recorded.items())
        architecture = describe_architecture(settings)
        kind = plant(settings.plant)
        modules = build_modules(architecture, kind.action_shape, kind.force_signs)
        training = Training(settings, train, test, record, progress, screen, ranks)
        if settings.encoder.method == "jepa":
            report = train_jepa(modules, training)
        else:
            report = baselines.train(modules, training)
        if not ranks.leads:
            return {}
        gates = judge(report, settings)
        accepted = all(gate["passed"] for gate in gates.values()) or not settings.encoder.gate
        path = record.path(MODEL_FILE if accepted else REJECTED_FILE)
        metadata = {
            "stage": "train-encoder",
            "plant": settings.plant,
            "architecture": architecture,
            "settings": settings.as_dict(),
            "dataset": data.digest,
            "camera": data.camera,
            "seed": settings.seed,
            "versions": versions(),
            "health": report,
        }
        save_checkpoint(path, tensors_of(modules), metadata)
        show_gates(screen, gates, enforced=settings.encoder.gate)
        if not accepted:
            refuse(gates, path, settings)
        result = {
            "checkpoint": str(path),
            "seconds": round(progress.seconds, 2),
            "health": report,
            "gates": gates,
        }
        result = record.finish(result)
        progress.remove()
        following = "train-hierarchy" if settings.encoder.method == "jepa" else "eval"
        screen.say(f"{path} in {result['seconds']:.0f} s; next: hjepa {following}")
        return result


def describe_architecture(settings: Settings) -> dict[str, Any]:
    """What :func:`build_modules` needs, as it goes into the checkpoint."""
    encoder = settings.encoder
    if encoder.method != "jepa":
        return baselines.describe_architecture(settings)
    return {
        "kind": "encoder",
        "embedding": encoder.embedding,
        "hidden": encoder.hidden,
        "frame_input": encoder.frame_input,
        "centre": encoder.centre,
        "stride_actions": encoder.stride_actions,
        "residual": encoder.residual,
        "mirror": encoder.mirror,
        "h": encoder.h,
        "m": encoder.h,  # one level: the companion
        "l": encoder.h,
    }


def train_jepa(modules: nn.ModuleDict, training: Training) -> dict[str, Any]:
    """Train Ψ and P^H in place; returns their health, of the process that leads."""
    settings, ranks, options = training.settings, training.ranks, training.settings.encoder
    kind = plant(settings.plant)
    encoder, companion = modules["encoder"], modules["high"]
    assert isinstance(encoder, Encoder) and isinstance(companion, Predictor)
    encoder.fit_standardisation(standardisation_sample(training.train.frames))
    if ranks.size > 1:
        if options.regulariser != "none":
            raise UsageError(
                f"encoder.regulariser = {options.regulariser!r} looks at a whole batch, and "
                f"{ranks.size} processes share one",
                hint="train with it in one process, without torchrun",
            )
        share_statistics(encoder)
    jepa = Jepa(
        encoder,
        companion,
        ema_decay=options.ema_decay,
        inverse_dynamics=options.inverse_dynamics,
        rollout_strides=max(options.rollout_steps // options.h, 1),
        device=resolve_device(settings.device),
        forces=math.prod(kind.action_shape),
        mirror=kind.force_signs if options.mirror == "exact" else None,
        regulariser=options.regulariser,
        regulariser_weight=options.regulariser_weight,
        seed=settings.seed,
    )

    def look(terms: dict[str, float]) -> dict[str, Any]:
        few, every = training.train.slice(0, WATCHED), math.gcd(4, options.h)
        report = examine(encoder, companion, few, training.test, settings, every=every)
        return {f"loss_{name}": value for name, value in terms.items()} | dotted(report, "_")

    training.fit("jepa", jepa, look)
    encoder.eval()
    if not ranks.leads:
        return {}
    training.screen.say("measuring health on all frames and fitting the probe actor")
    return examine(
        encoder, companion, training.train, training.test, settings, every=1, epochs=None
    )


def examine(
    encoder: Encoder,
    companion: Predictor,
    train: RenderedSplit,
    test: RenderedSplit,
    settings: Settings,
    *,
    every: int,
    epochs: int | None = PROBE_EPOCHS,
) -> dict[str, Any]:
    """Health of frozen embeddings, from every ``every``-th frame of both splits.

    ``every`` divides h, so that the embeddings a stride apart are among them.
    ``epochs`` limits the probe actor's fit; ``None`` fits it in full, on mirrored frames too when
    training flips them.
    """
    options, device = settings.encoder, resolve_device(settings.device)
    kind = plant(settings.plant)
    encoder.eval()

    train_z, test_z = (embed(encoder, split, settings, every=every) for split in (train, test))
    per_trajectory, train_z, test_z = test_z, train_z.flatten(0, 1), test_z.flatten(0, 1)
    train_states, test_states = train.states_at(every), test.states_at(every)
    fit_z, fit_labels = train_z, train.labels_at(every)
    if epochs is None and options.mirror == "augment":
        mirrored = embed(encoder, train, settings, every=every, mirrored=True)
        fit_z = torch.cat([fit_z, mirrored.flatten(0, 1)])
        fit_labels = torch.cat([fit_labels, torch.tensor(kind.mirror) * fit_labels])
    actor = fit_actor(
        fit_z,
        fit_labels,
        settings.actor,
        seed=settings.seed,
        epochs=epochs,
        mirror=kind.force_signs if options.mirror == "exact" else None,
    )
    ahead = options.h // every
    start, end = per_trajectory[:, :-ahead].flatten(0, 1), per_trajectory[:, ahead:].flatten(0, 1)
    with torch.no_grad():
        sensitivity = health.action_sensitivity(
            companion.cpu().eval(), start, end, options.h, kind.action_shape
        )
        error = health.nrmse(actor.act(test_z), test.labels_at(every))
    companion.to(device).train()
    return {
        "probe_r2": health.probe_r2(train_z, train_states, test_z, test_states, kind.state_names),
        "effective_rank": health.effective_rank(test_z),
        "std": float(test_z.std(0).mean()),
        "action_sensitivity": sensitivity,
        "actor_nrmse": error,
    }


def judge(report: dict[str, Any], settings: Settings) -> dict[str, dict[str, Any]]:
    """Compare the health report with the stage gates."""
    options, states = settings.encoder, plant(settings.plant).state_names
    lower_bounds = {
        f"probe_r2_{name}": bound for name, bound in zip(states, options.least_r2, strict=True)
    }
    lower_bounds |= {
        "effective_rank": options.gate_rank,
        "action_sensitivity": options.gate_sensitivity,
    }
    if options.method != "jepa":
        lower_bounds = {}  # a baseline is there to act, and nothing else
    values = dotted(report, "_")
    gates = {
        name: {"value": values[name], "threshold": bound, "passed": values[name] >= bound}
        for name, bound in lower_bounds.items()
    }
    error, limit = values["actor_nrmse"], options.gate_actor_nrmse
    gates["actor_nrmse"] = {"value": error, "threshold": limit, "passed": error <= limit}
    return gates


def show_gates(screen: Screen, gates: dict[str, dict[str, Any]], *, enforced: bool) -> None:
    """One row per gate."""
    rows = [
        [
            name,
            f"{gate['value']:.3f}",
            f"{'≤' if name == 'actor_nrmse' else '≥'} {gate['threshold']:g}",
            "passed" if gate["passed"] else "FAILED",
        ]
        for name, gate in gates.items()
    ]
    title = "health, held out" + "; gates are off, nothing stops here" * (not enforced)
    screen.table(title, ["measure", "value", "gate", ""], rows)


def refuse(gates: dict[str, dict[str, Any]], path: Path, settings: Settings) -> None:
    """Stop the pipeline at a representation that cannot carry control."""
    failed = [
        f"{name} {gate['value']:.3f} (gate {gate['threshold']:g})"
        for name, gate in gates.items()
        if not gate["passed"]
    ]
    is_jepa = settings.encoder.method == "jepa"
    further = "train-hierarchy --encoder" if is_jepa else "eval --checkpoint"
    raise NumericalError(
        f"the encoder failed its gate: {', '.join(failed)}",
        hint="collect more trajectories or train for more steps; --no-gate skips the gate, and "
        f"hjepa {further} {path} goes on with this one",
    )
