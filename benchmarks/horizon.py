"""Whether the scored time is long enough: device counts when it is doubled.

    python benchmarks/horizon.py [--methods oracle,hjepa,hold] [--preset gym]

``hjepa scale`` counts devices at 20 dB after loops of the default length and after loops that are
scored twice as long, on the same starts. The check fails (exit code 1) if doubling moves a count
out of its own 95 % interval: then what is measured is still on its way somewhere.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hjepa_cli.config.settings import load_settings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", default="oracle,hjepa,chunk,hold-decay-linear,hold")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    steps = load_settings(options.preset).protocol.steps
    once, twice = (counted(options, steps * factor) for factor in (1, 2))
    print(f"{'method':18}{f'devices, {steps} steps':>28}{f'{2 * steps} steps':>28}  within")
    outside = 0
    for method, row in once.items():
        low, high = row["devices_ci95"]
        within = low <= twice[method]["devices"] <= high
        outside += not within
        print(f"{method:18}{told(row):>28}{told(twice[method]):>28}  {'yes' if within else 'NO'}")
    sys.exit(1 if outside else 0)


def counted(options: argparse.Namespace, steps: int) -> dict[str, dict[str, Any]]:
    """The rows of ``scale`` by method, measured anew in an empty directory."""
    with tempfile.TemporaryDirectory() as directory:
        config = Path(directory, "steps.toml")
        config.write_text(f"[protocol]\nsteps = {steps}\n")
        line = [sys.executable, "-m", "hjepa_cli", "scale", "--snr", "20", "--json", "--quiet"]
        line += ["--methods", options.methods, "--preset", options.preset, "--remeasure"]
        line += ["--seed", str(options.seed), "--config", str(config)]
        done = subprocess.run(line, cwd=directory, check=True, stdout=subprocess.PIPE)
    return {row["method"]: row for row in json.loads(done.stdout)["rows"]}


def told(row: dict[str, Any]) -> str:
    """A count with its interval."""
    low, high = row["devices_ci95"]
    return f"{row['devices']:,} ({low:,} to {high:,})"


if __name__ == "__main__":
    main()
