"""``hjepa collect``: simulate cart-poles under an exploring teacher and keep them as a dataset.

Settings → dataset directory. Frames are rendered here in any case, to show that they can be and
how fast; they are stored only with ``--frames stored``, because states are 6,000 times smaller and
render to the same pixels every time.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.camera import HEIGHT_PX, WIDTH_PX, Camera
from hjepa_cli.core.payload import raw_frame_bits
from hjepa_cli.core.plant import plant
from hjepa_cli.core.trajectories import generate, split_sizes
from hjepa_cli.errors import UsageError
from hjepa_cli.screen import Screen
from hjepa_cli.settings import Settings
from hjepa_cli.storage.datasets import (
    MANIFEST,
    Dataset,
    Trajectories,
    load_dataset,
    open_directory,
    write_dataset,
)

FRAMES_PER_SAMPLE = 2  # κ: current and previous


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Collect a dataset; returns the document of spec §8 ``collect``.

    Raises:
        UsageError: a count below one, or ``out`` holds something else.
        DataError: ``out`` holds a dataset of other settings.
    """
    check(settings)
    started = time.perf_counter()
    options, camera = settings.collect, Camera(plant(settings.plant))
    with open_directory(out, settings.plant) as directory:
        if (directory / MANIFEST).exists():
            screen.say(f"{directory} holds a finished dataset; this is what it holds")
            return describe(load_dataset(directory, settings.plant), started, frames_per_s=None)
        screen.say(f"collecting {settings.plant} trajectories into {directory}")
        splits = {name: generate(settings, name) for name in split_sizes(settings)}
        frames = sum(split.states.shape[0] * split.states.shape[1] for split in splits.values())
        rendering = time.perf_counter()
        with screen.progress("render", frames, "frames") as bar:
            for name, split in splits.items():
                images = render(camera, split, bar.advance, keep=options.frames == "stored")
                splits[name] = dataclasses.replace(split, frames=images)
        frames_per_s = frames / (time.perf_counter() - rendering)
        defining = dataclasses.asdict(options) | {"plant": settings.plant}
        data = write_dataset(
            directory,
            settings={"seed": settings.seed, "collect": defining},
            splits=splits,
            plant_name=settings.plant,
            camera_manifest=camera.manifest(),
        )
    bits = raw_frame_bits(FRAMES_PER_SAMPLE, HEIGHT_PX, WIDTH_PX)
    uplink_gbit = bits * options.trajectories * options.steps / 1e9
    screen.say(
        f"the training phase would send {uplink_gbit:.3g} Gbit of raw frames uplink "
        f"({bits} bits a step); next: hjepa train-encoder"
    )
    return describe(data, started, frames_per_s)


def check(settings: Settings) -> None:
    """Refuse sizes that make no dataset."""
    options = settings.collect
    for flag, value, least in (
        ("--trajectories", options.trajectories, 1),
        ("--test-trajectories", options.test_trajectories, 1),
        ("collect.clean_trajectories", options.clean_trajectories, 1),
        ("--steps", options.steps, 2),
        ("collect.clean_steps", options.clean_steps, 2),
        ("collect.exploration_hold_steps", options.exploration_hold_steps, 1),
    ):
        if value < least:
            raise UsageError(f"{flag} {value}: must be at least {least}")


def render(camera: Camera, split: Trajectories, advance: Any, *, keep: bool) -> np.ndarray | None:
    """Frames [N, T + 1, H, W, 3] of a split if they are kept, else ``None``."""
    kept = []
    for states in split.states:
        images = camera.render(states)
        advance(len(images))
        if keep:
            kept.append(images)
    return np.stack(kept) if keep else None


def describe(data: Dataset, started: float, frames_per_s: float | None) -> dict[str, Any]:
    """The document of spec §8."""
    train, test = data.split("train"), data.split("test")
    return {
        "dataset": str(data.path),
        "trajectories": len(train),
        "test_trajectories": len(test),
        "steps": train.steps,
        "seconds": round(time.perf_counter() - started, 2),
        "frames_per_s": frames_per_s and round(frames_per_s),
    }
