"""How the cost of a simulated cell grows with devices and slots, and how fast fading is drawn.

    python benchmarks/cell.py [--method oracle] [--checkpoint NAME|PATH] [--devices 50,200,800,2000]

Linear growth means equal µs of CPU time per device and slot; CPU time says little less on a busy
machine than on a quiet one.
"""

import argparse
import dataclasses
import itertools
import math
import time

import numpy as np
from lists import whole_numbers

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.evaluation.cell_simulation import measure_growth, simulate_cell
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.fading import block_fading
from hjepa_cli.core.radio.uplink import Access
from hjepa_cli.storage import zoo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="oracle")
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument("--devices", type=whole_numbers, default="50,200,800,2000")
    parser.add_argument("--steps", type=whole_numbers, default="100,200")
    parser.add_argument("--schedulers", default="round-robin,max-aoi,innovation")
    parser.add_argument("--load", type=int, default=100, help="devices per block, about")
    options = parser.parse_args()
    started = time.perf_counter()
    for _ in itertools.islice(block_fading(0, 1000), 1000):
        pass
    print(f"a million block-fading gains: {time.perf_counter() - started:.2f} s")
    model = Model.load(zoo.resolve_model(options.checkpoint)) if options.checkpoint else None
    settings = load_settings()
    kind = plant(settings.plant)
    method = build_driver(options.method, settings, model)
    growth = measure_growth(kind, settings.protocol, 1, method, longest=100)
    for scheduler in options.schedulers.split(","):
        for steps, devices in itertools.product(options.steps, options.devices):
            protocol = dataclasses.replace(settings.protocol, warmup_steps=0, steps=steps)
            access = Access(
                scheduler=scheduler,
                blocks=max(1, devices // options.load),
                margin_db=10.0,
                k_factor_db=-math.inf,
                coherence_slots=1.0,
                round_errors=(0.0,),
                growth=growth,
                seed=0,
            )
            started, cpu = time.perf_counter(), time.process_time()
            outcome = simulate_cell(kind, protocol, 0, devices, access, method)
            took_s, cpu_s = time.perf_counter() - started, time.process_time() - cpu
            print(
                f"{scheduler:18} {devices:5} devices x {steps:5} slots: {took_s:7.2f} s, "
                f"CPU {cpu_s:7.2f} s, {1e6 * cpu_s / (devices * steps):7.2f} us per device-slot, "
                f"score {np.mean(outcome.score):.3f}"
            )


if __name__ == "__main__":
    main()
