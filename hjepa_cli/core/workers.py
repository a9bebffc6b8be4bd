"""Worker processes for the closed loop: one per core, each simulating blocks of devices.

A control step is many small operations on few devices, which threads do not speed up; processes
do. A worker is this module run as a program. It reads pickled requests from its standard input and
writes pickled replies to its standard output; both ends are ours, and nothing else touches them.
"""

import contextlib
import os
import pickle
import queue
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

import torch

from hjepa_cli.core.loop import Outcome
from hjepa_cli.core.model import Model
from hjepa_cli.core.simulator import Block, Simulator, Tick
from hjepa_cli.errors import NumericalError
from hjepa_cli.settings import Settings

MAX_WORKERS = 8  # of some 400 MB each
TICKS = 10  # control steps between progress messages


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
        start = pickle.dumps((settings, model_path))
        self._idle: queue.SimpleQueue[_Worker] = queue.SimpleQueue()
        self._workers = [_Worker(start) for _ in range(count)]
        for worker in self._workers:
            self._idle.put(worker)
        self._threads = ThreadPoolExecutor(count)

    def __call__(self, blocks: Sequence[Block], tick: Tick) -> list[Outcome]:
        lock = threading.Lock()

        def locked_tick(steps: int) -> None:
            with lock:
                tick(steps)

        def run(block: Block) -> Outcome:
            worker = self._idle.get()
            try:
                return worker.run(block, locked_tick)
            finally:
                self._idle.put(worker)

        return list(self._threads.map(run, blocks))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for worker in self._workers:
            worker.kill()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            worker.close()


class _Worker:
    """This end of one worker process."""

    def __init__(self, start: bytes) -> None:
        package = Path(__file__).parents[2]
        paths = [str(package), *filter(None, [os.environ.get("PYTHONPATH")])]
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"},
        )
        self._send(start)

    def run(self, block: Block, tick: Tick) -> Outcome:
        self._send(pickle.dumps(block))
        assert self._process.stdout is not None
        while True:
            try:
                reply = pickle.load(self._process.stdout)
            except (EOFError, pickle.UnpicklingError):
                raise self._death() from None
            if isinstance(reply, int):
                tick(reply)
            elif isinstance(reply, Outcome):
                return reply
            else:
                raise reply

    def kill(self) -> None:
        self._process.kill()

    def close(self) -> None:
        """Give the pipes back and reap the process, once nobody reads from it any more."""
        with contextlib.suppress(BrokenPipeError):
            self._process.__exit__(None, None, None)

    def _send(self, message: bytes) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(message)
            self._process.stdin.flush()
        except BrokenPipeError:
            raise self._death() from None

    def _death(self) -> NumericalError:
        return NumericalError(
            f"a worker process ended with code {self._process.wait()} (out of memory?)",
            hint="free some memory, then run the same command again",
        )


def serve(requests: BinaryIO, replies: BinaryIO) -> None:
    """Be a worker: simulate blocks until the requests end."""
    torch.set_num_threads(1)
    settings, model_path = pickle.load(requests)
    simulator: Simulator | None = None

    def reply(message: object) -> None:
        replies.write(pickle.dumps(message))
        replies.flush()

    while True:
        try:
            block = pickle.load(requests)
        except EOFError:
            return
        try:
            if simulator is None:
                model = Model.load(model_path, settings.device) if model_path else None
                simulator = Simulator(settings, model)
            reply(simulator.run(block, _Batched(reply)))
        except Exception as error:
            reply(error)


class _Batched:
    """Passes on the sum of every few ticks."""

    def __init__(self, tick: Tick) -> None:
        self._tick, self._calls, self._steps = tick, 0, 0

    def __call__(self, steps: int) -> None:
        self._calls, self._steps = self._calls + 1, self._steps + steps
        if self._calls == TICKS:
            self._tick(self._steps)
            self._calls, self._steps = 0, 0


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's, which then ends us
    with contextlib.suppress(BrokenPipeError):
        pipe = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)  # a stray print must not end up among the replies
        serve(sys.stdin.buffer, pipe)
