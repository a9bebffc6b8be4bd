"""Is a million trajectories only a matter of time? ``hjepa collect`` at growing sizes.

    python benchmarks/collect.py --sizes 2000,4000,8000,16000,32000

Each size is collected by a fresh process, as a user would (``--workers 0``: one process, so that
its memory is all the memory). Prints CPU seconds, peak memory and bytes on disk; the straight line
through the seconds and how far they are off it; and, beside what ``--dry-run`` plans for a million
trajectories, what the line says.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from lists import whole_numbers

REPOSITORY = Path(__file__).resolve().parents[1]
MILLION = 1_000_000


def command(trajectories: int, *options: str) -> list[str]:
    """``hjepa collect`` of so many training trajectories."""
    words = ["collect", "--trajectories", str(trajectories), *options, "--json", "--quiet"]
    return [sys.executable, "-m", "hjepa_cli", *words]


def environment() -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(REPOSITORY)}


def collect(trajectories: int, workers: int) -> tuple[float, float, int]:
    """CPU seconds, peak memory in MB, and bytes on disk of one collection."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            command(trajectories, "--workers", str(workers), "--out", "data"),
            cwd=folder,
            env=environment(),
            stdout=subprocess.DEVNULL,
        )
        _, status, used = os.wait4(process.pid, 0)  # of this child alone, its workers included
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            sys.exit(f"collect --trajectories {trajectories} ended with {process.returncode}")
        size_bytes = sum(path.stat().st_size for path in Path(folder, "data").iterdir())
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1e3, size_bytes


def plan(trajectories: int) -> dict[str, Any]:
    """What ``--dry-run`` says."""
    shown = subprocess.run(
        command(trajectories, "--dry-run"), env=environment(), capture_output=True, check=True
    )
    found: dict[str, Any] = json.loads(shown.stdout)["plan"]
    return found


def line(sizes: list[int], seconds: list[float]) -> tuple[float, float, float]:
    """Least squares: intercept (s), slope (s per trajectory), largest deviation ÷ its value."""
    slope, intercept = np.polyfit(sizes, seconds, 1)
    fitted = intercept + slope * np.array(sizes)
    return float(intercept), float(slope), float(np.abs(np.array(seconds) / fitted - 1).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=whole_numbers, default="2000,4000,8000,16000,32000")
    parser.add_argument("--workers", type=int, default=0)
    options = parser.parse_args()
    sizes = options.sizes
    collected = []
    for size in sizes:
        collected.append(collect(size, options.workers))
        seconds, megabytes, size_bytes = collected[-1]
        print(
            f"{size:8} trajectories: {seconds:6.1f} s of CPU, peak {megabytes:.0f} MB, "
            f"{size_bytes / 1e6:.1f} MB on disk",
            flush=True,
        )
    start_s, slope_s, off = line(sizes, [seconds for seconds, _, _ in collected])
    print(
        f"line: {start_s:.1f} s + {1000 * slope_s:.2f} s per 1,000, at most {100 * off:.0f} % off"
    )
    peaks = [megabytes for _, megabytes, _ in collected]
    print(f"peak memory: {max(peaks) / min(peaks):.2f} times from the smallest to the largest")
    planned = plan(MILLION)
    print(
        f"a million: {(start_s + slope_s * MILLION) / 60:.1f} min of CPU by the line; planned "
        f"{planned['minutes']:.1f} min on two cores, {planned['writes_bytes'] / 1e9:.2f} GB, "
        f"{planned['writes'][0].split(' in ')[1]}"
    )


if __name__ == "__main__":
    main()
