"""What training stages take in: a dataset that fits, rendered frames, versions."""

import dataclasses
import hashlib
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli import __version__
from hjepa_cli.compute.device import resolve_device
from hjepa_cli.compute.memory import keep_freed_memory
from hjepa_cli.compute.torchrun import ContactLost
from hjepa_cli.config.settings import Settings
from hjepa_cli.core.datasets.dataset import (
    Dataset,
    Trajectories,
    find_newest_dataset,
    load_dataset,
)
from hjepa_cli.core.networks.model import encode_frames
from hjepa_cli.core.plants.conditions import vary
from hjepa_cli.core.plants.frames import frames_seen
from hjepa_cli.core.plants.named import plant, plant_of
from hjepa_cli.core.plants.system import System, same_camera
from hjepa_cli.core.training.batches import Labels, shift_sideways
from hjepa_cli.core.training.ranks import ALONE, Ranks
from hjepa_cli.errors import DataError, MissingInputError, UsageError
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages.progress import Progress
from hjepa_cli.storage.files import canonical_json
from hjepa_cli.storage.runs import Run

CHUNK = 20  # trajectories rendered or encoded at a time: progress shows, memory stays small


@dataclasses.dataclass(frozen=True)
class RenderedSplit:
    """One split in memory, as training reads it.

    Attributes:
        frames: uint8 [N, T + 1, H, W, 3]; index 0 is the frame before k = 0.
        states: float32 [N, T, S] at k = 0 … T − 1.
        actions: applied actions ÷ force limit [N, T, *A].
        labels: teacher's actions ÷ force limit [N, T, *A].
    """

    frames: Tensor
    states: Tensor
    actions: Tensor
    labels: Tensor

    def seen(self, every: int, *, frames: int = 2, mirrored: bool = False) -> Tensor:
        """What a device looks at in k = 0, ``every``, …: uint8 [N · K, κ, H, W, 3], κ frames."""
        steps = np.arange(0, self.frames.shape[1] - 1, every)
        seen = self.frames[:, torch.from_numpy(frames_seen(steps, frames))]
        return (seen.flip(-2) if mirrored else seen).flatten(0, 1)

    def slice(self, start: int, stop: int) -> "RenderedSplit":
        """Trajectories ``start`` … ``stop`` − 1."""
        return RenderedSplit(
            *(
                values[start:stop]
                for values in (self.frames, self.states, self.actions, self.labels)
            )
        )

    def states_at(self, every: int) -> Tensor:
        """States [N · K, S] that go with :meth:`seen`."""
        return self.states[:, ::every].flatten(0, 1)

    def labels_at(self, every: int) -> Tensor:
        """Labels [N · K, *A] that go with :meth:`seen`."""
        return self.labels[:, ::every].flatten(0, 1)


