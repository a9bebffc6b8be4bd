"""The closed loop on all cores: worker processes, each simulating blocks of devices.

A control step is many small operations on few devices, which threads do not speed up; processes do.
"""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from types import TracebackType
from typing import Self

import torch

from hjepa_cli.core.loop import Outcome
from hjepa_cli.core.memory import keep_freed_memory
from hjepa_cli.core.model import Model
from hjepa_cli.core.simulator import Block, Simulator, Tick
from hjepa_cli.errors import NumericalError
from hjepa_cli.settings import Settings

MAX_WORKERS = 8  # of some 400 MB each
TICK_S = 0.2  # between looks at the workers' progress


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class Workers:
    """A :data:`~hjepa_cli.core.simulator.Runner` over several processes; a context manager.

    Args:
        settings: as for :class:`~hjepa_cli.core.simulator.Simulator`.
        model_path: checkpoint of the model; each worker loads it.
        count: processes.

    Raises:
        NumericalError: a worker died (out of memory, killed); errors inside a block are raised
            as they are.
    """

    def __init__(self, settings: Settings, model_path: Path | None, count: int) -> None:
        # Spawned, not forked: torch's threads do not survive a fork.
        context = multiprocessing.get_context("spawn")
        self._done: Synchronized[int] = context.Value("q", 0)
        self._pool = ProcessPoolExecutor(
            count, context, initializer=_start, initargs=(settings, model_path, self._done)
        )

    def __call__(self, blocks: Sequence[Block], tick: Tick) -> list[Outcome]:
        with _anonymous_main():  # workers start with the first blocks
            futures = [self._pool.submit(_simulate, block) for block in blocks]
        waiting, told = set(futures), self._done.value
        while waiting:
            waiting = wait(waiting, TICK_S).not_done
            done = self._done.value
            tick(done - told)
            told = done
        try:
            return [future.result() for future in futures]
        except BrokenProcessPool:
            raise NumericalError(
                "a worker process died (out of memory?)",
                hint="free some memory, then run the same command again",
            ) from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown(cancel_futures=True)


@contextmanager
def _anonymous_main() -> Iterator[None]:
    """Keep spawned processes from running the user's script again.

    They would import it, which needs a ``__main__`` guard there and fails for standard input.
    """
    main = sys.modules["__main__"].__dict__
    spec, file = main["__spec__"], main.pop("__file__", None)
    main["__spec__"] = None
    try:
        yield
    finally:
        main["__spec__"] = spec
        if file is not None:
            main["__file__"] = file


# What a worker process keeps between blocks.
_settings: Settings
_model_path: Path | None
_done: "Synchronized[int]"
_simulator: Simulator | None = None


def _start(settings: Settings, model_path: Path | None, done: "Synchronized[int]") -> None:
    """Prepare a worker: one thread; Ctrl-C is the parent's; it ends when the parent is gone."""
    global _settings, _model_path, _done
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    keep_freed_memory()
    _settings, _model_path, _done = settings, model_path, done


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _simulate(block: Block) -> Outcome:
    """Simulate one block in a worker; the model is loaded with the first."""
    global _simulator
    if _simulator is None:
        model = Model.load(_model_path, _settings.device) if _model_path else None
        _simulator = Simulator(_settings, model)

    def tick(steps: int) -> None:
        with _done.get_lock():
            _done.value += steps

    return _simulator.run(block, tick)
