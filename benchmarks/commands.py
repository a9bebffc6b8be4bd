"""How long the commands take, run as a user runs them: fresh processes in an empty directory.

    python benchmarks/commands.py smoke      # five stages, --preset smoke        (target ≤ 60 s)
    python benchmarks/commands.py default    # the five literal lines             (target ≤ 30 min)
    python benchmarks/commands.py zoo        # scale from cached curves           (target ≤ 30 s)
    python benchmarks/commands.py remeasure  # scale --remeasure, one pixel method (target ≤ 5 min)

Prints wall-clock seconds per command and in total. One run: quote it with the machine. A command
that fails ends the benchmark with its exit code and the last lines it wrote to standard error.
"""

import argparse
import os
import platform
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
LAST_LINES = 10  # of standard error, shown when a command fails
LINES = (
    "collect --trajectories 200",
    "train-encoder",
    "train-hierarchy --h 4 --m 2 --l 1",
    "eval",
    "scale --snr 10:30",
)
SUITES = {
    "default": LINES,
    "smoke": ("collect", *LINES[1:]),
    "zoo": ("scale --snr 10:30",),
    "remeasure": ("scale --snr 10:30 --methods hjepa --remeasure",),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("suite", choices=SUITES)
    suite = parser.parse_args().suite
    print(f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}")
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    total = 0.0
    with tempfile.TemporaryDirectory() as directory:
        for line in SUITES[suite]:
            words = shlex.split(line) + (["--preset", "smoke"] if suite == "smoke" else [])
            started = time.perf_counter()
            ended = subprocess.run(
                [sys.executable, "-m", "hjepa_cli", *words],
                cwd=directory,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
            )
            seconds = time.perf_counter() - started
            if ended.returncode:
                print(f"failed after {seconds:.1f} s: hjepa {' '.join(words)}", file=sys.stderr)
                print(*ended.stderr.splitlines()[-LAST_LINES:], sep="\n", file=sys.stderr)
                sys.exit(ended.returncode)
            total += seconds
            print(f"{seconds:8.1f} s  hjepa {' '.join(words)}", flush=True)
    print(f"{total:8.1f} s  in all")


if __name__ == "__main__":
    main()
