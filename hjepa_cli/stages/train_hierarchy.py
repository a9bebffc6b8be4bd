"""``hjepa train-hierarchy --h 4 --m 2 --l 1`` trains P^H, P^M, P^L, ts-jepa-1 and the actor.

``--h 4`` alone trains one level of that stride, ts-jepa-1 and the actor.

Dataset + encoder checkpoint → one checkpoint with everything inference needs. The encoder is
frozen: every frame is encoded once, and all that follows are small networks on embeddings. At the
end it is hardened against worse pictures than it has seen.
"""

import copy
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from numpy.random import Generator
from torch import Tensor, nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.checks import FARTHEST_BACK, check_strides
from hjepa_cli.config.schema import HierarchySettings, Settings, look_of
from hjepa_cli.core.control.drivers import methods_of
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.datasets.trajectories import driven_by_teacher
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.encoder import Encoder
from hjepa_cli.core.networks.model import LEVELS, UNSAID, coarsest_of, levels_of, load_modules
from hjepa_cli.core.plants.frames import remembers_from
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training import levels
from hjepa_cli.core.training.hardening import Hardening
from hjepa_cli.core.training.levels import EmbeddedTrajectories
from hjepa_cli.core.training.optimiser import Optimiser, name_samples
from hjepa_cli.core.training.rendered import RenderedSplit, standardisation_sample
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.output.tables import show_hierarchy
from hjepa_cli.stages import train_encoder
from hjepa_cli.stages.embedding_training import (
    STREAM,
    begin,
    embed_all,
    fit_actor_to,
    fit_network,
    nmae_windows,
    plan_embedding,
    round_weights,
    save,
)
from hjepa_cli.stages.frame_training import fit as fit_on_frames
from hjepa_cli.stages.frame_training import frames_of_step
from hjepa_cli.stages.inputs import (
    brought_along,
    check_same_plant,
    count_frames,
    embed,
    sizes_of,
)
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
from hjepa_cli.storage.runs import newest_run, read_config
from hjepa_cli.storage.zoo import find_model, resolve_model

SHARED = ("actor", "flat")  # networks that depend on no stride
FLAT_SETTINGS = (  # all that the training of the flat baseline depends on
    *("rollout_steps", "batch_trajectories", "flat_starts", "flat_steps"),
    *("optimizer", "schedule", "gradient_clip", "coarse_learning_rate", "coarse_weight_decay"),
    "shifted_copies",
)
PICTURE_SETTINGS = ("precision", "shift_px", "light_spread", "camera_noise")  # of [encoder]
PLANT = ("plant", "recorded", "camera")  # what an encoder must have in common with a dataset
TRAINED_LATER = ("longest_age", "forces_at_once", "fusion")  # of train-reflex and train-fusion


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    encoder: str | Path | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train the hierarchy on a frozen encoder; return the document of ``--json``.

    Raises:
        UsageError: strides that do not nest, or no such device.
        MissingInputError: no dataset or no encoder.
        DataError: encoder and dataset belong to different plants.
        NumericalError: training diverged.
    """
    strides = settings.hierarchy
    check_strides(strides.h, strides.m, strides.l)
    data = open_training_data(dataset, settings, h=strides.h)
    settings = brought_along(settings, data[0].settings, data[0].path)
    source = open_encoder(encoder, settings, screen, data[0].path)
    train, name = partial(train_on, source), "train-hierarchy"
    return run_training(
        name, out, data, settings, screen, train=train, show=show_hierarchy, encoder=source
    )


def plan(
    settings: Settings,
    *,
    dataset: Path | None = None,
    encoder: str | Path | None = None,
    out: Path | None = None,
) -> Plan:
    """Plan the loops of the settings' strides on the embeddings of all views of the dataset."""

    def find(asked: Settings, path: Path | None) -> tuple[Checkpoint | None, str]:
        opened = partial(open_encoder, encoder, asked, Screen(quiet=True), path)
        return found("encoder", opened, encoder, "hjepa train-encoder")

    return plan_on(find, settings, dataset, out)


