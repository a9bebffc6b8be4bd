"""The delivery tolerance p* when losses come in bursts: independent losses are optimistic.

    python benchmarks/burst_losses.py [--method oracle] [--checkpoint NAME|PATH] [--coherence 1,5]

A channel that changes every T slots on average, at the same share p of good slots, has runs of
losses of T/p slots (Gilbert-Elliott); T = 1 is independent. p* is where the normalised score falls
to the acceptable one.
"""

import argparse
import math

import numpy as np
from lists import numbers

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.loop import Draws, every_step, simulate
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.fading import gilbert_elliott
from hjepa_cli.core.statistics import bootstrap_weights, first_crossing, interval, ratio
from hjepa_cli.storage import zoo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="oracle")
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument(
        "--coherence", type=numbers, default="1,2,5,10,20", help="mean slots T, a list"
    )
    parser.add_argument(
        "--gaps", type=numbers, default="1,2,5,10,20,40,80,160", help="1/p of the curve"
    )
    parser.add_argument("--devices", type=int, default=128)
    options = parser.parse_args()
    settings = load_settings()
    protocol, kind, seed = settings.protocol, plant(settings.plant), settings.seed
    model = Model.load(zoo.resolve_model(options.checkpoint)) if options.checkpoint else None
    method = build_driver(options.method, settings, model)
    draws = Draws.make(protocol, options.devices, seed)

    def scores(schedules: np.ndarray, which: object) -> np.ndarray:
        controller = which.controller(len(schedules) * options.devices)
        return simulate(kind, draws, schedules, controller, which.sensor).score

    everything = every_step(protocol.total_steps, options.devices)[None]
    reference = scores(everything, build_driver("optimal", settings, None))[0]
    weights = bootstrap_weights(options.devices, protocol.bootstrap, seed)
    gaps = np.array(options.gaps)
    print(f"{options.method}, {options.devices} devices, {protocol.total_steps} steps, seed {seed}")
    for coherence in options.coherence:
        schedules = np.stack([gilbert_elliott(draws.delivery, 1 / g, coherence * g) for g in gaps])
        schedules[:, 0] = True
        found = scores(schedules, method)
        level = protocol.acceptable_score
        crossing = first_crossing(gaps, ratio(found, reference), level, log=True)
        low, high = interval(
            first_crossing(gaps, ratio(found, reference, weights), level, log=True)
        )
        shown = [math.nan if abs(end) == math.inf else 1 / end for end in (crossing, high, low)]
        print(f"T = {coherence:3g}: p* {shown[0]:.4f} (95 % CI {shown[1]:.4f} to {shown[2]:.4f})")


if __name__ == "__main__":
    main()
