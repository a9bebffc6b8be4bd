"""``hjepa train-reflex`` trains rivals of the predictors, which predict nothing.

Dataset + trained model → one checkpoint of its encoder and actor, both frozen, with four ways to
turn the last packet and its age into a force: the actor's force that fades, that of a law made for
fading, and two networks that learned the teacher's plan.
"""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from torch import Tensor, nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.arrays import Floats
from hjepa_cli.core.control.drivers import coder_of, methods_of
from hjepa_cli.core.control.sensors import embedding_sensor
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.model import ON_EMBEDDINGS, Model, load_modules
from hjepa_cli.core.networks.reflex import Reflex
from hjepa_cli.core.plants.control_law import control_law
from hjepa_cli.core.plants.frames import WIDTH_PX
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.plants.system import System
from hjepa_cli.core.training import decay_fit, reflex_training
from hjepa_cli.core.training.decay_fit import Law, Trial
from hjepa_cli.core.training.optimiser import Optimiser, name_samples
from hjepa_cli.core.training.reflex_training import Plans
from hjepa_cli.core.training.rendered import RenderedSplit
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.output.tables import show_reflex
from hjepa_cli.stages import train_hierarchy
from hjepa_cli.stages.embedding_training import (
    begin,
    embed_all,
    fit_actor_to,
    fit_network,
    nmae_windows,
    plan_embedding,
    round_weights,
    save,
    views_of,
)
from hjepa_cli.stages.inputs import (
    brought_along,
    check_same_plant,
    count_frames,
    embed,
    refuse_recorded,
)
from hjepa_cli.stages.model_set import default_model
from hjepa_cli.stages.plan import Plan, found
from hjepa_cli.stages.training import (
    SPLITS,
    Drawn,
    TrainingRun,
    open_training_data,
    plan_training,
    planned_data,
    run_training,
)
from hjepa_cli.storage.checkpoints import Checkpoint, load_checkpoint
from hjepa_cli.storage.zoo import resolve_model

STREAM = 5  # this stage's branch of the seed tree
NETWORKS = ("chunk", "chunk_forces")  # in the order in which they are trained


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train reflexes beside a frozen encoder and actor; return the document of ``--json``.

    Raises:
        UsageError: no such device.
        MissingInputError: no dataset or no model.
        DataError: model and dataset belong to different plants, or the model has no actor.
        NumericalError: training diverged.
    """
    refuse_recorded(settings, "reflexes are trained on what the teacher does elsewhere")
    data = open_training_data(dataset, settings)
    settings = brought_along(settings, data[0].settings, data[0].path)
    source = open_model(checkpoint, settings, screen, data[0].path)
    train, name = functools.partial(train_on, source), "train-reflex"
    return run_training(
        name, out, data, settings, screen, train=train, show=show_reflex, checkpoint=source
    )


def plan(
    settings: Settings,
    *,
    dataset: Path | None = None,
    checkpoint: str | Path | None = None,
    out: Path | None = None,
) -> Plan:
    """Plan the networks' loops and the searches on the embeddings of all views of the dataset."""
    refuse_recorded(settings, "reflexes are trained on what the teacher does elsewhere")
    options, protocol = settings.reflex, settings.protocol
    data, dataset_line, settings = planned_data(dataset, settings)
    quiet, path = Screen(quiet=True), data.path if data else None
    find = functools.partial(open_model, checkpoint, settings, quiet, path)
    _, model_line = found("model", find, checkpoint, "hjepa train-hierarchy")
    embedding, amounts = plan_embedding(settings, count_frames(data, settings, *SPLITS))
    plans = len(NETWORKS) * len(views_of(settings, 0, flip=settings.encoder.mirror == "augment"))
    plans *= count_frames(data, settings, "train")
    samples = len(NETWORKS) * options.steps * options.batch_packets * options.batch_ages
    # Two laws and two decays are searched, each at a few gaps around the one that is looked for.
    gaps = 1 if options.gap_steps else len(decay_fit.AROUND)
    steps = 2 * gaps * (protocol.warmup_steps + options.search_steps)
    laws = options.search_candidates * options.search_rounds * options.search_devices
    decays = options.fit_candidates * options.fit_rounds * options.fit_devices
    return plan_training(
        "train-reflex",
        settings,
        out,
        describe_architecture(settings),
        reads=[dataset_line, model_line],
        work=[
            embedding,
            f"train {len(NETWORKS)} networks for {options.steps} steps of "
            f"{options.batch_packets} packets at {options.batch_ages} ages",
            "search a law whose force fades, and fit two decays on embeddings",
        ],
        amounts={
            **amounts,
            "reflex training samples": samples,
            "device-steps of searches": laws * steps + plans * protocol.gaps[-1],
            "device-steps on states": decays * steps,
            "closed-loop frames": 4 * decays * steps / protocol.gaps[-1],  # two packets a gap
        },
    )