def plan_on(
    find: Callable[[Settings, Path | None], tuple[Checkpoint | None, str]],
    settings: Settings,
    dataset: Path | None = None,
    out: Path | None = None,
) -> Plan:
    """Plan for the encoder that is found, or for one that is not trained yet."""
    data, dataset_line, settings = planned_data(dataset, settings)
    source, encoder_line = find(settings, data.path if data else None)
    architecture = describe_architecture(settings)
    embedding, amounts = plan_embedding(settings, count_frames(data, settings, *SPLITS))
    steps = sum(level_steps(architecture, settings.hierarchy).values())
    h, m, l = (architecture[name] for name in ("h", "m", "l"))
    several = architecture["kind"] == "hierarchy"
    named = f"P^H, P^M, P^L (h, m, l = {h}, {m}, {l})" if several else f"one level (h = {h})"
    work = [embedding, f"train {named}, ts-jepa-1 and the actor ({steps} steps)"]
    if settings.augment.strength and (source is None or is_soft(source)):
        work.append(f"harden the encoder for {settings.augment.steps} steps on worse pictures")
        _, recorded_steps = sizes_of(data, settings)["train"]
        batch = frames_of_step(settings, recorded_steps)
        amounts["encoder hardening frames"] = settings.augment.steps * batch
    return plan_training(
        "train-hierarchy",
        settings,
        out,
        architecture,
        reads=[dataset_line, encoder_line],
        work=work,
        amounts={**amounts, "level training steps": steps},
    )


def train_on(source: Checkpoint, run: TrainingRun) -> dict[str, Any]:
    """Train on a checkpoint's encoder, examine and save; return the result."""
    settings, screen, data = run.settings, run.screen, run.dataset
    trained = load_modules(source)
    screen.say(f"dataset {data.path}, encoder {source.path}, run {run.record.directory}")
    architecture = describe_architecture(settings, source.metadata["architecture"])
    shared = SHARED if trained_alike(source, data, settings) else ()
    if shared:
        screen.say("actor and ts-jepa-1 are the encoder checkpoint's: same data and settings")
    modules = begin(architecture, trained, settings, taken=["encoder", *shared])
    train, test = run.render()
    flip = architecture["mirror"] == "augment"
    seen = embed_all(modules["encoder"], train, settings, screen, flip=flip)
    views = [view for view, _ in seen]
    if run.progress.fresh and "actor" not in shared:  # otherwise it comes back with the levels
        screen.say("fitting the semantic actor")
        labels = torch.cat([labels.flatten(0, 1) for _, labels in seen])
        fit_actor_to(modules, "actor", join(views).z.flatten(0, 1), labels, architecture, settings)
    # Predictors that start from copies of a first picture learn worse.
    assert isinstance(modules["encoder"], Encoder)
    first = remembers_from(modules["encoder"].look)
    first = max(min(first, views[0].z.shape[1] - 1 - architecture["h"]), 0)  # of short ones
    train_levels(run, modules, architecture, [view.since(first) for view in views], shared)
    if settings.augment.strength and is_soft(source):
        architecture = harden(run, modules, train, architecture)
    round_weights(modules)
    screen.say("measuring health on all frames")
    examined = examine(modules, train, test, architecture["h"], settings)
    model = save(run, modules, run.metadata(architecture, encoder=source.digest, health=examined))
    [method, *_] = methods_of(model)
    result = run.finish(
        strides={name: architecture[name] for name in ("h", "m", "l")},
        health=examined,
        method=method,
        nmae_windows=nmae_windows(model, method, data, settings),
        n_rollouts=data.splits[data.rollouts]["trajectories"],
    )
    show_hierarchy(result, screen)
    screen.say(f"model {result['checkpoint']} in {result['seconds']:.0f} s; next: hjepa eval")
    return result


def is_soft(source: Checkpoint) -> bool:
    """Return whether an encoder is to be hardened: those of newer models are hard already."""
    metadata = source.metadata
    return metadata["architecture"]["kind"] == "encoder" or "augment" not in metadata["settings"]


def harden(
    run: TrainingRun, modules: nn.ModuleDict, train: RenderedSplit, architecture: dict[str, Any]
) -> dict[str, Any]:
    """Train the encoder on worse pictures, so that it sees in them what it saw in clean ones.

    Returns:
        The architecture with where its frames lie from then on.
    """
    settings, augment, encoder = run.settings, run.settings.augment, modules["encoder"]
    assert isinstance(encoder, Encoder)
    device, clean_look = resolve_device(settings.device), encoder.look
    hardening = Hardening(modules, device, augment, architecture["h"])
    apart = {**architecture, "frame_spacing": "square"}
    farthest = min(FARTHEST_BACK, augment.frames_within_s / plant_of(settings).step_s)
    if clean_look[0] < look_of(apart)[0] <= farthest:
        architecture, look = apart, look_of(apart)
        calm = train[driven_by_teacher(settings)]
        hardening.look_elsewhere(look, standardisation_sample(calm.frames, look))
    fit_on_frames(
        run,
        train,
        "hardening",
        hardening,
        lambda terms: {"level": "hardening", "loss": sum(terms.values())},
        looks=(encoder.look, clean_look),
        steps=augment.steps,
        learning_rate=augment.learning_rate,
    )
    encoder.requires_grad_(False)
    return architecture


