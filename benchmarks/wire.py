"""What the wire costs: CPU time of the exported networks, start of a device, devices per machine.

    python benchmarks/wire.py EXPORTED encoder [--checkpoint desktop-h4m2l1] [--rounds 20]
    python benchmarks/wire.py EXPORTED start [--rounds 5]
    python benchmarks/wire.py EXPORTED devices [--periods 1,2,5,10] [--steps 1000]

``encoder`` times one picture at a time and batches of 64, in one thread, the shipped torch call and
the exported networks by turns, so that a drifting machine moves all alike; it prints medians of CPU
time and the ratio of both, exported ÷ torch. ``start`` measures a device from its command to its
end after one step, with its peak memory. ``devices`` doubles the number of devices until
``bench-link`` reports an overrun, then looks in between, at each period.

Exits with 1 if the encoder's ratio at batch 1 exceeds 0.3, or a device takes more than 0.5 s of CPU
or 100 MB to start.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

MOST_RATIO, MOST_START_S, MOST_START_MB = 0.3, 0.5, 100.0
LARGEST_FLEET = 2048
HJEPA = [sys.executable, "-m", "hjepa_cli"]


def main() -> int:
    """Run one of the benchmarks."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("exported", type=Path)
    parser.add_argument("what", choices=("encoder", "start", "devices"))
    parser.add_argument("--checkpoint", default="desktop-h4m2l1")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--periods", default="1,2,5,10")
    parser.add_argument("--steps", type=int, default=1000)
    given = parser.parse_args()
    if given.what == "encoder":
        return encoder(given.exported, given.checkpoint, given.rounds)
    if given.what == "start":
        return start(given.exported, given.rounds)
    return devices(given.exported, given.periods, given.steps)


def encoder(exported: Path, checkpoint: str, rounds: int) -> int:
    """Time encoders and planners side by side."""
    import torch

    from hjepa_cli.core.control.planners import Hierarchy
    from hjepa_cli.core.networks.model import Model
    from hjepa_cli.core.plants.frames import FRAME_SHAPE
    from hjepa_cli.storage import zoo
    from hjepa_cli.wire.bundle import open_bundle
    from hjepa_cli.wire.runtime import BACKENDS, Runtime

    torch.set_num_threads(1)
    model = Model.load(zoo.resolve_model(checkpoint), "cpu")
    planner, bundle = Hierarchy(model), open_bundle(exported)
    shape = (model.frames, *FRAME_SHAPE)
    frames = np.random.default_rng(0).integers(0, 256, (64, *shape), dtype=np.uint8)
    z = model.encode(frames)
    backends = [name for name in BACKENDS if _there(name)]
    worst = 0.0
    for rows in (1, 64):
        part, few = frames[:rows], z[:rows]
        calls: dict[str, Callable[[], object]] = {
            "encode torch": lambda part=part: model.encode(part),
            "plan torch": lambda few=few: _inference(planner.plan, few),
        }
        for backend in backends:
            for precision in ("fp32", "int8"):
                runtime = Runtime(bundle, backend, precision)
                calls[f"encode {backend} {precision}"] = lambda r=runtime, p=part: r.encode(p)
            array = few.numpy()
            calls[f"plan {backend} fp32"] = lambda r=runtime, f=array: r.plan(f)
        taken: dict[str, list[float]] = {name: [] for name in calls}
        for call in calls.values():
            call()
        for _ in range(rounds):
            for name, call in calls.items():
                taken[name].append(_cpu_ms(call, 20 if rows == 1 else 2) / rows)
        medians = {name: statistics.median(times) for name, times in taken.items()}
        for name, median in medians.items():
            ratio = median / medians[f"{name.split()[0]} torch"]
            low, high = min(taken[name]), max(taken[name])
            print(f"batch {rows:2} {name:26} {median:.4f} ms [{low:.4f}–{high:.4f}] {ratio:.2f}")
        if rows == 1:
            worst = medians["encode onnxruntime fp32"] / medians["encode torch"]
    return int(worst > MOST_RATIO)


def start(exported: Path, rounds: int) -> int:
    """Time a device's start."""
    serve = [*HJEPA, "serve", "--model", str(exported), "--bind", "127.0.0.1:0", "--json"]
    times_s, peak_mb = [], 0.0
    with subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as server:
        assert server.stdout is not None
        address = json.loads(server.stdout.readline())["serving"]
        command = [*HJEPA, "device", "--model", str(exported), "--server", address]
        for _ in range(rounds):
            device = subprocess.Popen([*command, "--steps", "1", "--quiet"])
            _, status, used = os.wait4(device.pid, 0)  # of this device alone, not of the server
            device.returncode = os.waitstatus_to_exitcode(status)
            if device.returncode:
                server.kill()
                sys.exit(f"the device ended with {device.returncode}")
            times_s.append(used.ru_utime + used.ru_stime)
            peak_mb = max(peak_mb, used.ru_maxrss / 1024)
        server.kill()
    median_s = statistics.median(times_s)
    print(f"start {median_s:.2f} s of CPU, median of {rounds}, peak {peak_mb:.0f} MB")
    return int(median_s > MOST_START_S or peak_mb > MOST_START_MB)


def devices(exported: Path, periods: str, steps: int) -> int:
    """Look for the largest fleet without an overrun, by doubling and then halving the bracket."""
    for period in periods.split(","):
        good, bad, found = 0, LARGEST_FLEET, {}
        count = 4
        while bad - good > max(good // 8, 1):
            missing = _bench(exported, count, float(period), steps)
            if missing is not None:
                good, found = count, {"missing_share": missing}
                count = min(2 * count, (good + bad) // 2) if bad < LARGEST_FLEET else 2 * count
            else:
                bad = count
                count = (good + bad) // 2
            if count >= LARGEST_FLEET or count == good:
                break
        share = 100 * found.get("missing_share", float("nan"))
        print(f"{period} ms a step: {good} devices, {share:.3f} % of steps without a force")
    return 0


def _bench(exported: Path, count: int, period_ms: float, steps: int) -> float | None:
    """Return the share of steps without a force, ``None`` for an overrun."""
    command = [*HJEPA, "bench-link", "--model", str(exported), "--devices", str(count)]
    command += ["--steps", str(steps), "--period-ms", str(period_ms), "--json", "--quiet"]
    ran = subprocess.run(command, capture_output=True, text=True)
    document = json.loads(ran.stdout)
    return None if ran.returncode else float(document["missing_share"])


def _there(module: str) -> bool:
    import importlib.util

    return importlib.util.find_spec(module) is not None


def _inference(call: Callable[..., object], *given: object) -> object:
    import torch

    with torch.inference_mode():
        return call(*given)


def _cpu_ms(call: Callable[[], object], times: int) -> float:
    before_s = time.process_time()
    for _ in range(times):
        call()
    return 1e3 * (time.process_time() - before_s) / times


if __name__ == "__main__":
    sys.exit(main())
