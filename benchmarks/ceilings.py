"""What is possible at all: scores of the controllers that see the true state, over several seeds.

    python benchmarks/ceilings.py --seeds 1 2 3 4 5 6 [--preset gym]

One table, for loops scored from the start on as in the paper: mean over seeds ± standard deviation
of one seed's value, 256 devices each. A value of one seed that lies further off than two deviations
is no sampling error.
"""

import argparse

import numpy as np

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.evaluation.bench import Bench
from hjepa_cli.core.evaluation.protocol import Point
from hjepa_cli.core.evaluation.simulator import Simulator

METHODS = ("oracle", "hold-true", "zero-true")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5, 6])
    parser.add_argument("--preset", choices=("default", "gym"), default="default")
    parser.add_argument("--devices", type=int, default=256)
    options = parser.parse_args()
    gaps = [gap for gap in load_settings(options.preset).protocol.gaps if gap > 1]
    points = [Point("gap", float(gap)) for gap in gaps]
    teacher, scores = [], {method: [] for method in METHODS}
    for seed in options.seeds:
        flags = {"seed": seed, "protocol": "paper", "protocol.bracket_devices": options.devices}
        settings = load_settings(options.preset, flags=flags)
        bench = Bench(settings.protocol, seed, Simulator(settings, None))
        teacher.append(bench.teacher_score)
        for method in METHODS:
            outcome = bench.measure(method, points, options.devices)
            scores[method].append(bench.reference.relative_score(outcome))
    print(f"{len(options.seeds)} seeds of {options.devices} devices")
    print(f"{'teacher':10}{spread(np.array(teacher)[:, None])[0]}")
    print(f"{'D':10}" + "".join(f"{gap:<16d}" for gap in gaps))
    for method, values in scores.items():
        print(f"{method:10}" + "".join(f"{cell:16}" for cell in spread(np.array(values))))


def spread(values: np.ndarray) -> list[str]:
    """Mean ± standard deviation of each column of values [seeds, points]."""
    deviations = values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1])
    return [f"{m:.3f} ± {s:.3f}" for m, s in zip(values.mean(axis=0), deviations, strict=True)]


if __name__ == "__main__":
    main()
