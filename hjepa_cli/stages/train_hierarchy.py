"""``hjepa train-hierarchy --h 4 --m 2 --l 1``: P^H, P^M, P^L, ts-jepa-1 and the semantic actor.

``--h 4`` alone: one level of that stride, ts-jepa-1 and the actor.

Dataset + encoder checkpoint → one checkpoint with everything inference needs. The encoder is
frozen: every frame is encoded once, and all that follows are small networks on embeddings.
"""

import copy
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast, resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.control.force_error import window_means
from hjepa_cli.core.control.methods import build_method
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.networks import health
from hjepa_cli.core.networks.hierarchy import Strides
from hjepa_cli.core.networks.model import LEVELS, Model, build_modules, load_modules, tensors_of
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training import levels
from hjepa_cli.core.training.levels import EmbeddedTrajectories
from hjepa_cli.core.training.optimiser import Optimiser, fit_actor, name_samples
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import (
    RenderedSplit,
    check_stride,
    embed,
    labels_of,
    open_dataset,
    render,
    training_run,
    versions,
)
from hjepa_cli.stages.progress import Progress
from hjepa_cli.storage.checkpoints import MODEL_FILE, Checkpoint, load_checkpoint, save_checkpoint
from hjepa_cli.storage.runs import Run, describe_input, newest_run, read_config
from hjepa_cli.storage.zoo import find_model, resolve_model

