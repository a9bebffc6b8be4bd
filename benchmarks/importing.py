"""``hjepa data import`` of NPZ files of growing size: frames per second, peak memory, disk.

    python benchmarks/importing.py --frames 25000,50000,100000

Time should grow as the frames do, and memory not at all. Beside it: the time that copying the same
bytes takes on this disk, and the seconds of CPU, which a busy machine does not change much.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
import zipfile
from pathlib import Path

import numpy as np
from lists import whole_numbers

STEPS, HEIGHT, WIDTH = 100, 64, 128
BLOCK = 1000


def write(path: Path, frames: int) -> None:
    """Write an NPZ of noise that scrolls, without holding it in memory."""
    random = np.random.default_rng(0)
    base = random.integers(0, 256, (HEIGHT, WIDTH + BLOCK, 3), dtype=np.uint8)
    episodes = frames // (STEPS + 1)
    shape = (episodes, STEPS + 1, HEIGHT, WIDTH, 3)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
        with archive.open("frames.npy", "w", force_zip64=True) as file:
            described = {"descr": "|u1", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(file, described)
            for k in range(episodes * (STEPS + 1)):
                start = k % BLOCK
                file.write(base[:, start : start + WIDTH].tobytes())
        with archive.open("actions.npy", "w") as file:
            actions = random.uniform(-1, 1, (episodes, STEPS + 1, 1))
            np.lib.format.write_array(file, actions)


def measure(directory: Path, frames: int) -> dict[str, float]:
    """Import so many frames in a process of its own."""
    source = directory / "recording.npz"
    write(source, frames)
    command = [sys.executable, "-m", "hjepa_cli", "data", "import", source, "--fps", "50"]
    command += ["--limit", "1", "--out", directory / "dataset", "--json", "--quiet"]
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, env={**os.environ})
    assert process.stdout is not None
    document = json.loads(process.stdout.read())
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    seconds = time.perf_counter() - began
    assert process.returncode == 0, document
    assert before is not None
    began = time.perf_counter()
    shutil.copyfile(source, directory / "copy")
    copied = time.perf_counter() - began
    for path in (directory / "dataset", directory / "copy", source):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    cpu = used.ru_utime + used.ru_stime
    return {
        "frames": document["frames"],
        "seconds": round(seconds, 1),
        "frames_per_s": round(document["frames"] / seconds),
        "cpu_seconds": round(cpu, 1),
        "frames_per_cpu_s": round(document["frames"] / cpu),
        "peak_mib": round(used.ru_maxrss / 1024),
        "copy_seconds": round(copied, 1),
    }


def main() -> None:
    """Print a row for each size."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=whole_numbers, default="25000,50000,100000")
    for frames in parser.parse_args().frames:
        with tempfile.TemporaryDirectory() as directory:
            print(json.dumps(measure(Path(directory), frames)), flush=True)


if __name__ == "__main__":
    main()