def open_encoder(
    name: str | Path | None, settings: Settings, screen: Screen, dataset: Path | None = None
) -> Checkpoint:
    """Open the encoder to build on: the named one, or the newest run's that fits, or the zoo's.

    A run fits if its plant and architecture are those of the settings. A checkpoint that is named
    brings its own architecture; any hierarchy checkpoint holds an encoder too.

    Raises:
        MissingInputError: none there.
        DataError: trained on another plant.
    """
    if name is None:
        mine = settings.as_dict()
        wanted = UNSAID | mine["encoder"]

        def fits(run: Path) -> bool:
            config = read_config(run)
            encoder = UNSAID | config["encoder"]
            is_jepa = encoder.get("method", "jepa") == "jepa"
            keys = (*train_encoder.ARCHITECTURE, *UNSAID)
            alike = all(encoder[key] == wanted[key] for key in keys)
            alike &= all(config.get(key) == mine.get(key) for key in PLANT)
            return is_jepa and alike

        newest = newest_run("train-encoder", fits, preset=settings.preset)
        name = newest or find_model(settings.plant)
        if name is None:
            raise MissingInputError(
                f"no finished train-encoder run of plant {settings.plant} and these settings "
                "below runs/, and none in the zoo",
                hint="hjepa train-encoder, or pass --encoder PATH",
            )
        if name.is_file():
            screen.say(f"no train-encoder run here that fits: encoder of the zoo, {name}")
    checkpoint = load_checkpoint(resolve_model(name))
    check_same_plant(checkpoint.metadata, settings, f"encoder {checkpoint.path}", dataset)
    architecture = checkpoint.metadata.get("architecture")
    if isinstance(architecture, dict) and architecture.get("kind") in ("supervised", "autoencoder"):
        raise DataError(
            f"{checkpoint.path} is a baseline on raw frames, no encoder for predictors",
            hint="hjepa train-encoder, or pass another --encoder",
        )
    return checkpoint


def trained_alike(source: Checkpoint, data: Dataset, settings: Settings) -> bool:
    """Tell whether what depends on no stride was trained in ``source`` as it would be now.

    Then one actor and one ``ts-jepa-1`` serve all strides on an encoder: comparisons between
    strides are not blurred by another training of either, and take half the time.
    """
    metadata, mine = source.metadata, settings.as_dict()
    if metadata["architecture"]["kind"] not in ("hierarchy", "flat"):
        return False
    theirs = metadata["settings"]
    return (
        (metadata["dataset"], metadata["seed"]) == (data.digest, settings.seed)
        and theirs["actor"] == mine["actor"]
        and theirs.get("augment") == mine.get("augment")
        and all(theirs["encoder"].get(key, 0) == mine["encoder"][key] for key in PICTURE_SETTINGS)
        and all(theirs["hierarchy"].get(key) == mine["hierarchy"][key] for key in FLAT_SETTINGS)
    )


def describe_architecture(
    settings: Settings, begun: dict[str, Any] | None = None
) -> dict[str, Any]:
    """Return the architecture ``begun`` by a checkpoint with this stage's strides and actor.

    Without one it is that of the encoder that the settings train.
    """
    hierarchy, begun = settings.hierarchy, begun or train_encoder.describe_architecture(settings)
    several = len({hierarchy.h, hierarchy.m, hierarchy.l}) > 1
    return without_later(begun) | {
        "kind": "hierarchy" if several else "flat",
        **{name: getattr(hierarchy, name) for name in ("h", "m", "l")},
        "actor_hidden": settings.actor.hidden,
        "actor_dropout": settings.actor.dropout,
    }


def without_later(architecture: dict[str, Any]) -> dict[str, Any]:
    """Return an architecture without what later stages train beside it: others do not have it."""
    return {key: value for key, value in architecture.items() if key not in TRAINED_LATER}


