"""Every training stage has a dataset, a run directory, loops and a checkpoint.

Whatever is trained, a stage opens a dataset and perhaps a model that it builds on, takes up its run
where that was interrupted, renders both splits, runs its loops, and keeps one checkpoint with a
result beside it.
"""

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from numpy.random import Generator
from torch import Tensor, nn

from hjepa_cli.compute import memory
from hjepa_cli.compute.device import autocast, keep_freed_memory, resolve_device
from hjepa_cli.compute.torchrun import ContactLost
from hjepa_cli.compute.versions import versions
from hjepa_cli.config.schema import RECORDED, Settings
from hjepa_cli.core.datasets.dataset import Dataset, Trajectories
from hjepa_cli.core.networks.model import build_modules
from hjepa_cli.core.plants.frames import frame_bits
from hjepa_cli.core.plants.named import plant_of
from hjepa_cli.core.training.optimiser import Optimiser
from hjepa_cli.core.training.progress import Part, Progress
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.core.training.rendered import RenderedSplit
from hjepa_cli.errors import DataError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import results
from hjepa_cli.stages.inputs import brought_along, count_frames, open_dataset, render
from hjepa_cli.stages.plan import Plan, found, run_directory, seconds_of
from hjepa_cli.storage.checkpoints import MODEL_FILE, Checkpoint
from hjepa_cli.storage.files import canonical_json
from hjepa_cli.storage.runs import Run, describe_input

SPLITS = ("train", "test")

Architecture = Mapping[str, Any]  # of the networks in a checkpoint
TrainingData = tuple[Dataset, Mapping[str, Trajectories]]  # with the splits that training reads
Drawn = tuple[Tensor, Callable[[], str]]
"""The loss of a batch, and what names its samples in a message."""


@dataclasses.dataclass(frozen=True)
class TrainingRun:
    """A run of the training stage ``stage`` is open, in the directory of ``record``."""

    stage: str
    settings: Settings
    dataset: Dataset
    recorded: Mapping[str, Trajectories]
    record: Run
    progress: Progress
    screen: Screen
    ranks: Ranks = ALONE

    def render(self) -> list[RenderedSplit]:
        """Return the frames of both splits, for training and held out."""
        splits = [
            render(of, self.settings, self.screen, split) for split, of in self.recorded.items()
        ]
        for name, split in zip(self.recorded, splits, strict=True):
            if (split.frames == split.frames[0, 0]).all():
                raise _still(self.dataset, name, "frames")
        return splits

    def metadata(self, architecture: Architecture, **further: Any) -> dict[str, Any]:
        """Return what a checkpoint of this run says of itself, ``further`` included."""
        return {
            "stage": self.stage,
            "plant": self.settings.plant,
            "architecture": architecture,
            "settings": self.settings.as_dict(),
            "dataset": self.dataset.digest,
            "camera": self.dataset.camera,
            "seed": self.settings.seed,
            "versions": versions(),
            **further,
        }

    def finish(self, **result: Any) -> dict[str, Any]:
        """Write the result, which makes the run a finished one, and return it as it was kept."""
        path, seconds = self.record.path(MODEL_FILE), round(self.progress.seconds, 2)
        kept = self.record.finish({"checkpoint": path, "seconds": seconds, **result})
        self.progress.remove()
        return kept

    def fit(
        self,
        phase: str,
        optimiser: Optimiser,
        parts: Mapping[str, Part],
        stream: Generator,
        draw: Callable[[], Drawn],
        after: Callable[[int, float], None],
    ) -> None:
        """Train through the optimiser's schedule in a loop that survives an interruption.

        Args:
            phase: the loop's name.
            parts: all that the loop changes and that later ones need, by name.
            stream: the random numbers of ``draw``, which returns the loss of a batch.
            after: called after each step with the number of steps done and the loss.

        Raises:
            NumericalError: training diverged.
            Interrupted: the state is saved.
        """
        device, precision = resolve_device(self.settings.device), self.settings.encoder.precision
        steps, done = optimiser.steps, self.progress.reached(phase)
        parts = {**parts, "optimiser": optimiser}
        with self.screen.progress(f"train {phase}", steps, "steps", done=done) as bar:
            for step in self.progress.steps(phase, steps, parts, stream):
                with autocast(device, precision):
                    loss, named = draw()
                value = optimiser.step(loss, step, named)
                bar.advance(1, loss=value)
                after(step + 1, value)


def open_training_data(path: Path | None, settings: Settings, *, h: int = 0) -> TrainingData:
    """Open the dataset at ``path``, or the newest one, for strides of h steps if any.

    Raises:
        UsageError: no such device, or trajectories that are shorter than a stride.
        As :func:`~hjepa_cli.stages.inputs.open_dataset`.
    """
    resolve_device(settings.device)  # refused before anything is read
    dataset = open_dataset(path, settings)
    frames = count_frames(dataset, settings, *SPLITS)
    need_bytes = rendered_bytes(frames, dataset.frame_shape)
    memory.check(need_bytes, f"training on {frames} frames")
    recorded = {split: dataset.split(split) for split in SPLITS}
    check_stride(h, recorded["train"].steps)
    for name, split in recorded.items():
        if split.states.size and (split.states == split.states[0, 0]).all():
            raise _still(dataset, name, "states")
    return dataset, recorded


