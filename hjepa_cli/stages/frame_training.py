"""Training on camera frames: the loop that all methods of ``train-encoder`` share."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from hjepa_cli.compute.device import autocast, resolve_device
from hjepa_cli.compute.seeding import generator
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.plants.frames import frames_seen
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.training.batches import FrameWindows, TrajectoryBatch
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.inputs import RenderedSplit, labels_of
from hjepa_cli.stages.progress import Progress
from hjepa_cli.storage.runs import Run

STREAM = 2  # this stage's branch of the seed tree


class Objective(Protocol):
    """What a loop minimises, and the networks behind it."""

    def losses(self, batch: TrajectoryBatch) -> dict[str, Tensor]:
        """Named scalar terms of a batch."""
        ...

    def total(self, terms: dict[str, Tensor]) -> Tensor:
        """Their sum, weighted."""
        ...

    def train(self) -> None:
        """Put what learns into training mode."""
        ...

    def after_step(self) -> None:
        """What follows a step of the optimiser."""
        ...

    def parts(self) -> dict[str, nn.Module]:
        """Everything that training changes, by name."""
        ...

    def parameters(self) -> Iterator[nn.Parameter]:
        """Everything the optimiser trains."""
        ...


Look = Callable[[dict[str, float]], dict[str, Any]]
"""Called every epoch with the loss terms; returns the row of ``metrics.csv`` without its step."""


@dataclasses.dataclass(frozen=True)
class Training:
    """What the loops of one run share: the data, and where to report.

    Attributes:
        settings: of the run.
        train, test: frames of both splits.
        record, progress, screen: the run, its saved state, the terminal.
        ranks: the processes that train.
    """

    settings: Settings
    train: RenderedSplit
    test: RenderedSplit
    record: Run
    progress: Progress
    screen: Screen
    ranks: Ranks = ALONE

    def fit(self, phase: str, objective: Objective, look: Look) -> None:
        """Train for ``encoder.steps`` steps, all phases on the same windows.

        Every batch is ``batch_trajectories`` windows of ``batch_frames`` frames, h steps apart.

        Raises:
            NumericalError: training diverged.
            Interrupted: the state is saved.
        """
        settings, options, ranks = self.settings, self.settings.encoder, self.ranks
        kind, device = plant(settings.plant), resolve_device(settings.device)
        optimiser = Optimiser(
            objective.parameters(),
            name=options.optimizer,
            schedule=options.schedule,
            steps=options.steps,
            learning_rate=options.learning_rate,
            weight_decay=options.weight_decay,
            gradient_clip=options.gradient_clip,
            ranks=ranks,
        )
        windows = FrameWindows(
            self.train.frames,
            self.train.actions,
            window_frames=options.batch_frames,
            stride=options.h,
            mirror=options.mirror == "augment",
            shift_px=options.shift_px,
            mirrored_actions=kind.mirror,
            labels=labels_of(self.train, kind),
            frames_each=options.frames,
        )
        stream = generator(settings.seed, STREAM)
        count = options.batch_trajectories
        share = ranks.share(count)
        part = (share.stop - share.start) / count  # 1 on a single process
        frames_n = self.train.states[..., 0].numel()
        epoch_steps = max(frames_n // (count * windows.window_frames), 1)
        parts = objective.parts() | {"optimiser": optimiser}
        done = self.progress.reached(phase)
        with self.screen.progress(f"train {phase}", options.steps, "steps", done=done) as bar:
            for step in self.progress.steps(phase, options.steps, parts, stream):
                objective.train()
                batch = windows.draw(count, stream, share)
                with autocast(device, options.precision):
                    terms = {name: part * term for name, term in objective.losses(batch).items()}
                total = objective.total(terms)
                loss = optimiser.step(total, step, lambda batch=batch: batch.drawn)
                objective.after_step()
                bar.advance(1, loss=loss)
                if (step + 1) % epoch_steps == 0:
                    ranks.add_up(list(terms.values()))
                    if ranks.leads:
                        row = look({name: term.item() for name, term in terms.items()})
                        self.record.metric({"step": step + 1, **row})


def standardisation_sample(frames: Tensor, count: int = 512, *, frames_each: int = 2) -> Tensor:
    """Evenly spaced inputs [≤ ``count``, κ, H, W, 3] of the training split [N, T + 1, H, W, 3]."""
    length = frames.shape[1]
    total = len(frames) * length
    current = np.linspace(1, total - 1, min(count, total - 1)).astype(int)
    rows, stored = np.divmod(current[current % length != 0], length)  # 0 has no predecessor
    seen = torch.from_numpy(frames_seen(stored - 1, frames_each))
    return frames[torch.from_numpy(rows)[:, None], seen]