def train_on(source: Checkpoint, run: TrainingRun) -> dict[str, Any]:
    """Train beside a checkpoint's encoder and actor, examine and save; return the result."""
    settings, screen, data = run.settings, run.screen, run.dataset
    trained = load_modules(source)
    screen.say(f"dataset {data.path}, model {source.path}, run {run.record.directory}")
    architecture = describe_architecture(settings, source.metadata["architecture"])
    modules = begin(architecture, trained, settings, taken=("encoder", "actor"))
    modules["actor"].requires_grad_(False).eval()

    train, test = run.render()
    flip = architecture["mirror"] == "augment"
    seen = embed_all(modules["encoder"], train, settings, screen, flip=flip)
    z = torch.cat([embedded.z.flatten(0, 1) for embedded, _ in seen])
    starts, sides = states_behind(train, settings, flip=flip)
    train_networks(run, modules, z, starts, sides)

    law, trial, reflex = search_laws(settings, screen)
    labels = labels_of_law(plant_of(settings), law, starts, sides)
    fit_actor_to(modules, "law", z, labels, architecture, settings)
    round_weights(modules)
    metadata = run.metadata(
        architecture, encoder=source.digest, health=source.metadata["health"], reflex=reflex
    )
    screen.say("fitting both decays on embeddings")
    fit_decays(Model(modules, metadata, "", settings.device), trial, reflex, settings)
    metadata["health"] = metadata["health"] | examine(modules, test, law, settings)
    model = save(run, modules, metadata)
    methods = methods_of(model)
    result = run.finish(
        reflex=reflex,
        health=metadata["health"],
        nmae_windows={name: nmae_windows(model, name, data, settings) for name in methods},
        n_rollouts=len(data.split("clean")),
    )
    show_reflex(result, screen)
    screen.say(
        f"model {result['checkpoint']} in {result['seconds']:.0f} s; "
        f"next: hjepa eval --methods {','.join(methods)}"
    )
    return result


def open_model(
    name: str | Path | None, settings: Settings, screen: Screen, dataset: Path | None
) -> Checkpoint:
    """Open the model to build on: the named one, or the newest run's, or the zoo's.

    Raises MissingInputError without one, DataError for another plant's or one without an actor on
    embeddings.
    """
    path = resolve_model(name) if name else default_model(settings, screen)
    if path is None:
        raise MissingInputError(
            f"no trained model of plant {settings.plant}",
            hint="hjepa train-hierarchy, or pass --checkpoint PATH",
        )
    checkpoint = load_checkpoint(path)
    check_same_plant(checkpoint.metadata, settings, f"model {path}", dataset)
    architecture = checkpoint.metadata.get("architecture")
    kind = architecture.get("kind") if isinstance(architecture, dict) else None
    if kind not in ON_EMBEDDINGS:
        raise DataError(
            f"{path} holds no actor on embeddings",
            hint="pass a --checkpoint of hjepa train-hierarchy",
        )
    return checkpoint


