"""How much sooner `eval` and `scale --law scheduled` end with more workers, and that they agree.

    python benchmarks/workers.py [--workers 1,2] [--steps 400] [--methods hjepa,hold,oracle]

Every command runs in a process of its own in an empty directory, without cached curves, as often as
``--repeat`` says, the numbers of workers in turn, so that whatever else the machine does meets all
of them. Times are the best of each; they contain the start of the program and of its workers.
Speed-up ÷ cores is 1 where every worker is as fast as the first alone and never waits.
"""

import argparse
import json
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from lists import whole_numbers

CHECKPOINT = "desktop-h4m2l1"
COMMON = "bracket = 0.1\nbootstrap = 200\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--workers", type=whole_numbers, default="1,2", help="to compare with the first"
    )
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--methods", default="hjepa,ts-jepa-4,hold,oracle")
    parser.add_argument("--repeat", type=int, default=1)
    options = parser.parse_args()
    counts = options.workers
    commands = {
        "eval": ["eval", "--methods", options.methods, "--remeasure"],
        "scheduled": [
            *("scale", "--law", "scheduled", "--methods", options.methods),
            *("--scheduler", "round-robin,innovation", "--seeds", "2", "--snr", "20"),
        ],
    }
    for name, command in commands.items():
        best_s, found = dict.fromkeys(counts, math.inf), dict[int, str]()
        for _ in range(options.repeat):
            for count in counts:
                took_s, found[count] = timed(command, count, options.steps)
                best_s[count] = min(best_s[count], took_s)
        for count in counts:
            speed_up = best_s[counts[0]] / best_s[count]
            same = "same result" if found[count] == found[counts[0]] else "ANOTHER RESULT"
            print(
                f"{name:10} {count:3} workers: {best_s[count]:8.1f} s, {speed_up:5.2f} x, "
                f"÷ cores {speed_up * counts[0] / count:5.2f}, {same}"
            )


def timed(command: list[str], workers: int, steps: int) -> tuple[float, str]:
    """Run a command in an empty directory: seconds, and what it found."""
    with tempfile.TemporaryDirectory() as directory:
        config = Path(directory, "short.toml")
        config.write_text(f"[protocol]\nwarmup_steps = 0\nsteps = {steps}\n{COMMON}")
        line = [sys.executable, "-m", "hjepa_cli", *command, "--checkpoint", CHECKPOINT]
        line += ["--config", str(config), "--workers", str(workers), "--json", "--quiet"]
        started = time.perf_counter()
        done = subprocess.run(line, cwd=directory, check=True, capture_output=True, text=True)
        took_s = time.perf_counter() - started
    document = json.loads(done.stdout)
    return took_s, json.dumps(document.get("methods", document.get("rows")))


if __name__ == "__main__":
    main()
