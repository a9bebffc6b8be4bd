"""Worker processes run closed loops on all cores, each by units that were described to it.

A control step is many small operations on few devices, which threads do not speed up; processes do.
A unit is computed in one thread, whose sums have one order, wherever that is: so results are the
same bytes from any number of workers.
"""

import dataclasses
import functools
import itertools
import multiprocessing
import threading
from collections import deque
from collections.abc import Callable, Generator, Hashable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, wait
from contextlib import closing, contextmanager
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path
from typing import Any, Protocol, TypeVar

import torch

from hjepa_cli import plugins
from hjepa_cli.compute.executors import (
    MAX_WORKERS,
    broken_pool_reported,
    cores,
    open_cluster,
    placement,
    prepare_worker,
    semaphores,
    spawning,
    worker_pool,
)
from hjepa_cli.config.schema import Settings
from hjepa_cli.core.control.loop import Outcome
from hjepa_cli.core.evaluation.simulator import Block, Runner, Simulator, Tick, silent
from hjepa_cli.core.networks.model import Model
from hjepa_cli.errors import DataError

TICK_S = 0.2  # between looks at the workers' progress
WORTH_WORKERS = 50_000  # device-steps of a unit; below, processes cost more than they bring
SIMULATORS = 16  # that a worker keeps: one per model

J = TypeVar("J")
R = TypeVar("R")


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """Says which checkpoint workers load: where it is, and its digest when the command read it.

    ``loaded`` is the model, in the process that has loaded it; it is not sent.
    """

    path: Path
    digest: str
    loaded: Model | None = dataclasses.field(default=None, compare=False, repr=False)

    def __reduce__(self) -> tuple[type["ModelFile"], tuple[Path, str]]:
        return ModelFile, (self.path, self.digest)

    def load(self, device: str) -> Model:
        """Return the model. Raise DataError if the file has changed since."""
        if self.loaded is not None:
            return self.loaded
        model = Model.load(self.path, device)
        if model.digest != self.digest:
            raise DataError(
                f"{self.path} is another model here than the command was given",
                hint="let the training that writes it end; workers must see the same files",
            )
        return model


class Unit(Protocol):
    """Describes work to be done, as plain data."""

    def compute(self, simulator: Any, tick: Tick, /) -> Any:
        """Compute it where the simulator is made."""
        ...


Make = Callable[[Settings, Model | None], Any]
"""Makes a simulator: a class of a module, which other processes find by its name."""
_Call = tuple["Future[Any]", Make, Settings, ModelFile | None, Unit]


class Workers:
    """Computes units wherever the executor does; several threads may ask for some.

    Args:
        executor: of worker processes or a cluster, whose workers see the models' files under the
            same paths.
        count: how many units are computed at once.
        counter: how many device-steps the workers say they have done; ``None`` counts those of
            finished units.
    """

    def __init__(
        self, executor: Executor, count: int, counter: Callable[[], int] | None = None
    ) -> None:
        self.count = count
        self._finished = self._reported = 0
        self._executor, self._counter = executor, counter or (lambda: self._finished)
        self._lock, self._closed = threading.Lock(), False
        self._urgent, self._waiting = deque[_Call](), deque[_Call]()
        self._running, self._thread = list[Future[Any]](), threading.local()

    def submit(
        self,
        make: Make,
        settings: Settings,
        model: ModelFile | None,
        unit: Unit,
        tick: Tick = silent,
    ) -> "Future[Any]":
        """Start a unit; :meth:`results` waits for it."""
        future = Future[Any]()
        future.add_done_callback(self._count)
        with self._lock:
            if self._closed:
                raise CancelledError
            queue = self._urgent if getattr(self._thread, "urgent", False) else self._waiting
            queue.append((future, make, settings, model, unit))
            self._hand_out()
        return future

    def results(self, futures: Sequence["Future[Any]"], tick: Tick = silent) -> list[Any]:
        """Wait for units, and tell ``tick`` the device-steps that nobody has been told before.

        Raises:
            NumericalError: a worker died (out of memory, killed); errors inside a unit are raised
                as they are.
        """
        waiting = set(futures)
        while waiting:
            waiting = wait(waiting, TICK_S).not_done
            with self._lock:
                if self._closed:
                    raise CancelledError
                now = self._counter()
                tick(now - self._reported)
                self._reported = now
                self._hand_out()
        with broken_pool_reported():
            return [future.result()[0] for future in futures]

    def runner(self, settings: Settings, model: ModelFile | None) -> Runner:
        """Return a runner of blocks over the workers."""

        def start(blocks: Sequence[Block], tick: Tick) -> Callable[[], list[Outcome]]:
            futures = [self.submit(Simulator, settings, model, block, tick) for block in blocks]
            return lambda: self.results(futures, tick)

        return start

    def each(
        self, drive: Callable[[J], R], jobs: Iterable[J]
    ) -> Generator[tuple[J, R], None, None]:
        """Drive about four times as many jobs at a time as there are workers, a thread for each.

        A job is a search that asks for units step by step: while one waits for the only one that it
        can ask for, the units of others are computed. Those of the first job come before all
        others: it is to be the longest, for which all would wait at the end. Yields jobs and their
        results as they are ready. The first error ends it; of what is ready by then nothing is
        lost.
        """
        left, flying = iter(jobs), dict[Future[R], J]()
        urgent = True
        while True:
            for job in itertools.islice(left, max(4 * self.count + 1 - len(flying), 0)):
                flying[_in_thread(functools.partial(self._drive, drive, urgent), job)] = job
                urgent = False
            if not flying:
                return
            done, _ = wait(flying, return_when=FIRST_COMPLETED)
            ready = [future for future in flying if future in done]
            for future in sorted(ready, key=lambda future: future.exception() is not None):
                yield flying.pop(future), future.result()

    def close(self) -> None:
        """Let no thread start anything more, nor show progress."""
        with self._lock:
            self._closed = True

    def _drive(self, drive: Callable[[J], R], urgent: bool, job: J) -> R:
        """Drive a job in its thread, which says of its units whether they are urgent."""
        self._thread.urgent = urgent
        return drive(job)

    def _hand_out(self) -> None:
        """Give the executor as many units as there are workers, and one to go on with at once.

        Those who ask for units and wait for them do this, not what is called back when one is
        done: a pool that breaks calls back while it lets nobody submit.
        """
        self._running = [one for one in self._running if not one.done()]
        while len(self._running) <= self.count and (self._urgent or self._waiting):
            future, make, settings, model, unit = (self._urgent or self._waiting).popleft()
            try:
                running = self._executor.submit(compute, make, settings, model, unit)
            except Exception as error:
                future.set_exception(error)
                continue
            self._running.append(running)
            running.add_done_callback(functools.partial(_pass_on, future))

    def _count(self, future: "Future[Any]") -> None:
        if not future.cancelled() and future.exception() is None:
            self._finished += future.result()[1]


