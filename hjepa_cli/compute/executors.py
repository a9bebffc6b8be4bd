"""Parallel work runs in this process, in worker processes, or on a Dask cluster.

All three are a :class:`concurrent.futures.Executor`. What is submitted is plain data, decided by
settings, seed and index alone, so that results do not depend on where or in which order it runs and
may be computed twice after a failure.
"""

import dataclasses
import functools
import importlib.util
import json
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from hjepa_cli import plugins
from hjepa_cli.compute.interrupts import SIGNALS
from hjepa_cli.compute.versions import NUMBERS_FROM, versions
from hjepa_cli.errors import ClusterLost, HjepaError, NumericalError, UsageError

MAX_WORKERS = 8  # of some 400 MB each
IN_FLIGHT = 4  # units submitted per worker: enough to keep it busy, few enough to stop soon
LOCAL = "local"
RETRIES = 3  # of a unit whose Dask worker died
CONNECT_S = 10
LONGEST_GREETING = 2**20  # bytes of the first message of a Dask scheduler

T = TypeVar("T")
R = TypeVar("R")


@dataclasses.dataclass(frozen=True)
class Placement:
    """It says where the user wants parallel work."""

    workers: int | None = None  # processes; 0 is this one, None leaves it to the stage
    cluster: str | None = None  # a Dask scheduler's address, its JSON file, or "local"


_placement = ContextVar("placement", default=Placement())  # noqa: B039 (it is frozen)
placement = _placement.get


@contextmanager
def placed(workers: int | None = None, cluster: str | None = None) -> Iterator[None]:
    """Place all parallel work inside the ``with`` block.

    Raises:
        UsageError: a cluster without Dask installed, that cannot be one, or beside no workers.
    """
    if cluster is not None and importlib.util.find_spec("distributed") is None:
        raise UsageError(
            "--cluster needs Dask, which is not installed", hint='pip install "hjepa[cluster]"'
        )
    if cluster not in (None, LOCAL):
        scheduler_address(cluster)  # now, and not when all that is cached has been told
    if cluster is not None and workers == 0:
        raise UsageError(f"--workers 0 is this process alone, --cluster {cluster} is elsewhere")
    token = _placement.set(Placement(workers, cluster))
    try:
        yield
    finally:
        _placement.reset(token)


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