@torch.inference_mode()
def examine(
    modules: nn.ModuleDict, train: RenderedSplit, test: RenderedSplit, h: int, settings: Settings
) -> dict[str, Any]:
    """Return the held-out health of what is saved: encoder, actor and coarsest level.

    It is measured anew, as ``train-encoder`` does: hardening and rounding have moved the encoder.
    """
    kind = plant_of(settings)
    train_z, z = (embed(modules["encoder"], split, settings) for split in (train, test))
    names = ("actor", coarsest_of(modules))
    actor, coarsest = (copy.deepcopy(modules[name]).cpu().eval() for name in names)
    start, end = z[:, :-h].flatten(0, 1), z[:, h:].flatten(0, 1)
    return {
        **health.of_embeddings(
            train_z.flatten(0, 1),
            train.states_at(1),
            z.flatten(0, 1),
            test.states_at(1),
            kind.state_names,
        ),
        "action_sensitivity": health.action_sensitivity(coarsest, start, end, h, kind.action_shape),
        "actor_nrmse": health.nrmse(actor.act(z), test.labels),
        **train_encoder.know_actions(train_z, z, train, test, settings, h=h),
    }


def level_steps(architecture: dict[str, Any], options: HierarchySettings) -> dict[str, int]:
    """Return the steps of each level that is trained, each after those that it builds on.

    Where two strides are equal, the finer level of the two has nothing to do.
    """
    steps = {
        "high": options.coarse_steps,
        "medium": options.medium_steps if architecture["h"] > architecture["m"] else 0,
        "low": options.low_steps if architecture["m"] > architecture["l"] else 0,
        "flat": options.flat_steps,
    }
    return {name: steps[name] for name in levels_of(architecture) if steps[name]}


def train_levels(
    run: TrainingRun,
    modules: nn.ModuleDict,
    architecture: dict[str, Any],
    views: list[EmbeddedTrajectories],
    trained: Sequence[str] = (),
) -> None:
    """Train the levels that the architecture has; those ``trained`` already stay as they are."""
    options = run.settings.hierarchy
    h, m, l = (architecture[name] for name in ("h", "m", "l"))
    coarse_data = join(views)
    fine_data = join([view.first(options.fine_trajectories) for view in views])
    names, count = LEVELS["hierarchy"], options.batch_trajectories
    high, medium, low, flat = (modules[name] if name in modules else None for name in names)
    losses: dict[str, Callable[..., Tensor]] = {
        "high": partial(levels.flat_loss, high, coarse_data, h, starts=options.coarse_starts),
        "medium": partial(levels.medium_loss, medium, high, fine_data, h, m),
        "low": partial(levels.low_loss, low, medium, high, fine_data, h, m, l),
        "flat": partial(levels.flat_loss, flat, coarse_data, 1, starts=options.flat_starts),
    }
    for name, steps in level_steps(architecture, options).items():
        if name in trained:
            continue
        data, role = (fine_data, name) if name in ("medium", "low") else (coarse_data, "coarse")
        optimiser = Optimiser(
            modules[name].parameters(),
            name=options.optimizer,
            schedule=options.schedule,
            steps=steps,
            learning_rate=getattr(options, f"{role}_learning_rate"),
            weight_decay=getattr(options, f"{role}_weight_decay"),
            gradient_clip=options.gradient_clip,
        )
        loss = partial(losses[name], horizon_steps=options.rollout_steps, trajectories=count)
        # Every level has its own stream: what one does changes no other.
        stream = generator(run.settings.seed, STREAM, 1 + names.index(name))
        draw = partial(draw_batch, loss, data, count, stream)
        fit_network(run, modules, name, optimiser, stream, draw)


def draw_batch(
    loss: Callable[..., Tensor], data: EmbeddedTrajectories, count: int, stream: Generator
) -> Drawn:
    """Return the loss of ``count`` trajectories that it draws, and what names them."""
    before = stream.bit_generator.state

    def named() -> str:
        stream.bit_generator.state = before
        kind = f"of {len(data.z)} (shifted and mirrored copies last) the trajectories"
        return name_samples(kind, data.choose(count, stream))

    return loss(generator=stream), named


def join(views: list[EmbeddedTrajectories]) -> EmbeddedTrajectories:
    """Return all views of the trajectories as one set."""
    return EmbeddedTrajectories(
        *(torch.cat([getattr(view, name) for view in views]) for name in ("z", "actions"))
    )