STREAM = 3  # this stage's branch of the seed tree
REPORT_EVERY = 50  # steps between rows of metrics.csv
SHARED = ("actor", "flat")  # networks that depend on no stride
FLAT_SETTINGS = (  # all that the training of the flat baseline depends on
    *("rollout_steps", "batch_trajectories", "flat_starts", "flat_steps"),
    *("optimizer", "schedule", "gradient_clip", "coarse_learning_rate", "coarse_weight_decay"),
    "shifted_copies",
)
PICTURE_SETTINGS = ("precision", "shift_px", "light_spread", "camera_noise")  # of [encoder]
REFLEX = ("longest_age", "forces_at_once")  # of an encoder that comes with reflexes
ARCHITECTURE = (
    *("embedding", "hidden", "frame_input", "centre", "stride_actions", "residual"),
    "mirror",
)


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    encoder: str | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train the hierarchy on a frozen encoder; returns the document of ``--json``.

    Raises:
        UsageError: strides that do not nest, or no such device.
        MissingInputError: no dataset or no encoder.
        DataError: encoder and dataset belong to different plants.
        NumericalError: training diverged.
    """
    strides = Strides(settings.hierarchy.h, settings.hierarchy.m, settings.hierarchy.l)
    resolve_device(settings.device)  # refused before anything is read
    data = open_dataset(dataset, settings)
    recorded = {split: data.split(split) for split in ("train", "test")}
    check_stride(strides.h, recorded["train"].steps)
    source = open_encoder(encoder, settings, screen)
    inputs = {
        "dataset": describe_input(data.path, data.digest),
        "encoder": describe_input(source.path, source.digest),
    }
    with training_run("train-hierarchy", out, settings, inputs, screen) as (record, progress):
        if record.result is not None:
            show(record.result, screen)
            return record.result
        trained = load_modules(source)
        torch.manual_seed(settings.seed)
        screen.say(f"dataset {data.path}, encoder {source.path}, run {record.directory}")
        architecture = describe_architecture(source, settings)
        shared = SHARED if trained_alike(source, data, settings) else ()
        if shared:
            screen.say("actor and ts-jepa-1 are the encoder checkpoint's: same data and settings")
        modules = begin(architecture, source, trained, settings, shared)

        train, test = (render(of, settings, screen, split) for split, of in recorded.items())
        flip = architecture["mirror"] == "augment"
        seen = embed_all(modules["encoder"], train, settings, screen, flip=flip)
        if progress.fresh and "actor" not in shared:  # otherwise it comes back with the levels
            screen.say("fitting the semantic actor")
            fit_actor_to(modules, seen, settings, exact=architecture["mirror"] == "exact")
        embedded = [data for data, _ in seen]
        train_levels(modules, embedded, strides, settings, record, progress, screen, shared)

        metadata = {
            "stage": "train-hierarchy",
            "plant": settings.plant,
            "architecture": architecture,
            "settings": settings.as_dict(),
            "dataset": data.digest,
            "encoder": source.digest,
            "camera": data.camera,
            "seed": settings.seed,
            "versions": versions(),
            "health": source.metadata["health"] | examine(modules, test, strides.h, settings),
        }
        path = record.path(MODEL_FILE)
        digest = save_checkpoint(path, tensors_of(modules), metadata)
        model = Model(modules, metadata, digest, settings.device)
        result = {
            "checkpoint": str(path),
            "strides": {"h": strides.h, "m": strides.m, "l": strides.l},
            "seconds": round(progress.seconds, 2),
            "health": metadata["health"],
            "method": model.methods[0],
            "nmae_windows": nmae_windows(model, data, settings),
            "n_rollouts": len(data.split("clean")),
        }
        result = record.finish(result)
        progress.remove()
        show(result, screen)
        screen.say(f"model {path} in {result['seconds']:.0f} s; next: hjepa eval")
        return result


def begin(
    architecture: dict[str, Any],
    source: Checkpoint,
    trained: nn.ModuleDict,
    settings: Settings,
    shared: Sequence[str],
) -> nn.ModuleDict:
    """New networks, but for the frozen encoder, what is ``shared`` and the start of P^H."""
    kind = plant(settings.plant)
    modules = build_modules(architecture, kind.action_shape, kind.force_signs)
    modules["encoder"].requires_grad_(False).eval()
    taken = ["encoder", *shared]
    begun = source.metadata["architecture"]  # an encoder comes with a P^H, begun beside it
    if "high" in modules and (begun["kind"], begun["h"]) == ("encoder", architecture["h"]):
        taken.append("high")
    for name in taken:
        modules[name].load_state_dict(trained[name].state_dict())
    return modules.to(resolve_device(settings.device))


def fit_actor_to(
    modules: nn.ModuleDict,
    seen: list[tuple[EmbeddedTrajectories, Tensor]],
    settings: Settings,
    *,
    exact: bool,
) -> None:
    """Fit the semantic actor to all views of the training pictures; ``exact``: it mirrors."""
    actor = fit_actor(
        torch.cat([data.z.flatten(0, 1) for data, _ in seen]),
        torch.cat([labels.flatten(0, 1) for _, labels in seen]),
        settings.actor,
        seed=settings.seed,
        mirror=plant(settings.plant).force_signs if exact else None,
    )
    modules["actor"].load_state_dict(actor.state_dict())


def show(result: dict[str, Any], screen: Screen) -> None:
    """What the trained model does without packets, before ``eval`` closes the loop."""
    windows = result["nmae_windows"]
    screen.table(
        f"{result.get('method', 'hjepa')} alone after one packet: NMAE by steps "
        f"({result['n_rollouts']} clean rollouts); actor NRMSE and action sensitivity held out",
        [*windows, "actor NRMSE", "sensitivity"],
        [
            [
                *(f"{value:.3f}" for value in windows.values()),
                *(f"{result['health'][key]:.3f}" for key in ("actor_nrmse", "action_sensitivity")),
            ]
        ],
    )


def open_encoder(name: str | None, settings: Settings, screen: Screen) -> Checkpoint:
    """The encoder to build on: what ``--encoder`` names, or the newest run that fits, or the zoo's.

    A run fits if its plant and architecture are those of the settings. A checkpoint that is named
    brings its own architecture; any hierarchy checkpoint holds an encoder too.

    Raises:
        MissingInputError: none there.
        DataError: trained on another plant.
    """
    if name is None:
        wanted = (settings.plant, described(settings.as_dict()["encoder"]))

        def fits(run: Path) -> bool:
            config = read_config(run)
            is_jepa = config["encoder"].get("method", "jepa") == "jepa"
            return is_jepa and (config["plant"], described(config["encoder"])) == wanted

        found = newest_run("train-encoder", fits) or find_model(settings.plant)
        if found is None:
            raise MissingInputError(
                f"no finished train-encoder run of plant {settings.plant} and these settings "
                "below runs/, and none in the zoo",
                hint="hjepa train-encoder, or pass --encoder PATH",
            )
        if found.is_file():
            screen.say(f"no train-encoder run here that fits: encoder of the zoo, {found}")
        name = str(found)
    checkpoint = load_checkpoint(resolve_model(name))
    if checkpoint.metadata["plant"] != settings.plant:
        raise DataError(
            f"encoder {checkpoint.path} was trained on plant {checkpoint.metadata['plant']}, "
            f"the dataset is of plant {settings.plant}",
            hint=f"hjepa train-encoder --plant {settings.plant}",
        )
    architecture = checkpoint.metadata.get("architecture")
    if isinstance(architecture, dict) and architecture.get("kind") in ("supervised", "autoencoder"):
        raise DataError(
            f"{checkpoint.path} is a baseline on raw frames, no encoder for predictors",
            hint="hjepa train-encoder, or pass another --encoder",
        )
    return checkpoint


def trained_alike(source: Checkpoint, data: Dataset, settings: Settings) -> bool:
    """Whether what depends on no stride was trained in ``source`` as it would be now.

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
        and all(theirs["encoder"].get(key, 0) == mine["encoder"][key] for key in PICTURE_SETTINGS)
        and all(theirs["hierarchy"].get(key) == mine["hierarchy"][key] for key in FLAT_SETTINGS)
    )


