"""``train-hierarchy`` and ``train-reflex`` share their training on frozen embeddings."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor, nn

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.force_error import window_means
from hjepa_cli.core.datasets.dataset import Dataset
from hjepa_cli.core.evaluation.control_errors import control_errors
from hjepa_cli.core.networks.model import Model, tensors_of
from hjepa_cli.core.plants.control_law import control_law
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training.levels import EmbeddedTrajectories
from hjepa_cli.core.training.optimiser import Optimiser, fit_actor
from hjepa_cli.core.training.rendered import RenderedSplit, labels_of
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import embed
from hjepa_cli.stages.training import Architecture, Drawn, TrainingRun, untrained
from hjepa_cli.storage.checkpoints import MODEL_FILE, save_checkpoint

STREAM = 3  # of the shifts, and of train-hierarchy, in the seed tree
REPORT_EVERY = 50  # steps between rows of metrics.csv


def begin(
    architecture: Architecture, trained: nn.ModuleDict, settings: Settings, *, taken: Sequence[str]
) -> nn.ModuleDict:
    """Return new networks, but for those ``taken`` from others; the encoder is frozen."""
    torch.manual_seed(settings.seed)
    modules = untrained(architecture, settings)
    for name in taken:
        modules[name].load_state_dict(trained[name].state_dict())
        round_weights(modules[name])
    modules["encoder"].requires_grad_(False).eval()
    return modules.to(resolve_device(settings.device))


@torch.no_grad()
def round_weights(module: nn.Module) -> None:
    """Round weights to bfloat16, which most machines compute with: half the bytes in a file."""
    for weights in module.parameters():
        weights.copy_(weights.bfloat16())


def plan_embedding(settings: Settings, frames: int) -> tuple[str, dict[str, float]]:
    """Return the line of a plan about all views of so many frames, and the amounts of work."""
    views = len(views_of(settings, 0, flip=settings.encoder.mirror == "augment"))
    line = f"render and encode about {frames} frames"
    amounts: dict[str, float] = {"rendered frames": frames, "encoded frames": (1 + views) * frames}
    return line + f", those for training {views} times" * (views > 1), amounts


def embed_all(
    encoder: nn.Module, train: RenderedSplit, settings: Settings, screen: Screen, *, flip: bool
) -> list[tuple[EmbeddedTrajectories, Tensor]]:
    """Return embeddings and labels [N, T, *A] of the training pictures and of shifted copies.

    In a copy every trajectory is moved sideways by up to ``encoder.shift_px``, and the labels are
    what the teacher does there. With ``flip`` all of these are there in the mirror too.
    """
    device, kind, count = resolve_device(settings.device), plant_of(settings), len(train.frames)
    act, mirror = control_law(kind, settings.control), torch.tensor(kind.mirror)
    teach = labels_of(train, kind, act)
    every = torch.arange(count)[:, None], torch.arange(train.states.shape[1])[None]
    views = []
    for view in views_of(settings, count, flip=flip):
        side = mirror if view.mirrored else torch.ones_like(mirror)
        labels = side * teach(*every, view.before_px[:, None])
        views.append((view, side * train.actions, labels))
    seen: list[tuple[EmbeddedTrajectories, Tensor]] = []
    with screen.progress("encode", len(views) * count, "trajectories") as bar:
        for view, actions, labels in views:
            z = embed(
                *(encoder, train, settings),
                mirrored=view.mirrored,
                shifts_px=view.shifts_px if view.shifts_px.any() else None,
                advance=bar.advance,
            )
            seen.append((EmbeddedTrajectories(z.to(device), actions.to(device)), labels))
    return seen


@dataclasses.dataclass(frozen=True)
class View:
    """All trajectories in training are seen once more like this.

    Attributes:
        mirrored: whether in the mirror.
        shifts_px: how far right each trajectory is [N].
    """

    mirrored: bool
    shifts_px: NDArray[np.int64]

    @property
    def before_px(self) -> NDArray[np.int64]:
        """Return how far right the trajectories were before the mirror [N]."""
        # A mirror image moved right is that of a picture moved left.
        return -self.shifts_px if self.mirrored else self.shifts_px


def views_of(settings: Settings, count: int, *, flip: bool) -> list[View]:
    """Return the views of ``count`` trajectories in training.

    They are as they are, shifted, and all of these in the mirror.
    """
    farthest = settings.encoder.shift_px
    copies = settings.hierarchy.shifted_copies if farthest else 0
    drawn = generator(settings.seed, STREAM, 0).integers(-farthest, farthest + 1, (copies, count))
    shifts = (np.zeros(count, dtype=np.int64), *drawn)
    return [View(mirrored, moved) for mirrored in (False, True)[: 1 + flip] for moved in shifts]


def fit_network(
    run: TrainingRun,
    modules: nn.ModuleDict,
    name: str,
    optimiser: Optimiser,
    stream: Generator,
    draw: Callable[[], Drawn],
    *,
    phase: str | None = None,
) -> None:
    """Train the one called ``name`` of a run's networks, as :meth:`TrainingRun.fit`.

    The ``phase`` has a name of its own where one network is trained in several.
    """
    phase = phase or name

    def report(step: int, loss: float) -> None:
        if step % REPORT_EVERY == 0 or step == optimiser.steps:
            run.record.metric({"step": step, "level": phase, "loss": loss})

    modules[name].train()
    run.fit(phase, optimiser, {"modules": modules}, stream, draw, report)
    modules[name].eval()


def fit_actor_to(
    modules: nn.ModuleDict,
    name: str,
    z: Tensor,
    labels: Tensor,
    architecture: Architecture,
    settings: Settings,
) -> None:
    """Fit an actor to labels [N, *A] of embeddings [N, D], in the architecture's size."""
    hidden, dropout = architecture["actor_hidden"], architecture["actor_dropout"]
    exact = architecture["mirror"] == "exact"
    fitted = fit_actor(
        z,
        labels,
        dataclasses.replace(settings.actor, hidden=hidden, dropout=dropout),
        seed=settings.seed,
        mirror=plant_of(settings).force_signs if exact else None,
    )
    modules[name].load_state_dict(fitted.state_dict())
    modules[name].eval()


def save(run: TrainingRun, modules: nn.ModuleDict, metadata: dict[str, Any]) -> Model:
    """Keep the checkpoint of a run, and return it as the model that drives."""
    path = run.record.path(MODEL_FILE)
    digest = save_checkpoint(path, tensors_of(modules), metadata, narrow=True)
    return Model(modules, metadata, digest, run.settings.device)


def nmae_windows(model: Model, method: str, data: Dataset, settings: Settings) -> dict[str, float]:
    """Return how far a method's forces are from the teacher's after one packet, by windows.

    Both are on the clean rollouts, or on what was held out of recordings; the error is ÷ the force
    range.
    """
    clean = data.split(data.rollouts)
    errors = control_errors(
        build_driver(method, settings, model),
        clean.states.astype(float) if data.frames == "rendered" else clean.frames,
        clean.teacher_n.astype(float),
        model.force_limit_n,
        min(settings.protocol.horizon, clean.steps - 1),
    )
    return {window: float(error.mean()) for window, error in window_means(errors).items()}
