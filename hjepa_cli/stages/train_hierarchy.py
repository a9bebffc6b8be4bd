"""``hjepa train-hierarchy --h 4 --m 2 --l 1``: P^H, P^M, P^L, ts-jepa-1 and the semantic actor.

Dataset + encoder checkpoint → one checkpoint with everything inference needs. The encoder is
frozen: every frame is encoded once, and all that follows are small networks on embeddings.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from hjepa_cli.core import levels
from hjepa_cli.core.bench import control_errors
from hjepa_cli.core.encoder import Encoder
from hjepa_cli.core.hierarchy import Strides
from hjepa_cli.core.levels import EmbeddedTrajectories
from hjepa_cli.core.methods import embedding_method
from hjepa_cli.core.metrics import window_means
from hjepa_cli.core.model import Model, build_modules, encode_frames, load_modules, tensors_of
from hjepa_cli.core.plant import plant
from hjepa_cli.core.seeding import generator
from hjepa_cli.core.training import Optimiser, autocast, fit_actor, resolve_device
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings
from hjepa_cli.stages.inputs import RenderedSplit, open_dataset, render, training_run, versions
from hjepa_cli.storage.checkpoints import MODEL_FILE, Checkpoint, load_checkpoint, save_checkpoint
from hjepa_cli.storage.datasets import Dataset
from hjepa_cli.storage.runs import Run, newest_run, read_config
from hjepa_cli.storage.zoo import resolve_model

STREAM = 3  # this stage's branch of the seed tree
REPORT_EVERY = 50  # steps between rows of metrics.csv


def run(
    settings: Settings,
    screen: Screen,
    *,
    dataset: Path | None = None,
    encoder: str | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Train the hierarchy on a frozen encoder; returns the document of spec §8.

    Raises:
        UsageError: strides that do not nest.
        MissingInputError: no dataset or no encoder.
        DataError: encoder and dataset belong to different plants.
        NumericalError: training diverged.
    """
    strides = Strides(settings.hierarchy.h, settings.hierarchy.m, settings.hierarchy.l)
    data = open_dataset(dataset, settings)
    recorded = data.split("train")
    source = open_encoder(encoder, settings)
    with training_run("train-hierarchy", out, settings, screen) as record:
        if record.result is not None:
            return record.result
        started = time.perf_counter()
        torch.manual_seed(settings.seed)
        screen.say(f"dataset {data.path}, encoder {source.path}, run {record.directory}")
        architecture = describe_architecture(source, settings)
        modules = build_modules(architecture)
        copy_encoder(source, modules, strides)
        modules.to(resolve_device(settings.device))

        train = render(recorded, settings.plant, screen)
        plain, mirrored = embed(modules["encoder"], train, settings, screen)
        labels = train.labels.flatten()
        screen.say("fitting the semantic actor")
        z_all = torch.cat([plain.z.flatten(0, 1), mirrored.z.flatten(0, 1)])
        actor = fit_actor(z_all, torch.cat([labels, -labels]), settings.actor, seed=settings.seed)
        modules["actor"].load_state_dict(actor.state_dict())
        train_levels(modules, plain, mirrored, strides, settings, record, screen)

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
            "health": source.metadata["health"],
        }
        path = record.path(MODEL_FILE)
        digest = save_checkpoint(path, tensors_of(modules), metadata)
        model = Model(modules, metadata, digest, settings.device)
        result = {
            "checkpoint": str(path),
            "strides": {"h": strides.h, "m": strides.m, "l": strides.l},
            "seconds": round(time.perf_counter() - started, 2),
            "nmae_windows": nmae_windows(model, data, settings),
        }
        result = record.finish(result)
        screen.say(f"model {path} in {result['seconds']:.0f} s; next: hjepa eval")
        return result


def open_encoder(name: str | None, settings: Settings) -> Checkpoint:
    """The encoder checkpoint at a path, or the newest finished ``train-encoder`` run that fits.

    Raises:
        MissingInputError: none there.
        DataError: trained on another plant.
    """
    if name is None:
        directory = newest_run(
            "train-encoder", lambda run: read_config(run)["plant"] == settings.plant
        )
        if directory is None:
            raise MissingInputError(
                f"no finished train-encoder run of plant {settings.plant} below runs/",
                hint="hjepa train-encoder, or pass --encoder PATH",
            )
        name = str(directory)
    checkpoint = load_checkpoint(resolve_model(name))
    if checkpoint.metadata["plant"] != settings.plant:
        raise DataError(
            f"encoder {checkpoint.path} was trained on plant {checkpoint.metadata['plant']}, "
            f"the dataset is of plant {settings.plant}",
            hint=f"hjepa train-encoder --plant {settings.plant}",
        )
    return checkpoint