def described(encoder: dict[str, Any]) -> dict[str, Any]:
    """The settings of an encoder that its architecture records."""
    return {name: encoder[name] for name in ARCHITECTURE}


def describe_architecture(source: Checkpoint, settings: Settings) -> dict[str, Any]:
    """The encoder's architecture with this stage's strides and actor."""
    hierarchy = settings.hierarchy
    levels = {hierarchy.h, hierarchy.m, hierarchy.l}
    begun = source.metadata["architecture"]
    return {key: value for key, value in begun.items() if key not in REFLEX} | {
        "kind": "hierarchy" if len(levels) > 1 else "flat",
        "h": hierarchy.h,
        "m": hierarchy.m,
        "l": hierarchy.l,
        "actor_hidden": settings.actor.hidden,
        "actor_dropout": settings.actor.dropout,
    }


def embed_all(
    encoder: nn.Module, train: RenderedSplit, settings: Settings, screen: Screen, *, flip: bool
) -> list[tuple[EmbeddedTrajectories, Tensor]]:
    """Embeddings and labels [N, T, *A] of the training pictures and of shifted copies of them.

    In a copy every trajectory is moved sideways by up to ``encoder.shift_px``, and the labels are
    what the teacher does there. With ``flip`` all of these are there in the mirror too.
    """
    device, kind, count = resolve_device(settings.device), plant(settings.plant), len(train.frames)
    mirror, teach = torch.tensor(kind.mirror), labels_of(train, kind)
    every = torch.arange(count)[:, None], torch.arange(train.states.shape[1])[None]
    views = []
    for mirrored, shifts_px in views_of(settings, count, flip=flip):
        side = mirror if mirrored else torch.ones_like(mirror)
        # A mirror image moved right is that of a picture moved left.
        labels = side * teach(*every, (-shifts_px if mirrored else shifts_px)[:, None])
        views.append((mirrored, side, shifts_px, labels))
    seen = []
    with screen.progress("encode", len(views) * count, "trajectories") as bar:
        for mirrored, side, shifts_px, labels in views:
            z = embed(
                encoder,
                train,
                settings,
                mirrored=mirrored,
                shifts_px=shifts_px if shifts_px.any() else None,
                advance=bar.advance,
            )
            data = EmbeddedTrajectories(z.to(device), (side * train.actions).to(device))
            seen.append((data, labels))
    return seen


def views_of(settings: Settings, count: int, *, flip: bool) -> list[tuple[bool, NDArray[np.int64]]]:
    """What training sees of ``count`` trajectories: as they are, shifted, and all in the mirror.

    Returns:
        Of each view whether it is mirrored, and how far right each of its trajectories is [N], px.
    """
    farthest = settings.encoder.shift_px
    copies = settings.hierarchy.shifted_copies if farthest else 0
    drawn = generator(settings.seed, STREAM, 0).integers(-farthest, farthest + 1, (copies, count))
    shifts = (np.zeros(count, dtype=np.int64), *drawn)
    return [
        (mirrored, moved) for mirrored in ((False, True) if flip else (False,)) for moved in shifts
    ]


@torch.inference_mode()
def examine(
    modules: nn.ModuleDict, test: RenderedSplit, h: int, settings: Settings
) -> dict[str, float]:
    """Held-out health of what this stage trained: the actor and the coarsest level."""
    z = embed(modules["encoder"], test, settings)
    coarsest = modules["high" if "high" in modules else "flat"]
    actor, coarsest = (
        copy.deepcopy(network).cpu().eval() for network in (modules["actor"], coarsest)
    )
    start, end = z[:, :-h].flatten(0, 1), z[:, h:].flatten(0, 1)
    return {
        "actor_nrmse": health.nrmse(actor.act(z), test.labels),
        "action_sensitivity": health.action_sensitivity(
            coarsest, start, end, h, plant(settings.plant).action_shape
        ),
    }


