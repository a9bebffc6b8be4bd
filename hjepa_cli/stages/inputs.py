"""Training reads frames and embeddings of a dataset here."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.datasets.dataset import (
    Dataset,
    Trajectories,
    find_newest_dataset,
    load_dataset,
)
from hjepa_cli.core.datasets.trajectories import split_sizes
from hjepa_cli.core.networks.model import encode_frames
from hjepa_cli.core.plants.conditions import vary
from hjepa_cli.core.plants.frames import frames_of
from hjepa_cli.core.plants.named import plant, plant_of
from hjepa_cli.core.plants.system import same_camera
from hjepa_cli.core.training.augmentation import Augmentation
from hjepa_cli.core.training.batches import shift_sideways
from hjepa_cli.core.training.rendered import RenderedSplit
from hjepa_cli.errors import DataError, MissingInputError
from hjepa_cli.output.screen import Screen

CHUNK = 20  # trajectories rendered or encoded at a time: progress shows, memory stays small


def embed(
    encoder: Callable[[Tensor], Tensor],
    split: RenderedSplit,
    settings: Settings,
    *,
    every: int = 1,
    look: tuple[int, int] | None = None,
    mirrored: bool = False,
    shifts_px: NDArray[np.int64] | None = None,
    seeds: list[int] | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> Tensor:
    """Return frozen embeddings [N, K, D] of k = 0, ``every``, …

    ``look`` says how many frames the encoder sees and how many steps these are apart, unless it
    says so itself.

    ``mirrored`` takes the frames' mirror images; each trajectory is then moved right by
    ``shifts_px`` [N], and augmented by ``seeds`` [N].
    """
    device = resolve_device(settings.device)
    precision, augment = settings.encoder.precision, Augmentation(settings.augment)
    frames, frame_gap = look or getattr(encoder, "look", (2, 1))
    parts = []
    for start in range(0, len(split.frames), CHUNK):
        part = split.slice(start, start + CHUNK)
        seen = part.seen(every, frames=frames, frame_gap=frame_gap, mirrored=mirrored)
        if shifts_px is not None:
            by_trajectory = seen.unflatten(0, (len(part.frames), -1))
            moved = zip(by_trajectory, shifts_px[start : start + CHUNK].tolist(), strict=True)
            seen = torch.cat([shift_sideways(frames, shift_px) for frames, shift_px in moved])
        if seeds is not None:
            seen = augment(seen, seeds[start : start + CHUNK])
        z = encode_frames(encoder, seen, device=device, precision=precision)
        parts.append(z.unflatten(0, (len(part.frames), -1)))
        advance(len(part.frames))
    return torch.cat(parts)


def open_dataset(path: Path | None, settings: Settings) -> Dataset:
    """Open the dataset at ``path``, or the newest one of the settings' plant below ``data/``.

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
    """Return a split, rendered now unless the dataset stores frames, in varied light and noise."""
    kind = plant(settings.plant)
    limit_n, frames = kind.force_limit_n, trajectories.frames
    if frames is None:
        camera = kind.camera()
        count = len(trajectories)
        parts = []
        with screen.progress("render", count, "trajectories") as bar:
            for start in range(0, count, CHUNK):
                chunk = trajectories.states[start : start + CHUNK]
                parts.append(frames_of(camera, chunk))
                bar.advance(len(chunk))
        frames = np.concatenate(parts)
    return RenderedSplit(
        frames=torch.from_numpy(vary(frames, settings.encoder, settings.seed, split)),
        states=torch.from_numpy(trajectories.states[:, 1:].copy()),
        actions=torch.from_numpy(trajectories.applied_n / limit_n),
        labels=torch.from_numpy(trajectories.teacher_n / limit_n),
    )


def count_frames(data: Dataset | None, settings: Settings, *splits: str) -> int:
    """Return the frames of splits; of no dataset, those that the settings would collect."""
    sizes = split_sizes(settings.collect)
    if data:
        sizes = {name: (of["trajectories"], of["steps"]) for name, of in data.splits.items()}
    return sum(count * (steps + 1) for count, steps in (sizes[name] for name in splits))