def describe_architecture(
    settings: Settings, begun: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the architecture ``begun`` by a checkpoint with this stage's networks.

    Without one it is that of the hierarchy that the settings train.
    """
    begun = begun or train_hierarchy.describe_architecture(settings)
    return train_hierarchy.without_later(begun) | {
        "kind": "reflex",
        "longest_age": settings.protocol.gaps[-1],
        "forces_at_once": settings.reflex.forces_at_once,
    }


def train_networks(
    run: TrainingRun, modules: nn.ModuleDict, z: Tensor, starts: Floats, sides: Floats
) -> None:
    """Train both networks on what the teacher does after each embedding z [N, D]."""
    settings, options = run.settings, run.settings.reflex
    for number, name in enumerate(NETWORKS, start=1):
        network = modules[name]
        assert isinstance(network, Reflex)
        stream = generator(settings.seed, STREAM, number)
        explore = stream if network.sees_forces else None
        run.screen.say(f"{name}: {len(starts)} plans of the teacher")
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

        def draw(
            network: Reflex = network, plans: Plans = plans, stream: Generator = stream
        ) -> Drawn:
            count, ages = options.batch_packets, options.batch_ages
            rows, drawn_ages = reflex_training.draw(network, len(z), count, ages, stream)
            loss = reflex_training.reflex_loss(network, z, plans, rows, drawn_ages)
            return loss, functools.partial(name_samples, "embeddings", rows)

        fit_network(run, modules, name, optimiser, stream, draw)


def states_behind(train: RenderedSplit, settings: Settings, *, flip: bool) -> tuple[Floats, Floats]:
    """Return the states [N, S] that all embeddings show, and the factors [N, F] of their forces.

    A mirrored picture has the forces of its unmirrored state, mirrored.
    """
    kind, states = plant_of(settings), train.states.numpy().astype(float)
    starts, sides = [], []
    for view in views_of(settings, len(states), flip=flip):
        shown_px = view.before_px * (WIDTH_PX / train.frames.shape[-2])  # in the camera's own
        moved = kind.sideways(states, shown_px[:, None]) if shown_px.any() else states
        starts.append(moved.reshape(-1, states.shape[2]))
        side = np.array(kind.force_signs) if view.mirrored else np.ones(len(kind.force_signs))
        sides.append(np.tile(side, (len(starts[-1]), 1)))
    return np.concatenate(starts), np.concatenate(sides)


def teacher_plans(
    network: Reflex, starts: Floats, sides: Floats, settings: Settings, explore: Generator | None
) -> Plans:
    """Return what the teacher does from each state on, for a network's longest age and a call."""
    kind, steps = plant_of(settings), network.longest_age + network.shape[0]
    options, pushes_n = settings.collect, None
    if explore is not None:
        pushes_n = reflex_training.pushes(
            *(kind, len(starts), steps),
            exploration_n=options.exploration_n,
            hold_steps=options.exploration_hold_steps,
            generator=explore,
        )
    act = control_law(kind, settings.control)
    return reflex_training.follow(kind, act, starts, steps, sides=sides, pushes_n=pushes_n)


def search_laws(settings: Settings, screen: Screen) -> tuple[Law, Trial, dict[str, Any]]:
    """Search laws whose force fades, on the true state.

    Returns:
        The best law, the trial of the search, and what the checkpoint says of it: the law, how
        the teacher's own force would fade, and what decays are to be fitted to.
    """
    options, protocol, seed = settings.reflex, settings.protocol, settings.seed
    searched = {"candidates": options.search_candidates, "rounds": options.search_rounds}
    screen.say("searching laws whose force fades, on the true state")
    kind, devices = plant_of(settings), options.search_devices
    act = control_law(kind, settings.control)
    steps, gap_steps = options.search_steps, options.gap_steps
    trial = Trial.make(
        kind, act, protocol, devices=devices, steps=steps, seed=seed, gap_steps=gap_steps
    )
    law, _ = decay_fit.search_law(trial, seed=seed, **searched)
    faded, gain = decay_fit.search_law(trial, seed=seed, tied=True, **searched)
    said = {
        "gain": gain,
        "tau_steps": faded.tau_steps,
        "law": {"gains_n": law.gains_n.tolist(), "tau_steps": law.tau_steps, "gain": 1.0},
        "fitted": {
            "gaps": trial.gaps.tolist(),
            "devices": options.fit_devices,
            "warmup_steps": protocol.warmup_steps,
            "steps": options.search_steps,
            "seed": seed + decay_fit.SEARCH_SEED,
        },
    }
    return law, trial, said


def fit_decays(model: Model, trial: Trial, reflex: dict[str, Any], settings: Settings) -> None:
    """Fit gain and time of both decays in ``reflex``, the actor's and the law's, to embeddings."""
    options = settings.reflex
    sensor = embedding_sensor(model, coder_of(settings, model).send)
    few = trial.first(options.fit_devices)
    searched = {"candidates": options.fit_candidates, "rounds": options.fit_rounds}
    for part, actor in ((reflex, model.actor), (reflex["law"], model.law)):
        start = (part["gain"], part["tau_steps"])
        part["gain"], part["tau_steps"] = decay_fit.fit_decay(
            few, actor, sensor, start, seed=settings.seed, **searched
        )


def labels_of_law(kind: System, law: Law, states: Floats, sides: Floats) -> Tensor:
    """Return a law's forces ÷ force limit [N, *A] in states [N, S], clipped, times sides [N, F]."""
    forces_n = -states @ law.gains_n.T
    share = np.clip(forces_n / kind.force_limit_n, -1.0, 1.0) * sides
    return torch.from_numpy(share.reshape(len(states), *kind.action_shape).astype(np.float32))


@torch.inference_mode()
def examine(
    modules: nn.ModuleDict, test: RenderedSplit, law: Law, settings: Settings
) -> dict[str, float]:
    """Return the held-out health of the actor of a law."""
    z = embed(modules["encoder"], test, settings).flatten(0, 1)
    states = test.states.numpy().astype(float).reshape(len(z), -1)
    truth = labels_of_law(plant_of(settings), law, states, np.ones((1, len(law.gains_n))))
    device = resolve_device(settings.device)
    return {"law_nrmse": health.nrmse(modules["law"].act(z.to(device)).cpu(), truth)}  # type: ignore[operator]
