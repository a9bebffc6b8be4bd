"""Stages that are killed: SIGKILL at random moments, again and again, then to the end.

    python benchmarks/kill.py --kills 20 --seed 0
    python benchmarks/kill.py --every 1 --stages collect,eval

Every stage runs in a child process of its own and is killed right before one of its calls that
touch the disk, drawn among all of them. Between two such calls a kill finds the same disk at any
time, so these are all the moments there are (but for those inside a single write, of which
tests/storage/test_files.py takes care), and they do not depend on the machine's speed. After each
kill, every file that is there under its own name must load; then the same command is given again,
in the end ``hjepa resume``. Datasets, checkpoints, ``metrics.csv``, curves and tables must be the
bytes of a run that was not killed, and no other file may be left. Prints kills, and how many came
during a write. ``--every N`` kills before every Nth call instead, one kill a run; 1 leaves no
moment out.
"""

import argparse
import io
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from multiprocessing.context import BaseContext
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from types import FrameType, ModuleType
from typing import Any

import torch

from hjepa_cli.config.settings import load_settings
from hjepa_cli.core.datasets import dataset as datasets
from hjepa_cli.core.datasets.dataset import load_dataset
from hjepa_cli.core.training import progress
from hjepa_cli.output.screen import Screen
from hjepa_cli.stages import (
    collect,
    evaluate,
    resume,
    scale,
    train_encoder,
    train_hierarchy,
)
from hjepa_cli.storage import files
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.runs import CONFIG, METRICS, RESULT
from hjepa_cli.storage.shards import LOG

STAGES = ("collect", "train-encoder", "train-hierarchy", "eval", "scale")
DISK = frozenset("open write flush truncate close __exit__ fsync replace unlink mkdir".split())
OF_DISK = (ModuleType, io.BufferedIOBase, io.FileIO)  # not locks, which have __exit__ too
COMPARED = ("*.safetensors", "dataset.json", METRICS, "curves.json", "devices.csv", "config.toml")
SETTINGS = load_settings(
    flags={
        "collect.trajectories": 3,  # and as many by the tuned law
        "collect.test_trajectories": 2,
        "collect.clean_trajectories": 2,
        "collect.steps": 20,
        "collect.clean_steps": 12,
        "encoder.embedding": 16,
        "encoder.hidden": 16,
        "encoder.steps": 6,
        "encoder.batch_trajectories": 6,
        "encoder.batch_frames": 5,
        "encoder.gate": False,
        "augment.steps": 4,
        "actor.epochs": 1,
        "actor.batch": 40,
        "actor.hidden": 16,
        "hierarchy.rollout_steps": 8,
        "hierarchy.batch_trajectories": 2,
        "hierarchy.coarse_steps": 4,
        "hierarchy.flat_steps": 4,
        "hierarchy.medium_steps": 4,
        "hierarchy.low_steps": 4,
        "protocol": "paper",
        "protocol.steps": 40,
        "protocol.curve_devices": 4,
        "protocol.bracket_devices": 8,
        "protocol.gaps": [1, 4, 16],
        "protocol.horizon": 8,
        "protocol.bootstrap": 20,
        "methods": ["oracle", "hold-true", "zero-true", "optimal"],
    }
)


def run_stage(
    stage: str,
    root: Path,
    out: Path,
    last: int = 0,
    resumed: bool = False,
    calls: "Synchronized[int] | None" = None,
) -> None:
    """Run one stage into ``out``, saving its state after every step; the target of the child.

    Args:
        last: number of the call to the disk before which the process is killed; 0: never.
        resumed: by ``hjepa resume`` where there is something to resume.
        calls: is told how many there were.
    """
    count = 0

    def look(frame: FrameType, event: str, called: Any) -> None:
        nonlocal count
        if event == "c_call" and called.__name__ in DISK and isinstance(called.__self__, OF_DISK):
            count += 1
            if count == last:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(look)
    _run_stage(stage, root, out, resumed)
    sys.setprofile(None)
    if calls is not None:
        calls.value = count


def _run_stage(stage: str, root: Path, out: Path, resumed: bool) -> None:
    torch.set_num_threads(1)
    progress.SAVE_EVERY_S = 0.0
    datasets.SHARD_TRAJECTORIES = 1
    screen = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    data, encoder = root / "collect", str(root / "train-encoder")
    if resumed and any((out / name).exists() for name in (CONFIG, LOG, datasets.MANIFEST)):
        resume.run(out, screen)
    elif stage == "collect":
        collect.run(SETTINGS, screen, out=out)
    elif stage == "train-encoder":
        train_encoder.run(SETTINGS, screen, dataset=data, out=out)
    elif stage == "train-hierarchy":
        train_hierarchy.run(SETTINGS, screen, dataset=data, encoder=encoder, out=out)
    else:
        module = evaluate if stage == "eval" else scale
        model = str(root / "train-hierarchy")
        module.run(SETTINGS, screen, checkpoint=model, out=out, remeasure=True)


