"""``hjepa train-reflex``: rivals of the predictors that predict nothing.

Dataset + trained model → one checkpoint of its encoder and actor, both frozen, with four ways to
turn the last packet and its age into a force: the actor's force that fades, that of a law made for
fading, and two networks that learned the teacher's plan.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast, resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.codecs import build_codec
from hjepa_cli.core.control.force_error import window_means
from hjepa_cli.core.control.methods import build_method
from hjepa_cli.core.control.sensors import embedding_sensor
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import Model, build_modules, load_modules, tensors_of
from hjepa_cli.core.networks.reflex import Reflex
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.training import decay_fit, reflex_training
from hjepa_cli.core.training.decay_fit import Law, Trial
from hjepa_cli.core.training.optimiser import Optimiser, fit_actor, name_samples
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import (
    RenderedSplit,
    embed,
    open_dataset,
    render,
    training_run,
    versions,
)
from hjepa_cli.stages.model_set import default_model
from hjepa_cli.stages.progress import Progress
from hjepa_cli.stages.train_hierarchy import embed_all, views_of
from hjepa_cli.storage.checkpoints import MODEL_FILE, Checkpoint, load_checkpoint, save_checkpoint
from hjepa_cli.storage.runs import Run, describe_input
from hjepa_cli.storage.zoo import resolve_model

STREAM = 5  # this stage's branch of the seed tree
REPORT_EVERY = 50  # steps between rows of metrics.csv
NETWORKS = ("chunk", "chunk_forces")  # in the order in which they are trained


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    checkpoint: str | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train reflexes beside a frozen encoder and actor; returns the document of ``--json``.

    Raises:
        UsageError: no such device.
        MissingInputError: no dataset or no model.
        DataError: model and dataset belong to different plants, or the model has no actor.
        NumericalError: training diverged.
    """
    resolve_device(settings.device)  # refused before anything is read
    data = open_dataset(dataset, settings)
    recorded = {split: data.split(split) for split in ("train", "test")}
    source = open_model(checkpoint, settings, screen)
    inputs = {
        "dataset": describe_input(data.path, data.digest),
        "checkpoint": describe_input(source.path, source.digest),
    }
    with training_run("train-reflex", out, settings, inputs, screen) as (record, progress):
        if record.result is not None:
            show(record.result, screen)
            return record.result
        trained = load_modules(source)
        torch.manual_seed(settings.seed)
        screen.say(f"dataset {data.path}, model {source.path}, run {record.directory}")
        architecture = describe_architecture(source, settings)
        modules = begin(architecture, trained, settings)

        train, test = (render(of, settings, screen, split) for split, of in recorded.items())
        flip = architecture["mirror"] == "augment"
        seen = embed_all(modules["encoder"], train, settings, screen, flip=flip)
        z = torch.cat([embedded.z.flatten(0, 1) for embedded, _ in seen])
        train_networks(modules, z, train, settings, record, progress, screen, flip=flip)

        reflex, metadata = fit_decays(modules, z, train, source, data, settings, screen, flip=flip)
        metadata["health"] = source.metadata["health"] | examine(modules, test, reflex, settings)
        path = record.path(MODEL_FILE)
        digest = save_checkpoint(path, tensors_of(modules), metadata)
        model = Model(modules, metadata, digest, settings.device)
        result = {
            "checkpoint": str(path),
            "reflex": reflex,
            "seconds": round(progress.seconds, 2),
            "health": metadata["health"],
            "nmae_windows": nmae_windows(model, data, settings),
            "n_rollouts": len(data.split("clean")),
        }
        result = record.finish(result)
        progress.remove()
        show(result, screen)
        named = ",".join(model.methods)
        screen.say(f"model {path} in {result['seconds']:.0f} s; next: hjepa eval --methods {named}")
        return result


def open_model(name: str | None, settings: Settings, screen: Screen) -> Checkpoint:
    """The model to build on: what ``--checkpoint`` names, or the newest run's, or the zoo's.

    Raises:
        MissingInputError: none there.
        DataError: of another plant, or without an actor on embeddings.
    """
    path = resolve_model(name) if name else default_model(settings, screen)
    if path is None:
        raise MissingInputError(
            f"no trained model of plant {settings.plant}",
            hint="hjepa train-hierarchy, or pass --checkpoint PATH",
        )
    checkpoint = load_checkpoint(path)
    if checkpoint.metadata["plant"] != settings.plant:
        raise DataError(
            f"model {path} drives plant {checkpoint.metadata['plant']}, "
            f"the dataset is of plant {settings.plant}",
            hint=f"hjepa train-hierarchy --plant {settings.plant}",
        )
    architecture = checkpoint.metadata.get("architecture")
    kind = architecture.get("kind") if isinstance(architecture, dict) else None
    if kind not in ("hierarchy", "flat", "reflex"):
        raise DataError(
            f"{path} holds no actor on embeddings",
            hint="pass a --checkpoint of hjepa train-hierarchy",
        )
    return checkpoint