class ThisProcess(Workers):
    """Computes units as they are submitted, as a worker would."""

    def __init__(self) -> None:
        self.count = 0
        self._made: dict[Hashable, Any] = {}

    def submit(
        self,
        make: Make,
        settings: Settings,
        model: ModelFile | None,
        unit: Unit,
        tick: Tick = silent,
    ) -> "Future[Any]":
        """Compute a unit; errors inside it are raised as they are."""
        future, key, threads = Future[Any](), (make, settings, model), torch.get_num_threads()
        torch.set_num_threads(1)  # as in workers, so that sums have one order
        try:
            if key not in self._made:
                self._made[key] = make(settings, _loaded(settings, model))
            future.set_result(unit.compute(self._made[key], tick))
        finally:
            torch.set_num_threads(threads)
        return future

    def results(self, futures: Sequence["Future[Any]"], tick: Tick = silent) -> list[Any]:
        """Return the results of units; the ticks were told while they were computed."""
        return [future.result() for future in futures]

    def each(
        self, drive: Callable[[J], R], jobs: Iterable[J]
    ) -> Generator[tuple[J, R], None, None]:
        """Drive the jobs one after the other."""
        return ((job, drive(job)) for job in jobs)


@contextmanager
def open_workers(unit_steps: int) -> Iterator[Workers]:
    """Yield the workers of the :func:`~hjepa_cli.compute.executors.placement`.

    Args:
        unit_steps: device-steps of a usual unit: where the user did not say, there is a process
            per core if that is worth it, and otherwise this one alone.

    Raises:
        UsageError: no scheduler answers.
    """
    where, count = placement(), min(cores(), MAX_WORKERS)
    if where.workers is not None:
        count = where.workers
    elif where.cluster is None and (count == 1 or unit_steps < WORTH_WORKERS):
        count = 0
    if where.cluster is not None:
        with open_cluster(where.cluster, count or cores()) as (executor, threads):
            with closing(Workers(executor, threads)) as workers:
                yield workers
    elif count:
        with spawning(), semaphores():  # its lock starts a process that keeps track of it
            done: Synchronized[int] = multiprocessing.get_context("spawn").Value("q", 0)
        counter = done.get_obj()
        with worker_pool(count, _start, done) as pool:
            # Read without the lock: a worker that is killed holding it would never give it back.
            with closing(Workers(pool, count, lambda: counter.value)) as workers:
                yield workers
    else:
        yield ThisProcess()


def _pass_on(future: "Future[Any]", running: "Future[Any]") -> None:
    """Give a unit's outcome to who waits for it."""
    try:
        future.set_result(running.result())
    except BaseException as error:  # cancelled, too: of a cluster that has gone
        future.set_exception(error)


def _in_thread(drive: Callable[[J], R], job: J) -> "Future[R]":
    """Start a thread that does not keep the program from ending."""
    future: Future[R] = Future()

    def run() -> None:
        try:
            future.set_result(drive(job))
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future


# What a worker process keeps between units.
_done: "Synchronized[int] | None" = None
_one_at_a_time = threading.Lock()  # a Dask worker may have threads; a simulator is for one


def _start(done: "Synchronized[int]") -> None:
    global _done
    prepare_worker()
    _done = done


def compute(make: Make, settings: Settings, model: ModelFile | None, unit: Unit) -> tuple[Any, int]:
    """Compute one unit in a worker, in one thread; return it and its device-steps."""
    steps = 0

    def tick(count: int) -> None:
        nonlocal steps
        steps += count
        if _done is not None:
            with _done.get_lock():
                _done.value += count

    with _one_at_a_time:
        torch.set_num_threads(1)
        return unit.compute(_made(make, settings, model, plugins.in_force()), tick), steps


@functools.lru_cache(maxsize=SIMULATORS)
def _made(
    make: Make, settings: Settings, model: ModelFile | None, loaded: tuple[plugins.Source, ...]
) -> Any:
    # The workers of a cluster outlive commands: digests tell a model from one trained since, and a
    # plugin from what it was before.
    return make(settings, _loaded(settings, model))


def _loaded(settings: Settings, model: ModelFile | None) -> Model | None:
    return model.load(settings.device) if model else None