def describe_architecture(source: Checkpoint, settings: Settings) -> dict[str, Any]:
    """The encoder's architecture with this stage's strides and actor."""
    hierarchy = settings.hierarchy
    return source.metadata["architecture"] | {
        "kind": "hierarchy",
        "h": hierarchy.h,
        "m": hierarchy.m,
        "l": hierarchy.l,
        "actor_hidden": settings.actor.hidden,
        "actor_dropout": settings.actor.dropout,
    }


def copy_encoder(source: Checkpoint, modules: nn.ModuleDict, strides: Strides) -> None:
    """Take Ψ from the encoder checkpoint, and P^H from its companion where h agrees."""
    trained = load_modules(source, "encoder")
    modules["encoder"].load_state_dict(trained["encoder"].state_dict())
    modules["encoder"].requires_grad_(False).eval()
    if source.metadata["architecture"]["h"] == strides.h:
        modules["high"].load_state_dict(trained["high"].state_dict())


def embed(
    encoder: nn.Module, train: RenderedSplit, settings: Settings, screen: Screen
) -> tuple[EmbeddedTrajectories, EmbeddedTrajectories]:
    """Frozen embeddings of the training frames and of their mirror images."""
    assert isinstance(encoder, Encoder)
    device = resolve_device(settings.device)
    count = len(train.frames)
    embedded = []
    with screen.progress("encode", 2 * count, "trajectories") as bar:
        for sign in (1.0, -1.0):
            parts = []
            for start in range(0, count, 20):
                part = train.slice(start, start + 20)
                pairs = part.pairs(1, mirrored=sign < 0)
                z = encode_frames(
                    encoder, pairs, device=device, precision=settings.encoder.precision
                )
                parts.append(z.unflatten(0, (len(part.frames), -1)))
                bar.advance(len(part.frames))
            embedded.append(
                EmbeddedTrajectories(torch.cat(parts).to(device), (sign * train.actions).to(device))
            )
    return embedded[0], embedded[1]


def train_levels(
    modules: nn.ModuleDict,
    plain: EmbeddedTrajectories,
    mirrored: EmbeddedTrajectories,
    strides: Strides,
    settings: Settings,
    record: Run,
    screen: Screen,
) -> None:
    """Train P^H, P^M, P^L and the flat baseline, in that order: each level builds on the last."""
    options = settings.hierarchy
    h, m, l = strides.h, strides.m, strides.l
    coarse_data = join(plain, mirrored)
    fine_data = join(
        plain.first(options.fine_trajectories), mirrored.first(options.fine_trajectories)
    )
    stream = generator(settings.seed, STREAM)
    device = resolve_device(settings.device)
    high, medium, low, flat = (modules[name] for name in ("high", "medium", "low", "flat"))
    common = {
        "horizon_steps": options.rollout_steps,
        "trajectories": options.batch_trajectories,
        "generator": stream,
    }

    def fit(name: str, role: str, steps: int, loss: Callable[[], Tensor]) -> None:
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
        with screen.progress(f"train {name}", steps, "steps") as bar:
            for step in range(steps):
                with autocast(device, settings.encoder.precision):
                    value = loss()
                optimiser.step(value, step)
                bar.advance(1, loss=value.item())
                if (step + 1) % REPORT_EVERY == 0 or step + 1 == steps:
                    record.metric({"level": name, "step": step + 1, "loss": value.item()})
        modules[name].eval()

    def high_loss() -> Tensor:
        return levels.flat_loss(high, coarse_data, h, starts=options.coarse_starts, **common)

    def medium_loss() -> Tensor:
        return levels.medium_loss(medium, high, fine_data, h, m, **common)

    def low_loss() -> Tensor:
        return levels.low_loss(low, medium, high, fine_data, h, m, l, **common)

    def flat_loss() -> Tensor:
        return levels.flat_loss(flat, coarse_data, 1, starts=options.flat_starts, **common)

    fit("high", "coarse", options.coarse_steps, high_loss)
    if h > m:
        fit("medium", "medium", options.medium_steps, medium_loss)
    if m > l:
        fit("low", "low", options.low_steps, low_loss)
    fit("flat", "coarse", options.flat_steps, flat_loss)


def join(plain: EmbeddedTrajectories, mirrored: EmbeddedTrajectories) -> EmbeddedTrajectories:
    """Trajectories and their mirror images as one set."""
    return EmbeddedTrajectories(
        torch.cat([plain.z, mirrored.z]), torch.cat([plain.actions, mirrored.actions])
    )


def nmae_windows(model: Model, data: Dataset, settings: Settings) -> dict[str, float]:
    """Prediction error of ``hjepa`` after a single packet, on the dataset's clean rollouts."""
    clean = data.split("clean")
    limit_n = plant(settings.plant).force_limit_n
    errors = control_errors(
        embedding_method("hjepa", model, settings.protocol.payload_bits_per_value),
        clean.states.astype(float),
        clean.teacher_n.astype(float),
        limit_n,
        min(settings.protocol.horizon, clean.steps - 1),
    )
    return {name: float(error.mean()) for name, error in window_means(errors).items()}