def embed(
    encoder: Callable[[Tensor], Tensor],
    split: RenderedSplit,
    settings: Settings,
    *,
    every: int = 1,
    frames: int = 2,
    mirrored: bool = False,
    shifts_px: NDArray[np.int64] | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> Tensor:
    """Frozen embeddings [N, K, D] of k = 0, ``every``, …, from κ frames.

    ``mirrored`` takes the frames' mirror images; each trajectory is then moved right by
    ``shifts_px`` [N].
    """
    device = resolve_device(settings.device)
    precision = settings.encoder.precision
    parts = []
    for start in range(0, len(split.frames), CHUNK):
        part = split.slice(start, start + CHUNK)
        seen = part.seen(every, frames=frames, mirrored=mirrored)
        if shifts_px is not None:
            by_trajectory = seen.unflatten(0, (len(part.frames), -1))
            moved = zip(by_trajectory, shifts_px[start : start + CHUNK].tolist(), strict=True)
            seen = torch.cat([shift_sideways(frames, shift_px) for frames, shift_px in moved])
        z = encode_frames(encoder, seen, device=device, precision=precision)
        parts.append(z.unflatten(0, (len(part.frames), -1)))
        advance(len(part.frames))
    return torch.cat(parts)


def labels_of(split: RenderedSplit, kind: System) -> Labels:
    """The teacher's actions on a split: as recorded, or asked anew where pictures are moved.

    What it returns raises a UsageError for a plant whose pictures cannot be moved.
    """
    act = kind.teacher()

    def labels(trajectories: Tensor, k: Tensor, shifts_px: NDArray[np.int64]) -> Tensor:
        if not shifts_px.any():
            return split.labels[trajectories, k]
        states = split.states[trajectories, k].numpy().astype(float)
        forces_n = act(kind.sideways(states, shifts_px))
        return torch.from_numpy(forces_n / kind.force_limit_n).to(split.labels.dtype)

    return labels


def check_stride(h: int, steps: int) -> None:
    """Refuse strides that do not fit into the trajectories.

    Raises:
        UsageError: naming the longest that does.
    """
    if h >= steps:
        raise UsageError(
            f"--h {h}: the dataset's trajectories have {steps} steps; choose --h below {steps}",
            hint=f"hjepa collect --steps {2 * h}, or a smaller --h",
        )


def open_dataset(path: Path | None, settings: Settings) -> Dataset:
    """The dataset at ``path``, or the newest one of the settings' plant below ``data/``.

    Raises:
        MissingInputError: there is none.
        DataError: it belongs to another plant, or was collected with another camera.
        UsageError: the settings do not fit their plant.
    """
    kind = plant_of(settings)
    path = path or find_newest_dataset(Path("data"), settings.plant)
    if path is None:
        raise MissingInputError(
            f"no dataset of plant {settings.plant} below data/",
            hint=f"hjepa collect --plant {settings.plant}, or pass --dataset DIR",
        )
    data = load_dataset(path, settings.plant)
    if not same_camera(data.camera, kind):
        raise DataError(
            f"dataset {path} was collected with another camera than plant {kind.name} has now",
            hint=f"hjepa collect --plant {kind.name}",
        )
    return data


def render(
    trajectories: Trajectories, settings: Settings, screen: Screen, split: str = "train"
) -> RenderedSplit:
    """Frames of a split, rendered now unless the dataset stores them, in varied light and noise."""
    kind = plant(settings.plant)
    limit_n, frames = kind.force_limit_n, trajectories.frames
    if frames is None:
        camera = kind.camera()
        count = len(trajectories)
        parts = []
        with screen.progress("render", count, "trajectories") as bar:
            for start in range(0, count, CHUNK):
                chunk = trajectories.states[start : start + CHUNK]
                images = camera.render(chunk.reshape(-1, chunk.shape[-1]))
                parts.append(images.reshape(*chunk.shape[:2], *images.shape[1:]))
                bar.advance(len(chunk))
        frames = np.concatenate(parts)
    return RenderedSplit(
        frames=torch.from_numpy(vary(frames, settings, split)),
        states=torch.from_numpy(trajectories.states[:, 1:].copy()),
        actions=torch.from_numpy(trajectories.applied_n / limit_n),
        labels=torch.from_numpy(trajectories.teacher_n / limit_n),
    )


@contextmanager
def training_run(
    stage: str,
    out: Path | None,
    settings: Settings,
    inputs: Mapping[str, Any],
    screen: Screen,
    ranks: Ranks = ALONE,
) -> Iterator[tuple[Run, Progress]]:
    """The run directory of a training stage, its ``result`` set if it is a finished one.

    An interrupted run is taken up where its state was saved.

    Raises:
        DataError: the processes ``ranks`` do not see the same inputs and saved state.
    """
    keep_freed_memory()
    with ExitStack() as stack:
        with ranks.together():
            record = stack.enter_context(
                Run.create(stage, out, settings.as_dict(), inputs)
                if ranks.leads
                else Run.follow(out)
            )
            if record.result is not None:
                screen.say(f"{record.directory} is finished; this is its result")
            progress = stack.enter_context(Progress(record, screen, ranks))
        digests = [value["sha256"] for value in inputs.values()]
        seen = canonical_json([settings.as_dict(), digests, progress.state])
        if len(set(ranks.gather(int(hashlib.sha256(seen.encode()).hexdigest()[:15], 16)))) > 1:
            raise DataError(
                "the processes do not see the same settings, dataset and saved state",
                hint="keep --dataset and --out on a disk that all machines share",
            )
        try:
            yield record, progress
        except ContactLost as lost:
            lost.hint = record.continue_command if ranks.leads else lost.hint
            raise


def versions() -> dict[str, str]:
    """Versions that shape the numbers, for checkpoint metadata."""
    return {
        "hjepa": __version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "numpy": np.__version__,
    }