class InProcess(Executor):
    """It runs each unit as it is submitted, in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def open_executor(workers: int) -> Iterator[tuple[Executor, int]]:
    """Open the executor of the :func:`placement`; also yield how many workers it has.

    Without a word of the user it has ``workers`` processes; 0 is this one.

    Raises:
        UsageError: no scheduler answers.
    """
    where = placement()
    count = workers if where.workers is None else where.workers
    if where.cluster is not None:
        with open_cluster(where.cluster, count or cores()) as cluster:
            yield cluster
    elif count == 0:
        yield InProcess(), 1
    else:
        with worker_pool(count, prepare_worker) as pool:
            yield pool, count


def finished(
    executor: Executor, workers: int, function: Callable[[T], R], units: Sequence[T]
) -> Iterator[R]:
    """Yield results of ``function`` over ``units``, in the order in which they are ready.

    Only some are in flight at a time, so a million units take no memory and an interruption
    does not wait for them.

    Raises:
        NumericalError: a worker died for good; errors of a unit are raised as they are.
    """
    left, flying = iter(units), set[Future[R]]()
    with broken_pool_reported():
        while True:
            for unit in left:
                flying.add(executor.submit(function, unit))
                if len(flying) >= IN_FLIGHT * workers or isinstance(executor, InProcess):
                    break
            if not flying:
                return
            done, flying = wait(flying, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()


@contextmanager
def broken_pool_reported() -> Iterator[None]:
    """Turn the death of a worker into one line."""
    try:
        yield
    except Exception as error:
        # Dask raises KilledWorker after all retries.
        if isinstance(error, BrokenProcessPool) or type(error).__name__ == "KilledWorker":
            raise NumericalError(
                "a worker process died (out of memory?)",
                hint="free some memory, then run the same command again",
            ) from None
        raise


@contextmanager
def worker_pool(
    count: int, initializer: Callable[..., None], *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """Open a pool of spawned processes that end at once when the ``with`` block fails.

    Spawned, not forked: torch's threads do not survive a fork.
    """
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())  # of the program that calls us
    begin = plugins.in_force(), initializer, *arguments
    with spawning():
        with semaphores():
            pool = ProcessPoolExecutor(count, context, initializer=with_plugins, initargs=begin)
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def semaphores() -> Iterator[None]:
    """Say what to do where the system has no POSIX semaphores, which processes need to share.

    Raises:
        NumericalError: it has none, or no place for them.
    """
    try:
        yield
    except (OSError, ImportError, NotImplementedError) as error:
        raise NumericalError(
            f"no worker processes: this system gives no semaphores ({error})",
            hint="run it with --workers 0; results are the same",
        ) from None


def with_plugins(
    sources: Sequence[plugins.Source], function: Callable[..., R], *arguments: Any, **named: Any
) -> R:
    """Call a function in a worker that has the plugins in force where it is wanted."""
    plugins.ensure(sources)
    return function(*arguments, **named)


class WithPlugins(Executor):
    """Its workers, whenever they join, have the plugins that are in force here."""

    def __init__(self, executor: Executor) -> None:
        self._submit = functools.partial(executor.submit, with_plugins, plugins.in_force())

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        return self._submit(fn, *args, **kwargs)


@contextmanager
def open_cluster(where: str, workers: int) -> Iterator[tuple[Executor, int]]:
    """Open a Dask cluster as an executor, ``local`` a new one; also yield how many threads it has.

    Workers of other machines must have the same version installed and see the same files.

    Raises:
        UsageError: no scheduler answers, it has no workers, or they would compute something else.
        ClusterLost: it ends before the ``with`` block.
    """
    import distributed

    dask: Any = distributed  # it has no types
    address: Any  # or the local cluster itself
    for name in ("distributed", "distributed.client"):  # a lost worker is no news here
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with spawning():
        if where == LOCAL:
            with signals_blocked(), semaphores():
                address = dask.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",  # None is port 8787, one per machine
                    silence_logs=logging.CRITICAL,
                )
        else:
            address = scheduler_address(where)
        try:
            if where != LOCAL:
                check_answer(address)
            client = dask.Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError, AssertionError) as error:
            raise UsageError(
                f"--cluster {where}: no Dask scheduler answers ({error or 'timeout'})",
                hint=f"hjepa ... --cluster {LOCAL}, or start one: dask scheduler",
            ) from None
        try:
            check_cluster(client, where)
            threads = sum(client.nthreads().values())
            executor = client.get_executor(retries=RETRIES, pure=False)
            yield WithPlugins(executor) if plugins.in_force() else executor, max(threads, 1)
        except HjepaError:
            raise
        except Exception:
            if client.status == "running":
                raise
            raise ClusterLost(
                f"--cluster {where}: the scheduler has gone; what is finished is kept",
                hint="start it and its workers, then run the same command again",
            ) from None
        finally:
            client.close()
            if where == LOCAL:
                with suppress(TimeoutError):  # the work is done; they end with us
                    address.close()


def scheduler_address(where: str) -> str:
    """Return the address of a scheduler, from its JSON file where ``where`` is one.

    Raises:
        UsageError: it is neither, or the file is none that a scheduler writes.
    """
    if not Path(where).exists():
        if ":" not in where:
            raise UsageError(
                f"--cluster {where}: no such file; expected local, HOST:PORT of a Dask scheduler, "
                "or its JSON file",
                hint="dask scheduler --scheduler-file scheduler.json",
            )
        return where
    try:
        found = json.loads(plugins.read_regular(Path(where)))
        address = found["address"]
        if not isinstance(address, str):
            raise TypeError("its address is no text")
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise UsageError(
            f"--cluster {where}: not the file of a Dask scheduler: {error or type(error).__name__}",
            hint=f"dask scheduler --scheduler-file {where} writes one",
        ) from None
    return address


def check_answer(address: str) -> None:
    """Raise OSError unless who listens there begins as Dask does: it waits for others for good."""
    scheme, sign, place = address.rpartition("://")
    host, _, port = place.rpartition(":")
    if (sign and scheme != "tcp") or not port.isdecimal():
        return  # Dask says what is wrong with it
    import asyncio  # it takes a while, and few commands have a cluster

    with ThreadPoolExecutor(1) as beside:  # here a loop of the caller's may run, as in a notebook
        begun = beside.submit(asyncio.run, _greeting(host.strip("[]"), int(port))).result()
    if begun is not None and not 0 < int.from_bytes(begun, "little") < LONGEST_GREETING:
        raise OSError("what listens there is something else")


async def _greeting(host: str, port: int) -> bytes | None:
    """Return the first 8 bytes that are said there, empty without; ``None`` where nobody is."""
    import asyncio

    try:
        async with asyncio.timeout(CONNECT_S):
            heard, there = await asyncio.open_connection(host, port)
    except (OSError, TimeoutError):
        return None  # Dask says so
    try:
        async with asyncio.timeout(CONNECT_S):
            return await heard.readexactly(8)
    except (OSError, TimeoutError, asyncio.IncompleteReadError):
        return b""
    finally:
        there.close()


def check_cluster(client: Any, where: str) -> None:
    """Raise UsageError without workers, or with one of other versions, so of other numbers."""
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        raise UsageError(
            f"--cluster {where}: the scheduler has no workers",
            hint="dask worker --nthreads 1 with the scheduler's address or --scheduler-file FILE",
        ) from None
    here = versions(NUMBERS_FROM)
    try:
        found: dict[str, dict[str, str]] = client.run(versions, NUMBERS_FROM)
    except Exception as error:  # whatever unpickling there raises
        raise UsageError(
            f"--cluster {where}: a worker cannot import hjepa: {error}",
            hint=f"pip install hjepa=={here['hjepa']} where workers and scheduler run",
        ) from None
    for worker, there in found.items():
        differing = [name for name in here if there.get(name) != here[name]]
        if differing:
            shown = ", ".join(f"{name} {there.get(name)}, not {here[name]}" for name in differing)
            raise UsageError(
                f"--cluster {where}: worker {worker} has {shown}",
                hint="install the same versions everywhere: pip freeze tells those that are here",
            )


@contextmanager
def spawning() -> Iterator[None]:
    """Keep spawned processes from the user's script and from modules of the current directory.

    They would import the script, which needs a ``__main__`` guard there and fails for standard
    input; and as they begin with ``python -c``, a ``pickle.py`` of the directory they are in.
    """
    main = sys.modules["__main__"].__dict__
    kept = {name: main[name] for name in ("__spec__", "__file__") if name in main}
    main.pop("__file__", None)
    main["__spec__"] = None
    safe, os.environ["PYTHONSAFEPATH"] = os.environ.get("PYTHONSAFEPATH"), "1"
    try:
        yield
    finally:
        main.update(kept)
        del os.environ["PYTHONSAFEPATH"]
        os.environ |= {} if safe is None else {"PYTHONSAFEPATH": safe}


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Keep Ctrl-C and SIGTERM from threads and processes that are started here, for good.

    They inherit the mask; in this thread a signal waits until the ``with`` block ends.
    """
    resource_tracker.ensure_running()  # its start would unblock them in the thread it happens in
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def prepare_worker() -> None:
    """Leave Ctrl-C and SIGTERM, which reach the whole group, to the parent; end with it."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def end() -> None:
        parent.join()
        os._exit(1)

    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=end, daemon=True).start()
