"""How well drift-plus-penalty serves one load, by the weight V of transmit power in its score.

    python benchmarks/power_weight.py [--method oracle] [--checkpoint NAME|PATH] [--weights 0,1e3]

V = 0 goes by age and queue alone, a large V waits for good channels. Scores are means over seeds
with Student's 95 % interval.
"""

import argparse
import math

import numpy as np
from scipy import stats

from hjepa_cli.core.cell_loop import measure_growth, simulate_cell
from hjepa_cli.core.loop import Draws, every_step, simulate
from hjepa_cli.core.methods import build_method
from hjepa_cli.core.model import Model
from hjepa_cli.core.plant import plant
from hjepa_cli.core.schedulers import drift_plus_penalty
from hjepa_cli.core.uplink import Access
from hjepa_cli.settings import load_settings
from hjepa_cli.stages.scheduled_cell import CALIBRATION_SEED
from hjepa_cli.storage import zoo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="oracle")
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument("--weights", default="0,1e3,1e4,3e4,1e5,3e5,1e6", help="V, a list")
    parser.add_argument("--load", type=int, default=180, help="devices on one block")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    settings = load_settings()
    protocol, kind, load = settings.protocol, plant(settings.plant), options.load
    model = Model.load(zoo.resolve_model(options.checkpoint)) if options.checkpoint else None
    method, teacher = (
        build_method(options.method, settings, model),
        build_method("optimal", settings, None),
    )
    references, growths = [], []
    for seed in range(options.seeds):
        draws, perfect = Draws.make(protocol, load, seed), every_step(protocol.steps, load)[None]
        found = simulate(kind, draws, perfect, teacher.controller(load), teacher.sensor)
        references.append(found.score.mean())
        growths.append(measure_growth(kind, protocol, seed + CALIBRATION_SEED, method))
    print(f"{options.method}, {load} devices on one block, {options.seeds} seeds")
    for weight in map(float, options.weights.split(",")):
        drift_plus_penalty.POWER_WEIGHT = weight
        scores, packets = [], []
        for seed, (reference, growth) in enumerate(zip(references, growths, strict=True)):
            access = Access("drift-plus-penalty", 1, 10.0, -math.inf, 1.0, (0.0,), growth, seed)
            found = simulate_cell(kind, protocol, seed, load, access, method)
            scores.append(found.score.mean() / reference)
            packets.append(found.packets.sum() / (protocol.steps - 1))
        half = stats.t.ppf(0.975, options.seeds - 1) * stats.sem(scores)
        print(
            f"V = {weight:8g}: score {np.mean(scores):.3f} +- {half:.3f}, packets per slot "
            f"{np.mean(packets):.3f}"
        )


if __name__ == "__main__":
    main()
