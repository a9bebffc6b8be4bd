"""Whether this checkout trains what another one trains, bit for bit.

    python benchmarks/same_tensors.py OTHER [--preset default]

OTHER is another checkout of this repository, as of the commit before a change that should change
nothing. ``hjepa collect``, ``train-encoder``, ``train-hierarchy`` and ``train-reflex`` run with
either package in a directory of its own, one after the other on the same threads; then every tensor
of every file is compared. Exit code 1 if one differs.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

HERE = Path(__file__).resolve().parents[1]
COMMANDS = ("collect", "train-encoder", "train-hierarchy", "train-reflex")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path)
    parser.add_argument("--preset", default="default")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ours, theirs = Path(folder, "ours"), Path(folder, "theirs")
        for checkout, directory in ((HERE, ours), (options.other.resolve(), theirs)):
            directory.mkdir()
            for command in COMMANDS:
                line = [sys.executable, "-m", "hjepa_cli", command, "--preset", options.preset]
                environment = os.environ | {"PYTHONPATH": str(checkout)}
                subprocess.run([*line, "--quiet"], cwd=directory, env=environment, check=True)
        different = 0
        for path in sorted(theirs.rglob("*.safetensors")):
            name = path.relative_to(theirs)
            same = equal(path, ours / name)
            different += not same
            print(f"{name}: {'same' if same else 'DIFFERENT'}")
    sys.exit(1 if different else 0)


def equal(one: Path, other: Path) -> bool:
    """Whether two files hold the same tensors under the same names."""
    first, second = load_file(one), load_file(other)
    return first.keys() == second.keys() and all(
        np.array_equal(first[name], second[name]) for name in first
    )


if __name__ == "__main__":
    main()
