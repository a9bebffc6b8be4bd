"""Speed of the closed loop: plant, camera, encoder, planners, and how much faster than real time.

    python benchmarks/closed_loop.py [--checkpoint NAME|PATH] [--devices 64] [--steps 200]

Without a checkpoint the newest run or the zoo's model is taken, and failing both an untrained
model of the default architecture, which is just as fast. A real-time factor of 10 means that all
devices together are simulated, seen, encoded and controlled ten times faster than they move.
"""

import argparse
import dataclasses
import time
from collections.abc import Callable

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from hjepa_cli.config.checks import without_model
from hjepa_cli.config.schema import Settings
from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import methods_of, planner_of
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Simulator, start_points
from hjepa_cli.core.networks.model import Model, build_modules
from hjepa_cli.core.plants.cartpole.simulation import CartPoles
from hjepa_cli.core.plants.named import Camera, plant
from hjepa_cli.plugins import METHODS
from hjepa_cli.stages.train_encoder import describe_architecture
from hjepa_cli.storage import runs, zoo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument("--devices", type=int, default=64)
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    settings = load_settings()
    model = open_model(options.checkpoint, settings)
    print(f"{torch.get_num_threads()} threads, model on {model.device}, plant {model.plant_name}")
    pieces(model, options.devices)
    loops(model, settings, options.devices, options.steps)


def pieces(model: Model, devices: int) -> None:
    """Each part of a control step on its own."""
    kind = plant(model.plant_name)
    states = np.random.default_rng(0).normal(size=(2 * devices, 4)) * 0.05
    poles = CartPoles(kind, devices)
    print(f"plant     {devices / seconds(lambda: poles.step(np.zeros(devices))):12,.0f} steps/s")
    camera = Camera(kind)
    print(f"camera    {2 * devices / seconds(lambda: camera.render(states)):12,.0f} frames/s")
    for count in (1, devices, 256):
        shape = (count, model.frames, 64, 128, 3)
        frames = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
        each_ms = 1e3 * seconds(lambda frames=frames: model.encode(frames)) / count
        print(f"encoder   {each_ms:12.3f} ms per embedding in batches of {count}")
    macs = multiply_accumulates(lambda: model.encode(frames[:1]))
    print(f"encoder   {macs / 1e6:12.1f} million MACs per embedding")
    z = torch.randn(devices, model.architecture["embedding"], device=model.device)
    for name in (name for name in methods_of(model) if METHODS[name].planner):
        planner = planner_of(model, name)
        with torch.inference_mode():
            took_ms = 1e3 * seconds(lambda planner=planner: planner.plan(z))
            macs = multiply_accumulates(lambda planner=planner: planner.plan(z[:1]))
        print(
            f"{name:9} {took_ms / devices / planner.stride:12.4f} ms, "
            f"{macs / planner.stride / 1e6:.2f} million MACs per device and control step"
        )


def loops(model: Model, settings: Settings, devices: int, steps: int) -> None:
    """The whole loop at a few gaps, in this one process (``eval`` uses one per core)."""
    kind = plant(model.plant_name)
    protocol = dataclasses.replace(
        settings.protocol,
        warmup_steps=0,
        steps=steps,
        curve_devices=devices,
        bracket_devices=devices,
    )
    simulator = Simulator(dataclasses.replace(settings, protocol=protocol), model)
    print(
        f"real-time factor of {devices} devices together, {steps} steps of {kind.step_s * 1e3:g} ms"
    )
    trained = (name for name in methods_of(model) if not METHODS[name].fitted)
    others = (name for name in without_model() if name not in ("optimal", "ceiling"))
    for name in (*trained, *others):
        factors = []
        for gap in (1.0, 20.0, 80.0):
            started = time.perf_counter()
            start_points(simulator, name, [Point("gap", gap)], devices, lambda steps: None)()
            took_s = time.perf_counter() - started
            factors.append(f"{devices * steps * kind.step_s / took_s:9.1f} x at D = {gap:g}")
        print(f"{name:9} " + ", ".join(factors))


def open_model(name: str | None, settings: Settings) -> Model:
    """The model asked for, the newest run's, the zoo's, or an untrained one."""
    found = name or runs.newest_run("train-hierarchy") or zoo.find_model(settings.plant)
    if found is None:
        return untrained(settings)
    return Model.load(zoo.resolve_model(found), settings.device)


def untrained(settings: Settings) -> Model:
    """Random networks of the default architecture."""
    strides = settings.hierarchy
    architecture = describe_architecture(settings) | {
        "kind": "hierarchy",
        "h": strides.h,
        "m": strides.m,
        "l": strides.l,
        "actor_hidden": settings.actor.hidden,
        "actor_dropout": settings.actor.dropout,
    }
    metadata = {
        "architecture": architecture,
        "plant": settings.plant,
        "settings": settings.as_dict(),
    }
    print("untrained model")
    return Model(build_modules(architecture), metadata, "untrained", settings.device)


def seconds(work: Callable[[], object], at_least_s: float = 1.0) -> float:
    """Best time of one call, over calls that together take ``at_least_s``."""
    work()
    best, spent = np.inf, 0.0
    while spent < at_least_s:
        started = time.perf_counter()
        work()
        took = time.perf_counter() - started
        best, spent = min(best, took), spent + took
    return float(best)


def multiply_accumulates(work: Callable[[], object]) -> float:
    """MACs of one call: PyTorch counts two operations for each."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() / 2


if __name__ == "__main__":
    main()
