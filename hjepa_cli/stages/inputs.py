"""Training reads frames and embeddings of a dataset here."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hjepa_cli.compute.device import resolve_device
from hjepa_cli.config.schema import (
    RECORDED,
    CameraSettings,
    Look,
    RecordedSettings,
    Settings,
)
from hjepa_cli.core.datasets.dataset import (
    Dataset,
    Trajectories,
    find_newest_dataset,
    load_dataset,
)
from hjepa_cli.core.datasets.trajectories import split_sizes
from hjepa_cli.core.networks.model import encode_frames
from hjepa_cli.core.plants.conditions import vary
from hjepa_cli.core.plants.control_law import control_of
from hjepa_cli.core.plants.frames import frames_of, same_camera
from hjepa_cli.core.plants.named import camera_in, camera_of, plant_in, plant_of, sensor_in
from hjepa_cli.core.training.batches import shift_sideways
from hjepa_cli.core.training.rendered import RenderedSplit
from hjepa_cli.errors import DataError, MissingInputError, UsageError, shell
from hjepa_cli.output.screen import Screen

CHUNK = 20  # trajectories rendered or encoded at a time: progress shows, memory stays small


def embed(
    encoder: Callable[[Tensor], Tensor],
    split: RenderedSplit,
    settings: Settings,
    *,
    every: int = 1,
    look: Look | None = None,
    mirrored: bool = False,
    shifts_px: NDArray[np.int64] | None = None,
    advance: Callable[[int], None] = lambda count: None,
) -> Tensor:
    """Return frozen embeddings [N, K, D] of k = 0, ``every``, …

    ``look`` says how many steps back the frames lie, unless the encoder says so itself.

    ``mirrored`` takes the frames' mirror images; each trajectory is then moved right by
    ``shifts_px`` [N].
    """
    device = resolve_device(settings.device)
    precision = settings.encoder.precision
    look = look or getattr(encoder, "look", (1, 0))
    parts = []
    for start in range(0, len(split.frames), CHUNK):
        part = split[start : start + CHUNK]
        seen = part.seen(every, look, mirrored=mirrored)
        if shifts_px is not None:
            by_trajectory = seen.unflatten(0, (len(part.frames), -1))
            moved = zip(by_trajectory, shifts_px[start : start + CHUNK].tolist(), strict=True)
            seen = torch.cat([shift_sideways(frames, shift_px) for frames, shift_px in moved])
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
        made_by = f"hjepa collect --plant {settings.plant}"
        raise MissingInputError(
            f"no dataset of plant {settings.plant} below data/",
            hint=f"{'hjepa data import SOURCE' if settings.plant == RECORDED else made_by}, "
            "or pass --dataset DIR",
        )
    data = load_dataset(path, settings.plant)
    taken_by = camera_of(kind, camera_in(data.settings), sensor_in(data.settings))
    if not same_camera(data.camera, taken_by):
        raise DataError(
            f"dataset {path} was collected with another camera than plant {kind.name} has now",
            hint=f"hjepa collect --plant {kind.name}",
        )
    return data


def brought_along(settings: Settings, record: Mapping[str, Any], where: object) -> Settings:
    """Return settings with what a dataset or a checkpoint, ``where``, brings along in its own.

    That is the law, the size of pictures, the camera's sensor and, of a recorded plant, all that is
    known of it. Unless that says what a mirror does, networks do not commute with one; and nobody
    knows what its pictures show when they are moved.

    Raises:
        DataError: it holds no valid law.
    """
    settings = dataclasses.replace(
        settings,
        control=control_of(record, where),
        camera=camera_in(record),
        sensor=sensor_in(record),
    )
    if settings.plant != RECORDED:
        return settings
    known = msgspec.convert(record["recorded"], RecordedSettings)
    mirror = settings.encoder.mirror if known.mirror else "none"
    encoder = dataclasses.replace(settings.encoder, mirror=mirror, shift_px=0)
    return dataclasses.replace(settings, recorded=known, encoder=encoder)


def refuse_recorded(settings: Settings, why: str) -> None:
    """Raise UsageError for a recorded plant in a stage that needs equations; ``why`` says so."""
    if settings.plant == RECORDED:
        raise UsageError(
            f"{why}; a recorded plant has no equations",
            hint="hjepa eval --dataset DIR, which needs none",
        )


def check_same_plant(
    metadata: Mapping[str, Any], settings: Settings, what: str, dataset: Path | None = None
) -> None:
    """Raise DataError where a checkpoint is of another plant, or of other pictures, than settings.

    ``what`` names the checkpoint; the settings are those that ``dataset``, where known, brings.
    """
    where = f"dataset {dataset}" if dataset else "the dataset"
    trained = f"train-{'encoder' if what.startswith('encoder') else 'hierarchy'}"
    again = shell(["hjepa", trained, "--dataset", dataset or "DIR"])
    hint = f"{again}, or pass another --dataset DIR"
    theirs = metadata["plant"]
    if theirs != settings.plant:
        raise DataError(
            f"{what} was trained on plant {theirs}, {where} is of plant {settings.plant}",
            hint=f"hjepa {trained} --plant {settings.plant}",
        )
    size = camera_in(metadata["settings"])
    if size != settings.camera:
        raise DataError(
            f"{what} was trained on pictures of {shown(size)}, "
            f"{where} has {shown(settings.camera)}",
            hint=hint,
        )
    if sensor_in(metadata["settings"]) != settings.sensor:
        raise DataError(
            f"{what} was trained on pictures of another sensor than {where} has",
            hint=hint,
        )
    if theirs == RECORDED and plant_in(theirs, metadata["settings"]) != plant_of(settings):
        raise DataError(
            f"{what} was trained on recordings of another plant than {where} has",
            hint=hint,
        )


def pictures(settings: Settings) -> dict[str, Any]:
    """Return what an architecture says of the size of pictures: nothing of the usual one."""
    return {key: value for key, value in settings.as_dict().items() if key == "camera"}


def shown(size: CameraSettings) -> str:
    """Return ``"64 × 128 px"``, and whether they are grey."""
    return f"{size.height_px} × {size.width_px} px" + ", grey" * size.grey


def render(
    trajectories: Trajectories, settings: Settings, screen: Screen, split: str = "train"
) -> RenderedSplit:
    """Return a split, rendered now unless the dataset stores frames, in varied light and noise."""
    kind = plant_of(settings)
    limit_n, frames = kind.force_limit_n, trajectories.frames
    if frames is None:
        camera = camera_of(kind, settings.camera, settings.sensor)
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


def sizes_of(data: Dataset | None, settings: Settings) -> dict[str, tuple[int, int]]:
    """Return trajectories and steps of splits; of no dataset, what the settings would collect."""
    if not data:
        return split_sizes(settings)
    return {name: (of["trajectories"], of["steps"]) for name, of in data.splits.items()}


def count_frames(data: Dataset | None, settings: Settings, *splits: str) -> int:
    """Return the frames of splits; of no dataset, those that the settings would collect."""
    sizes = sizes_of(data, settings)
    return sum(count * (steps + 1) for count, steps in (sizes[name] for name in splits))
