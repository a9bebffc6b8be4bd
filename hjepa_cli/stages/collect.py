"""``hjepa collect``: simulate cart-poles under an exploring teacher and keep them as a dataset.

Settings → dataset directory. Frames are stored only with ``--frames stored``, because states are
1,500 times smaller and render to the same pixels every time; otherwise a sample is rendered, to
report how fast that goes on this machine.
"""

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np

from hjepa_cli.core.camera import HEIGHT_PX, WIDTH_PX, Camera
from hjepa_cli.core.payload import raw_frame_bits
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
TOGETHER = 20  # trajectories rendered at a time; the sample is one such batch


def run(settings: Settings, screen: Screen, *, out: Path | None = None) -> dict[str, Any]:
    """Collect a dataset.

    Args:
        settings: ``settings.collect`` of ``settings.plant``, drawn from ``settings.seed``.
        screen: where progress goes.
        out: the dataset's directory; ``None`` is the next free ``data/<plant>-<nnnn>``. One that
            holds a finished dataset is left as it is and described again.

    Returns:
        The document of ``--json``; ``frames_per_s`` is null if nothing was rendered.

    Raises:
        UsageError: a count that is too small, or ``out`` holds something else.
        DataError: ``out`` holds a dataset of another plant, or a damaged one.
        StorageError, LockedError: ``out`` cannot be written, or is being written.
    """
    check(settings)
    started = time.perf_counter()
    camera = Camera(settings.plant)
    definition = {
        "seed": settings.seed,
        "collect": dataclasses.asdict(settings.collect) | {"plant": settings.plant},
    }
    with open_directory(out, settings.plant) as directory:
        if (directory / MANIFEST).exists():
            data = load_dataset(directory, settings.plant)
            changed = "" if data.settings == definition else ", made with other settings"
            screen.say(f"{directory} holds a finished dataset{changed}; it is left as it is")
            return describe(data, time.perf_counter() - started, frames_per_s=None)

        screen.say(f"collecting {settings.plant} trajectories into {directory}")
        splits = {name: generate(settings, name) for name in split_sizes(settings)}
        splits, frames_per_s = film(camera, splits, settings.collect.frames == "stored", screen)
        data = write_dataset(
            directory,
            settings=definition,
            splits=splits,
            plant_name=settings.plant,
            camera_manifest=camera.manifest(),
        )
    result = describe(data, time.perf_counter() - started, frames_per_s)
    bits = raw_frame_bits(FRAMES_PER_SAMPLE, HEIGHT_PX, WIDTH_PX)
    screen.say(
        f"{len(splits['train'])} training trajectories in {result['seconds']:.1f} s; as raw frames "
        f"the training phase takes {result['training_uplink_bits'] / 1e9:.3g} Gbit of uplink "
        f"({bits} bits a step)"
    )
    return result


def check(settings: Settings) -> None:
    """Refuse sizes that make no dataset.

    Raises:
        UsageError: naming the flag or setting.
    """
    options = settings.collect
    for name, value, least in (
        ("--trajectories", options.trajectories, 1),
        ("--test-trajectories", options.test_trajectories, 1),
        ("collect.clean_trajectories", options.clean_trajectories, 1),
        ("--steps", options.steps, 1),
        ("collect.clean_steps", options.clean_steps, 1),
        ("collect.exploration_hold_steps", options.exploration_hold_steps, 1),
        ("collect.exploration_n", options.exploration_n, 0),
        ("collect.x_m", options.x_m, 0),
        ("collect.x_dot_m_s", options.x_dot_m_s, 0),
        ("collect.theta_rad", options.theta_rad, 0),
        ("collect.theta_dot_rad_s", options.theta_dot_rad_s, 0),
    ):
        if value < least:
            raise UsageError(f"{name} = {value}; expected at least {least}")


def film(
    camera: Camera, splits: dict[str, Trajectories], store: bool, screen: Screen
) -> tuple[dict[str, Trajectories], float]:
    """Render every split to be kept, else a sample to be dropped; also returns frames/s."""
    filmed = splits if store else {"train": splits["train"][:TOGETHER]}
    total = sum(split.states[..., 0].size for split in filmed.values())
    kept = {}
    started = time.perf_counter()
    with screen.progress("render" if store else "render a sample", total, "frames") as bar:
        for name, split in filmed.items():
            shape = (*split.states.shape[:2], HEIGHT_PX, WIDTH_PX, 3)
            frames = np.empty(shape, np.uint8) if store else None
            for start in range(0, len(split), TOGETHER):
                states = split.states[start : start + TOGETHER]
                images = camera.render(states.reshape(-1, 4))
                if frames is not None:
                    frames[start : start + TOGETHER] = images.reshape(-1, *shape[1:])
                bar.advance(len(images))
            kept[name] = dataclasses.replace(split, frames=frames)
    return (kept if store else splits), total / (time.perf_counter() - started)


def describe(data: Dataset, seconds: float, frames_per_s: float | None) -> dict[str, Any]:
    """The document of ``--json``; ``training_uplink_bits``: what sending its frames would take."""
    count, steps = (data.splits["train"][key] for key in ("trajectories", "steps"))
    return {
        "dataset": str(data.path),
        "trajectories": count,
        "test_trajectories": data.splits["test"]["trajectories"],
        "clean_trajectories": data.splits["clean"]["trajectories"],
        "steps": steps,
        "seconds": round(seconds, 3),
        "frames_per_s": None if frames_per_s is None else round(frames_per_s, 1),
        "training_uplink_bits": count
        * steps
        * raw_frame_bits(FRAMES_PER_SAMPLE, HEIGHT_PX, WIDTH_PX),
    }