def describe_architecture(source: Checkpoint, settings: Settings) -> dict[str, Any]:
    """The model's architecture with this stage's networks."""
    return source.metadata["architecture"] | {
        "kind": "reflex",
        "longest_age": settings.protocol.gaps[-1],
        "forces_at_once": settings.reflex.forces_at_once,
    }


def begin(
    architecture: dict[str, Any], trained: nn.ModuleDict, settings: Settings
) -> nn.ModuleDict:
    """New networks, but for the frozen encoder and actor."""
    kind = plant(settings.plant)
    modules = build_modules(architecture, kind.action_shape, kind.force_signs)
    for name in ("encoder", "actor"):
        modules[name].load_state_dict(trained[name].state_dict())
        modules[name].requires_grad_(False).eval()
    return modules.to(resolve_device(settings.device))


def train_networks(
    modules: nn.ModuleDict,
    z: Tensor,
    train: RenderedSplit,
    settings: Settings,
    record: Run,
    progress: Progress,
    screen: Screen,
    *,
    flip: bool,
) -> None:
    """Train both networks on what the teacher does after each embedding z [N, D]."""
    options, device = settings.reflex, resolve_device(settings.device)
    starts, sides = states_behind(train, settings, flip=flip)
    for number, name in enumerate(NETWORKS):
        network = modules[name]
        assert isinstance(network, Reflex)
        stream = generator(settings.seed, STREAM, 1 + number)
        explore = stream if network.sees_forces else None
        screen.say(f"{name}: {len(starts)} plans of the teacher")
        plans = teacher_plans(network, starts, sides, settings, explore)
        optimiser = Optimiser(
            network.parameters(),
            name="adamw",
            schedule="one-cycle",
            steps=options.steps,
            learning_rate=options.learning_rate,
            weight_decay=options.weight_decay,
            gradient_clip=options.gradient_clip,
        )
        network.train()
        parts = {"modules": modules, "optimiser": optimiser}
        done = progress.reached(name)
        with screen.progress(f"train {name}", options.steps, "steps", done=done) as bar:
            for step in progress.steps(name, options.steps, parts, stream):
                drawn = reflex_training.draw(
                    network, len(starts), options.batch_packets, options.batch_ages, stream
                )
                with autocast(device, settings.encoder.precision):
                    loss = reflex_training.reflex_loss(network, z, plans, drawn)
                batch = functools.partial(name_samples, "embeddings", drawn.packets)
                value = optimiser.step(loss, step, batch)
                bar.advance(1, loss=value)
                if (step + 1) % REPORT_EVERY == 0 or step + 1 == options.steps:
                    record.metric({"level": name, "step": step + 1, "loss": value})
        network.eval()


def states_behind(train: RenderedSplit, settings: Settings, *, flip: bool) -> tuple[Floats, Floats]:
    """The states [N, S] that all embeddings show, and what their forces are multiplied by [N, F].

    A mirrored picture has the forces of its unmirrored state, mirrored.
    """
    kind, states = plant(settings.plant), train.states.numpy().astype(float)
    starts, sides = [], []
    for mirrored, shifts_px in views_of(settings, len(states), flip=flip):
        shown_px = -shifts_px if mirrored else shifts_px
        moved = kind.sideways(states, shown_px[:, None]) if shown_px.any() else states
        starts.append(moved.reshape(-1, states.shape[2]))
        side = np.array(kind.force_signs) if mirrored else np.ones(len(kind.force_signs))
        sides.append(np.tile(side, (len(starts[-1]), 1)))
    return np.concatenate(starts), np.concatenate(sides)


def teacher_plans(
    network: Reflex, starts: Floats, sides: Floats, settings: Settings, explore: Generator | None
) -> reflex_training.Plans:
    """What the teacher does from each state on, for a network's longest age and one call more."""
    kind, steps = plant(settings.plant), network.longest_age + network.shape[0]
    pushes_n = None
    if explore is not None:
        pushes_n = reflex_training.pushes(
            kind,
            len(starts),
            steps,
            exploration_n=settings.collect.exploration_n,
            hold_steps=settings.collect.exploration_hold_steps,
            generator=explore,
        )
    return reflex_training.follow(kind, starts, steps, sides=sides, pushes_n=pushes_n)


