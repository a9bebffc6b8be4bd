"""Stages that are killed: SIGKILL at random moments, again and again, then to the end.

    python benchmarks/kill.py --kills 20 --seed 0

Every stage runs in a child process of its own and is killed at moments drawn over the time it
takes. After each kill, every file that is there under its own name must load; the same command
is then given again. In the end datasets, checkpoints, ``metrics.csv``, curves and tables must be
the bytes of a run that was not killed. Prints kills, moments and how many came during a write.
"""

import argparse
import io
import multiprocessing
import random
import tempfile
import time
from collections.abc import Callable
from multiprocessing.context import BaseContext
from pathlib import Path

import torch

from hjepa_cli.screen import Screen
from hjepa_cli.settings import load_settings
from hjepa_cli.stages import collect, evaluate, progress, scale, train_encoder, train_hierarchy
from hjepa_cli.storage import datasets, files
from hjepa_cli.storage.checkpoints import load_checkpoint
from hjepa_cli.storage.datasets import load_dataset
from hjepa_cli.storage.runs import METRICS, RESULT

STAGES = ("collect", "train-encoder", "train-hierarchy", "eval", "scale")
COMPARED = ("*.safetensors", "dataset.json", METRICS, "curves.json", "devices.csv", "config.toml")
SETTINGS = load_settings(
    flags={
        "collect.trajectories": 6,
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
        "actor.epochs": 1,
        "actor.batch": 40,
        "actor.hidden": 16,
        "hierarchy.rollout_steps": 8,
        "hierarchy.batch_trajectories": 2,
        "hierarchy.coarse_steps": 4,
        "hierarchy.flat_steps": 4,
        "hierarchy.medium_steps": 4,
        "hierarchy.low_steps": 4,
        "protocol.steps": 40,
        "protocol.curve_devices": 4,
        "protocol.bracket_devices": 8,
        "protocol.gaps": [1, 4, 16],
        "protocol.horizon": 8,
        "protocol.bootstrap": 20,
        "methods": ["oracle", "hold-true", "zero-true", "optimal"],
    }
)


def run_stage(stage: str, root: Path, out: Path) -> None:
    """Run one stage into ``out``, saving its state after every step; the target of the child."""
    torch.set_num_threads(1)
    progress.SAVE_EVERY_S = 0.0
    datasets.SHARD_TRAJECTORIES = 1
    screen = Screen(quiet=True, stdout=io.StringIO(), stderr=io.StringIO())
    data, encoder = root / "collect", str(root / "train-encoder")
    if stage == "collect":
        collect.run(SETTINGS, screen, out=out)
    elif stage == "train-encoder":
        train_encoder.run(SETTINGS, screen, dataset=data, out=out)
    elif stage == "train-hierarchy":
        train_hierarchy.run(SETTINGS, screen, dataset=data, encoder=encoder, out=out)
    else:
        module = evaluate if stage == "eval" else scale
        model = str(root / "train-hierarchy")
        module.run(SETTINGS, screen, checkpoint=model, out=out, remeasure=True)


def start(context: BaseContext, stage: str, root: Path, out: Path) -> multiprocessing.Process:
    """A child that runs a stage, forked from a process that has everything imported."""
    child = context.Process(target=run_stage, args=(stage, root, out))  # type: ignore[attr-defined]
    child.start()
    return child


def context() -> BaseContext:
    """Children that start at once: real processes, without the seconds of importing torch."""
    chosen = multiprocessing.get_context("forkserver")
    stages = ("collect", "train_encoder", "train_hierarchy", "evaluate", "scale")
    chosen.set_forkserver_preload(
        ["hjepa_cli.figures", "torch._dynamo", *(f"hjepa_cli.stages.{name}" for name in stages)]
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
    return sum(files.is_temporary(name) for name in files.list_names(directory))


def kill_stage(
    chosen: BaseContext, stage: str, root: Path, out: Path, seconds: float, moments: list[float]
) -> int:
    """Run ``stage`` into ``out``, killed at ``moments`` (of its whole time), then to the end.

    Returns:
        How many kills came while a file was being written.

    Raises:
        AssertionError: a child failed by itself, or the end differs from ``root/stage``.
        HjepaError: a file does not load after a kill.
    """
    writing = 0
    for moment in moments:
        child = start(chosen, stage, root, out)
        child.join(moment * seconds)
        child.kill()
        child.join()
        assert child.exitcode in (-9, 0), f"{stage} failed by itself: {child.exitcode}"
        writing += check_files(out)
    child = start(chosen, stage, root, out)
    child.join()
    assert child.exitcode == 0, f"{stage} does not go on: {child.exitcode}"
    compare(root / stage, out)
    assert check_files(out) == 0, "half-written files are left behind"
    return writing


def compare(whole: Path, killed: Path) -> None:
    """Demand equal names and equal bytes of all that a stage makes."""
    for pattern in COMPARED:
        names = sorted(path.name for path in whole.glob(pattern))
        assert names == sorted(path.name for path in killed.glob(pattern)), (killed, pattern)
        for name in names:
            assert (whole / name).read_bytes() == (killed / name).read_bytes(), killed / name
    assert (killed / RESULT).exists() or (killed / datasets.MANIFEST).exists()


def run_whole(chosen: BaseContext, stage: str, root: Path) -> float:
    """Run a stage without a kill into ``root/stage``; return its seconds."""
    started = time.monotonic()
    child = start(chosen, stage, root, root / stage)
    child.join()
    assert child.exitcode == 0, stage
    return time.monotonic() - started


def main(report: Callable[[str], None] = print) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20, help="per stage")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance, chosen = random.Random(options.seed), context()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        for stage in STAGES:
            seconds = run_whole(chosen, stage, root)
            moments = [chance.random() for _ in range(options.kills)]
            # Each kill of a chain leaves less to do, so a few chains reach all moments.
            chains = [moments[first::4] for first in range(4) if moments[first::4]]
            writing = sum(
                kill_stage(chosen, stage, root, root / f"{stage}-{number}", seconds, chain)
                for number, chain in enumerate(chains)
            )
            report(
                f"{stage}: {seconds:.1f} s whole; {options.kills} kills in {len(chains)} runs, "
                f"{writing} during a write; all files load, all ends are equal"
            )


if __name__ == "__main__":
    main()
