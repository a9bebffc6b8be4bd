"""The closed loop on all cores: worker processes, each simulating blocks of devices.

A control step is many small operations on few devices, which threads do not speed up; processes do.
"""

import dataclasses
import functools
import multiprocessing
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed, wait
from contextlib import contextmanager
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import torch

from hjepa_cli.core.executors import broken_pool_reported, prepare_worker, worker_pool
from hjepa_cli.core.loop import Outcome
from hjepa_cli.core.model import Model
from hjepa_cli.core.simulator import Block, Runner, Simulator, Tick
from hjepa_cli.errors import DataError
from hjepa_cli.settings import Settings

TICK_S = 0.2  # between looks at the workers' progress


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A checkpoint that workers load: where it is, and its digest when the command read it."""

    path: Path
    digest: str

    def load(self, device: str) -> Model:
        """Raise DataError if the file has changed since."""
        model = Model.load(self.path, device)
        if model.digest != self.digest:
            raise DataError(
                f"{self.path} is another model here than the command was given",
                hint="let the training that writes it end; workers must see the same files",
            )
        return model


@contextmanager
def open_workers(settings: Settings, model: ModelFile | None, count: int) -> Iterator[Runner]:
    """A runner over ``count`` processes of this machine.

    Args:
        settings: as for :class:`~hjepa_cli.core.simulator.Simulator`.
        model: each worker loads it.
        count: processes.

    Raises:
        NumericalError: a worker died (out of memory, killed); errors inside a block are raised
            as they are.
    """
    done: Synchronized[int] = multiprocessing.get_context("spawn").Value("q", 0)

    def follow(futures: Sequence[Future[Outcome]], blocks: Sequence[Block], tick: Tick) -> None:
        # Read without the lock: a worker that is killed holding it would never give it back.
        waiting, count = set(futures), done.get_obj()
        told = count.value
        while waiting:
            waiting = wait(waiting, TICK_S).not_done
            now = count.value
            tick(now - told)
            told = now

    with worker_pool(count, _start, done) as pool:
        yield _runner(pool, settings, model, follow)


def cluster_runner(executor: Executor, settings: Settings, model: ModelFile | None) -> Runner:
    """A runner over any executor, whose workers see the model's file under the same path."""

    def follow(futures: Sequence[Future[Outcome]], blocks: Sequence[Block], tick: Tick) -> None:
        loops = {
            future: len(block.points) * (block.stop - block.start)
            for future, block in zip(futures, blocks, strict=True)
        }
        for future in as_completed(futures):
            tick(loops[future] * settings.protocol.total_steps)

    return _runner(executor, settings, model, follow)


def single_thread(runner: Runner) -> Runner:
    """``runner`` in this process as workers do it, so that results are the same bytes."""

    def run(blocks: Sequence[Block], tick: Tick) -> list[Outcome]:
        with one_thread():
            return runner(blocks, tick)

    return run


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute as workers do, whose sums have one order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


Follow = Callable[[Sequence[Future[Outcome]], Sequence[Block], Tick], None]


def _runner(
    executor: Executor, settings: Settings, model: ModelFile | None, follow: Follow
) -> Runner:
    def run(blocks: Sequence[Block], tick: Tick) -> list[Outcome]:
        with broken_pool_reported():
            futures = [executor.submit(simulate, settings, model, block) for block in blocks]
            follow(futures, blocks, tick)
            return [future.result() for future in futures]

    return run


# What a worker process keeps between blocks.
_done: "Synchronized[int] | None" = None
_one_at_a_time = threading.Lock()  # a Dask worker may have threads; a simulator is for one


def _start(done: "Synchronized[int]") -> None:
    global _done
    prepare_worker()
    _done = done


def simulate(settings: Settings, model: ModelFile | None, block: Block) -> Outcome:
    """Simulate one block in a worker, in one thread; the model is loaded with the first."""
    with _one_at_a_time:
        torch.set_num_threads(1)
        return _simulator(settings, model).run(block, _tick)


@functools.lru_cache(maxsize=1)
def _simulator(settings: Settings, model: ModelFile | None) -> Simulator:
    # The workers of a cluster outlive commands: the digest tells a model from one trained since.
    return Simulator(settings, model.load(settings.device) if model else None)


def _tick(steps: int) -> None:
    if _done is not None:
        with _done.get_lock():
            _done.value += steps