def fit_decays(
    modules: nn.ModuleDict,
    z: Tensor,
    train: RenderedSplit,
    source: Checkpoint,
    data: Dataset,
    settings: Settings,
    screen: Screen,
    *,
    flip: bool,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Search the law and both decays; ``modules["law"]`` learns the law.

    Returns:
        What the checkpoint says of them, and all of its metadata but its health.
    """
    options, kind = settings.reflex, plant(settings.plant)
    searched = {"candidates": options.search_candidates, "rounds": options.search_rounds}
    screen.say("searching laws whose force fades, on the true state")
    wide = Trial.make(
        kind,
        settings.protocol,
        devices=options.search_devices,
        steps=options.search_steps,
        seed=settings.seed,
    )
    law, _ = decay_fit.search_law(wide, seed=settings.seed, **searched)
    faded, gain = decay_fit.search_law(wide, seed=settings.seed, tied=True, **searched)
    starts, sides = states_behind(train, settings, flip=flip)
    architecture = describe_architecture(source, settings)
    fit_law(modules, z, labels_of_law(kind, law, starts, sides), architecture, settings)
    reflex: dict[str, Any] = {
        "gain": gain,
        "tau_steps": faded.tau_steps,
        "law": {"gains_n": law.gains_n.tolist(), "tau_steps": law.tau_steps, "gain": 1.0},
        "fitted": {
            "gaps": wide.gaps.tolist(),
            "devices": options.fit_devices,
            "warmup_steps": settings.protocol.warmup_steps,
            "steps": options.search_steps,
            "seed": settings.seed + decay_fit.SEARCH_SEED,
        },
    }
    metadata = {
        "stage": "train-reflex",
        "plant": settings.plant,
        "architecture": architecture,
        "settings": settings.as_dict(),
        "dataset": data.digest,
        "encoder": source.digest,
        "camera": data.camera,
        "seed": settings.seed,
        "versions": versions(),
        "health": source.metadata["health"],
        "reflex": reflex,
    }
    screen.say("fitting both decays on embeddings")
    model = Model(modules, metadata, "", settings.device)
    sensor = embedding_sensor(model, build_codec(settings.protocol.payload, model, settings))
    few = wide.first(options.fit_devices)
    for part, actor in ((reflex, model.actor), (reflex["law"], model.law)):
        part["gain"], part["tau_steps"] = decay_fit.fit_decay(
            few,
            actor,
            sensor,
            (part["gain"], part["tau_steps"]),
            candidates=options.fit_candidates,
            rounds=options.fit_rounds,
            seed=settings.seed,
        )
    return reflex, metadata


def fit_law(
    modules: nn.ModuleDict,
    z: Tensor,
    labels: Tensor,
    architecture: dict[str, Any],
    settings: Settings,
) -> None:
    """Fit the actor of a law to all embeddings, as the semantic actor is fitted to the teacher."""
    hidden, dropout = architecture["actor_hidden"], architecture["actor_dropout"]
    exact = architecture["mirror"] == "exact"
    fitted = fit_actor(
        z,
        labels,
        dataclasses.replace(settings.actor, hidden=hidden, dropout=dropout),
        seed=settings.seed,
        mirror=plant(settings.plant).force_signs if exact else None,
    )
    modules["law"].load_state_dict(fitted.state_dict())
    modules["law"].eval()


def labels_of_law(kind: System, law: Law, states: Floats, sides: Floats) -> Tensor:
    """Forces ÷ force limit [N, *A] of a law in states [N, S], clipped, mirrored by [N, F]."""
    forces_n = -states @ law.gains_n.T
    share = np.clip(forces_n / kind.force_limit_n, -1.0, 1.0) * sides
    return torch.from_numpy(share.reshape(len(states), *kind.action_shape).astype(np.float32))


@torch.inference_mode()
def examine(
    modules: nn.ModuleDict, test: RenderedSplit, reflex: dict[str, Any], settings: Settings
) -> dict[str, float]:
    """Held-out health of the actor of the law."""
    kind = plant(settings.plant)
    z = embed(modules["encoder"], test, settings).flatten(0, 1)
    law = Law(np.array(reflex["law"]["gains_n"]), reflex["law"]["tau_steps"])
    states = test.states.numpy().astype(float).reshape(len(z), -1)
    truth = labels_of_law(kind, law, states, np.ones((len(z), law.gains_n.shape[0])))
    device = resolve_device(settings.device)
    return {"law_nrmse": health.nrmse(modules["law"].act(z.to(device)).cpu(), truth)}  # type: ignore[operator]


def nmae_windows(model: Model, data: Dataset, settings: Settings) -> dict[str, dict[str, float]]:
    """How far each method's forces are from the teacher's after one packet, on clean rollouts."""
    clean = data.split("clean")
    steps = min(settings.protocol.horizon, clean.steps - 1)
    found = {}
    for name in model.methods:
        errors = control_errors(
            build_method(name, settings, model),
            clean.states.astype(float),
            clean.teacher_n.astype(float),
            model.force_limit_n,
            steps,
        )
        windows = window_means(errors)
        found[name] = {window: float(error.mean()) for window, error in windows.items()}
    return found


def show(result: dict[str, Any], screen: Screen) -> None:
    """What each method does after one packet, and how the forces fade."""
    reflex = result["reflex"]
    decays = {"hold-decay": reflex, "hold-decay-linear": reflex["law"]}
    windows = list(next(iter(result["nmae_windows"].values())))
    screen.table(
        f"after one packet: NMAE by steps ({result['n_rollouts']} clean rollouts); factor and "
        "time of what fades",
        ["method", *windows, "s", "τ [steps]"],
        [
            [
                name,
                *(f"{errors[window]:.3f}" for window in windows),
                f"{decays[name]['gain']:.2f}" if name in decays else "-",
                f"{decays[name]['tau_steps']:.1f}" if name in decays else "-",
            ]
            for name, errors in result["nmae_windows"].items()
        ],
    )
