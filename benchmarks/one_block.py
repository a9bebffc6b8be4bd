"""How well schedulers serve a given number of devices on one resource block.

    python benchmarks/one_block.py [--method oracle] [--checkpoint NAME|PATH] [--loads 200]
        [--schedulers innovation,max-aoi] [--slots 1000] [--weights 1000]

``scale --law scheduled`` searches the load at which the score is acceptable; this shows the score
at loads of one's choice, over as many slots as one likes. ``--weights`` are V of
drift-plus-penalty. Mean over seeds and Student's 95 % interval; "given up" is the share of loops
whose own score is below 0.3 of what the teacher has on average.
"""

import argparse
import dataclasses
import math

import numpy as np
from lists import numbers, whole_numbers
from scipy import stats

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.control.drivers import build_driver
from hjepa_cli.core.control.loop import Draws, every_step, simulate
from hjepa_cli.core.evaluation.cell_simulation import measure_growth, simulate_cell
from hjepa_cli.core.evaluation.load_simulator import CALIBRATION_SEED
from hjepa_cli.core.networks.model import Model
from hjepa_cli.core.plants.named import plant
from hjepa_cli.core.radio.schedulers import drift_plus_penalty
from hjepa_cli.core.radio.uplink import Access
from hjepa_cli.plugins import SCHEDULERS
from hjepa_cli.storage import zoo

GIVEN_UP = 0.3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--method", default="oracle")
    parser.add_argument("--checkpoint", help="zoo name, run directory or file")
    parser.add_argument("--schedulers", default=",".join(SCHEDULERS), help="a list")
    parser.add_argument(
        "--weights", type=numbers, help="V of drift-plus-penalty, a list (default: its own)"
    )
    parser.add_argument(
        "--loads", type=whole_numbers, default="200", help="devices on the block, a list"
    )
    parser.add_argument("--slots", type=int, help="default: the protocol's")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    settings = load_settings()
    kind, protocol = plant(settings.plant), settings.protocol
    if options.slots:
        protocol = dataclasses.replace(protocol, warmup_steps=0, steps=options.slots)
    model = Model.load(zoo.resolve_model(options.checkpoint)) if options.checkpoint else None
    method = build_driver(options.method, settings, model)
    teacher = build_driver("optimal", settings, None)
    growths = [
        measure_growth(kind, settings.protocol, seed + CALIBRATION_SEED, method)
        for seed in range(options.seeds)
    ]
    cases: list[tuple[str, float]] = []
    for scheduler in options.schedulers.split(","):
        own = [drift_plus_penalty.POWER_WEIGHT]
        varied = options.weights and scheduler == "drift-plus-penalty"
        cases += [(scheduler, weight) for weight in (options.weights if varied else own)]
    print(f"{options.method}, one block, {protocol.total_steps} slots, {options.seeds} seeds")
    for load in options.loads:
        references = []
        for seed in range(options.seeds):
            draws, always = (
                Draws.make(protocol, load, seed),
                every_step(protocol.total_steps, load)[None],
            )
            found = simulate(kind, draws, always, teacher.controller(load), teacher.sensor)
            references.append(found.score.mean())
        for scheduler, weight in cases:
            drift_plus_penalty.POWER_WEIGHT = weight
            scores, packets, given_up = [], [], []
            for seed in range(options.seeds):
                access = Access(
                    scheduler=scheduler,
                    blocks=1,
                    margin_db=settings.radio.power_margin_db,
                    k_factor_db=-math.inf,
                    coherence_slots=settings.radio.coherence_slots,
                    round_errors=(settings.radio.block_error,),
                    growth=growths[seed],
                    seed=seed,
                )
                outcome = simulate_cell(kind, protocol, seed, load, access, method)
                own_score = outcome.score / references[seed]
                scores.append(own_score.mean())
                given_up.append(np.mean(own_score < GIVEN_UP))
                packets.append(outcome.packets.sum() / outcome.counted_slots)
            name = f"{scheduler}, V = {weight:g}" if "drift" in scheduler else scheduler
            print(
                f"{load} devices, {name}: score {told(scores)}, given up {told(given_up)}, "
                f"packets per slot {np.mean(packets):.3f}",
                flush=True,
            )


def told(values: list[float]) -> str:
    """A mean, and its interval where there are several values."""
    text = f"{np.mean(values):.3f}"
    if len(values) > 1:
        text += f" ± {stats.t.ppf(0.975, len(values) - 1) * stats.sem(values):.3f}"
    return text


if __name__ == "__main__":
    main()