def train_levels(
    modules: nn.ModuleDict,
    seen: list[EmbeddedTrajectories],
    strides: Strides,
    settings: Settings,
    record: Run,
    progress: Progress,
    screen: Screen,
    trained: Sequence[str] = (),
) -> None:
    """Train the levels that the model has, in the order in which each builds on the last.

    Those ``trained`` already stay as they are.
    """
    options = settings.hierarchy
    h, m, l = strides.h, strides.m, strides.l
    coarse_data = join(seen)
    fine_data = join([data.first(options.fine_trajectories) for data in seen])
    device = resolve_device(settings.device)
    names = LEVELS["hierarchy"]
    high, medium, low, flat = (modules[name] if name in modules else None for name in names)
    count = options.batch_trajectories
    common = {"horizon_steps": options.rollout_steps, "trajectories": count}

    def fit(
        name: str,
        role: str,
        steps: int,
        data: EmbeddedTrajectories,
        loss: Callable[[Generator], Tensor],
    ) -> None:
        # Every level has its own stream: what one does changes no other.
        stream = generator(settings.seed, STREAM, 1 + names.index(name))
        optimiser = Optimiser(
            modules[name].parameters(),
            name=options.optimizer,
            schedule=options.schedule,
            steps=steps,
            learning_rate=getattr(options, f"{role}_learning_rate"),
            weight_decay=getattr(options, f"{role}_weight_decay"),
            gradient_clip=options.gradient_clip,
        )
        modules[name].train()
        parts = {"modules": modules, "optimiser": optimiser}
        done = progress.reached(name)
        with screen.progress(f"train {name}", steps, "steps", done=done) as bar:
            for step in progress.steps(name, steps, parts, stream):
                before = stream.bit_generator.state
                with autocast(device, settings.encoder.precision):
                    drawn = loss(stream)
                batch = functools.partial(name_batch, data, count, stream, before)
                value = optimiser.step(drawn, step, batch)
                bar.advance(1, loss=value)
                if (step + 1) % REPORT_EVERY == 0 or step + 1 == steps:
                    record.metric({"level": name, "step": step + 1, "loss": value})
        modules[name].eval()

    def high_loss(stream: Generator) -> Tensor:
        return levels.flat_loss(
            high, coarse_data, h, starts=options.coarse_starts, generator=stream, **common
        )

    def medium_loss(stream: Generator) -> Tensor:
        return levels.medium_loss(medium, high, fine_data, h, m, generator=stream, **common)

    def low_loss(stream: Generator) -> Tensor:
        return levels.low_loss(low, medium, high, fine_data, h, m, l, generator=stream, **common)

    def flat_loss(stream: Generator) -> Tensor:
        return levels.flat_loss(
            flat, coarse_data, 1, starts=options.flat_starts, generator=stream, **common
        )

    if high is not None:
        fit("high", "coarse", options.coarse_steps, coarse_data, high_loss)
    if h > m:
        fit("medium", "medium", options.medium_steps, fine_data, medium_loss)
    if m > l:
        fit("low", "low", options.low_steps, fine_data, low_loss)
    if "flat" not in trained:
        fit("flat", "coarse", options.flat_steps, coarse_data, flat_loss)


def name_batch(
    data: EmbeddedTrajectories, count: int, stream: Generator, state: dict[str, Any]
) -> str:
    """The trajectories that a loss drew from ``stream`` when it was in ``state``, for messages."""
    stream.bit_generator.state = state
    chosen = data.choose(count, stream)
    return name_samples(
        f"of {len(data.z)} (shifted and mirrored copies last) the trajectories", chosen
    )


def join(seen: list[EmbeddedTrajectories]) -> EmbeddedTrajectories:
    """Trajectories and, if they are used, their mirror images as one set."""
    return EmbeddedTrajectories(
        torch.cat([data.z for data in seen]), torch.cat([data.actions for data in seen])
    )


def nmae_windows(model: Model, data: Dataset, settings: Settings) -> dict[str, float]:
    """Prediction error of the model's first method after one packet, on the clean rollouts."""
    clean = data.split("clean")
    limit_n = plant(settings.plant).force_limit_n
    errors = control_errors(
        build_method(model.methods[0], settings, model),
        clean.states.astype(float),
        clean.teacher_n.astype(float),
        limit_n,
        min(settings.protocol.horizon, clean.steps - 1),
    )
    return {name: float(error.mean()) for name, error in window_means(errors).items()}