def planned_data(path: Path | None, settings: Settings) -> tuple[Dataset | None, str, Settings]:
    """Return a plan's dataset, if it is there yet, the line about it, and settings with its own."""
    data, line = found("dataset", lambda: open_dataset(path, settings), path, "hjepa collect")
    if data:
        settings = brought_along(settings, data.settings, data.path)
    return data, line, settings


def _still(dataset: Dataset, split: str, what: str) -> DataError:
    """Return the error of data without variance, of which nothing can be learned."""
    other = "hjepa collect with other starts or exploration in [collect] of --config FILE.toml"
    if dataset.plant == RECORDED:
        other = "hjepa data import SOURCE with recordings in which something moves"
    return DataError(
        f"dataset {dataset.path}: all {what} of split '{split}' are equal: nothing moves in it",
        hint=other,
    )


def run_training(
    stage: str,
    out: Path | None,
    data: TrainingData,
    settings: Settings,
    screen: Screen,
    *,
    train: Callable[[TrainingRun], dict[str, Any]],
    show: Callable[[dict[str, Any], Screen], None],
    ranks: Ranks = ALONE,
    **sources: Checkpoint,
) -> dict[str, Any]:
    """Return the result of ``train`` in the run directory of a stage, or that of a finished run.

    An interrupted run is taken up where its state was saved. ``sources`` are the checkpoints that
    the stage builds on, by the name of its input.

    Raises:
        DataError: the processes ``ranks`` do not see the same inputs and saved state.
    """
    keep_freed_memory()
    dataset, recorded = data
    settings = brought_along(settings, dataset.settings, dataset.path)
    inputs = {"dataset": describe_input(dataset.path, dataset.digest)}
    inputs |= {name: describe_input(one.path, one.digest) for name, one in sources.items()}
    with ExitStack() as stack:
        with ranks.together():
            record = stack.enter_context(
                Run.create(stage, out, settings.as_dict(), inputs)
                if ranks.leads
                else Run.follow(out)
            )
            if record.result is not None:
                screen.say(f"{record.directory} is finished; this is its result")
            progress = stack.enter_context(Progress(record, screen.say, ranks))
        digests = [value["sha256"] for value in inputs.values()]
        seen = canonical_json([settings.as_dict(), digests, progress.state])
        if len(set(ranks.gather(int(hashlib.sha256(seen.encode()).hexdigest()[:15], 16)))) > 1:
            raise DataError(
                "the processes do not see the same settings, dataset and saved state",
                hint="keep --dataset and --out on a disk that all machines share",
            )
        if record.result is not None:
            with results.showing(stage, record.result, record.directory):
                show(record.result, screen)
            return record.result
        run = TrainingRun(stage, settings, dataset, recorded, record, progress, screen, ranks)
        try:
            return train(run)
        except ContactLost as lost:
            lost.hint = record.continue_command if ranks.leads else lost.hint
            raise


def plan_training(
    stage: str,
    settings: Settings,
    out: Path | None,
    architecture: Architecture,
    *,
    reads: Sequence[str],
    work: Sequence[str],
    amounts: Mapping[str, float],
) -> Plan:
    """Plan a training stage that leaves a run with a checkpoint of an architecture."""
    with torch.device("meta"):
        tensors = untrained(architecture, settings).state_dict().values()
    return Plan(
        command=stage,
        reads=[*reads],
        work=[*work],
        writes=[f"run {run_directory(stage, out)}"],
        writes_bytes=sum(tensor.nbytes for tensor in tensors),
        seconds=5 + seconds_of(amounts),
        memory_bytes=rendered_bytes(amounts.get("rendered frames", 0), settings.camera.frame_shape),
    )


def rendered_bytes(frames: float, frame_shape: tuple[int, int, int]) -> float:
    """Return what a training's frames take while they are rendered: as parts, and as a whole."""
    return 2 * frames * frame_bits(frame_shape) / 8


def check_stride(h: int, steps: int) -> None:
    """Raise UsageError where a stride does not fit into trajectories of so many steps."""
    if h >= steps:
        raise UsageError(
            f"--h {h}: the dataset's trajectories have {steps} steps; choose --h below {steps}",
            hint=f"hjepa collect --steps {2 * h}, or a smaller --h",
        )


def untrained(architecture: Architecture, settings: Settings) -> nn.ModuleDict:
    """Return new networks of an architecture for the settings' plant, drawn by torch."""
    kind = plant_of(settings)
    return build_modules(architecture, kind.action_shape, kind.force_signs)
