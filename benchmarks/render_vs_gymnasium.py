"""Frames per second of the camera and of Gymnasium's CartPole, side by side in one run.

    pip install "gymnasium[classic-control]"
    python benchmarks/render_vs_gymnasium.py [--rounds 7]

- ``camera``: 64 × 128 px in batches, as training and the closed loop render.
- ``camera, one by one``: the same frames in batches of one.
- ``gymnasium``: CartPole-v1 in mode ``rgb_array``, 400 × 600 px, the size it has; one by one.
- ``gymnasium, small``: the same drawn at 64 × 128 px, so that pixels do not explain the ratio.

Gymnasium draws anti-aliased polygons with integer corners (pygame); the camera computes areas. All
take turns in every round, so that a drifting machine moves all alike; medians are reported.
Exits with 1 if the camera is not 10 times as fast as Gymnasium.
"""

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np

from hjepa_cli.compute.seeding import generator
from hjepa_cli.core.plants.frames import HEIGHT_PX, WIDTH_PX
from hjepa_cli.core.plants.named import Camera

LEAST_RATIO = 10.0
RANGES = np.array([1.0, 0.5, 0.2, 0.5])


def gymnasium_renderer(states: np.ndarray, small: bool) -> Callable[[], None]:
    import gymnasium

    environment = gymnasium.make("CartPole-v1", render_mode="rgb_array").unwrapped
    environment.reset(seed=0)
    if small:
        environment.screen_width, environment.screen_height = WIDTH_PX, HEIGHT_PX

    def render() -> None:
        for state in states:
            environment.state = state
            environment.render()

    return render


def frames_per_s(render: Callable[[], object], frames: int) -> float:
    started = time.perf_counter()
    render()
    return frames / (time.perf_counter() - started)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=7)
    rounds = parser.parse_args().rounds
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")

    camera = Camera("gym")
    states = generator(0).uniform(-1, 1, (4096, 4)) * RANGES
    few = states[:256]
    contenders = {
        "camera, batches of 4096": (lambda: camera.render(states), 4096),
        "camera, batches of 64": (
            lambda: [camera.render(states[i : i + 64]) for i in range(0, 4096, 64)],
            4096,
        ),
        "camera, one by one": (lambda: [camera.render(state[None]) for state in few], 256),
        "gymnasium": (gymnasium_renderer(few, small=False), 256),
        "gymnasium, small": (gymnasium_renderer(few, small=True), 256),
    }
    for render, _ in contenders.values():
        render()
    measured = {name: [] for name in contenders}
    for _ in range(rounds):
        for name, (render, frames) in contenders.items():
            measured[name].append(frames_per_s(render, frames))
    medians = {name: statistics.median(values) for name, values in measured.items()}
    reference = medians["gymnasium"]
    print(f"median of {rounds} rounds, {os.cpu_count()} cores")
    for name, median in medians.items():
        print(f"{name:26} {median:10,.0f} frames/s   {median / reference:6.1f} × gymnasium")
    return 0 if medians["camera, batches of 4096"] >= LEAST_RATIO * reference else 1


if __name__ == "__main__":
    sys.exit(main())