def run_child(context: BaseContext, *arguments: Any) -> int | None:
    """Exit code of :func:`run_stage` in a child, forked from one that has everything imported."""
    child = context.Process(target=run_stage, args=arguments)  # type: ignore[attr-defined]
    child.start()
    child.join()
    return child.exitcode  # type: ignore[no-any-return]


def context() -> BaseContext:
    """Children that start at once: real processes, without the seconds of importing torch."""
    chosen = multiprocessing.get_context("forkserver")
    stages = ("collect", "train_encoder", "train_hierarchy", "evaluate", "scale")
    chosen.set_forkserver_preload(
        [
            "hjepa_cli.output.figures",
            "torch._dynamo",
            *(f"hjepa_cli.stages.{name}" for name in stages),
        ]
    )
    first = chosen.Process(target=bool)  # not to be timed: it imports everything
    first.start()
    first.join()
    return chosen


def check_files(directory: Path) -> int:
    """Load every file that has its own name; return how many were left half-written."""
    if (directory / datasets.MANIFEST).exists():
        found = load_dataset(directory)
        for name in found.splits:
            found.split(name)
    for path in directory.glob("*.safetensors") if directory.is_dir() else ():
        if not path.name.startswith("shard-"):
            load_checkpoint(path)
    for path in directory.glob("*.json") if directory.is_dir() else ():
        files.read_json(path)
    return sum(bool(files.TEMPORARY.fullmatch(name)) for name in files.list_names(directory))


def kill_stage(
    chosen: BaseContext, stage: str, root: Path, out: Path, calls: int, moments: Sequence[float]
) -> tuple[int, int]:
    """Run ``stage`` into ``out``, killed at ``moments``, then to the end.

    Args:
        calls: how often the whole stage touches the disk.
        moments: shares of the calls that are left.

    Returns:
        How many kills hit, and how many of them while a file was being written.

    Raises:
        AssertionError: a child failed by itself, or the end differs from ``root/stage``.
        HjepaError: a file does not load after a kill.
    """
    killed = writing = 0
    for moment in moments:
        last = 1 + int(moment * calls)
        code = run_child(chosen, stage, root, out, last)
        assert code in (-signal.SIGKILL, 0), f"{stage} failed by itself: {code}"
        killed += code != 0
        writing += check_files(out)
        calls = max(calls - last, 1)
    code = run_child(chosen, stage, root, out, 0, True)
    assert code == 0, f"{stage} does not go on: {code}"
    compare(root / stage, out)
    assert check_files(out) == 0, "half-written files are left behind"
    return killed, writing


def compare(whole: Path, killed: Path) -> None:
    """Demand equal names and equal bytes of all that a stage makes."""
    names = [sorted(os.listdir(directory)) for directory in (whole, killed)]
    assert names[0] == names[1], f"{killed} holds {names[1]}, not {names[0]}"
    for pattern in COMPARED:
        for name in sorted(path.name for path in whole.glob(pattern)):
            assert (whole / name).read_bytes() == (killed / name).read_bytes(), killed / name
    assert (killed / RESULT).exists() or (killed / datasets.MANIFEST).exists()


def run_whole(chosen: BaseContext, stage: str, root: Path) -> int:
    """Run a stage without a kill into ``root/stage``; return how often it touches the disk."""
    calls = chosen.Value("q", 0)
    assert run_child(chosen, stage, root, root / stage, 0, False, calls) == 0, stage
    return int(calls.value)


def main(report: Callable[[str], None] = print) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20, help="per stage")
    parser.add_argument("--every", type=int, default=0, help="instead: before every Nth call")
    parser.add_argument("--stages", default=",".join(STAGES), help="those that are killed")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance, chosen = random.Random(options.seed), context()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for stage in STAGES:
            calls = run_whole(chosen, stage, root)  # the next ones read what it makes
            if stage not in options.stages.split(","):
                continue
            if options.every:
                schedule = [[(last + 0.5) / calls] for last in range(0, calls, options.every)]
            else:  # each kill of a run leaves less to do: a few per run
                moments = [chance.random() for _ in range(options.kills)]
                schedule = [moments[start : start + 4] for start in range(0, options.kills, 4)]
            started, killed, writing = time.monotonic(), 0, 0
            for moments in schedule:
                out = root / f"{stage}-killed"
                hit, inside = kill_stage(chosen, stage, root, out, calls, moments)
                killed, writing = killed + hit, writing + inside
                shutil.rmtree(out)
            report(
                f"{stage}: {calls} calls to the disk; {killed} kills in {len(schedule)} runs, "
                f"{writing} during a write, in {time.monotonic() - started:.0f} s; all files load, "
                "all ends are equal"
            )


if __name__ == "__main__":
    main()
