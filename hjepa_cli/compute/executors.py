"""Where parallel work runs: in this process, in worker processes, or on a Dask cluster.

All three are a :class:`concurrent.futures.Executor`. What is submitted is plain data, decided by
settings, seed and index alone, so that results do not depend on where or in which order it runs and
may be computed twice after a failure.
"""

import dataclasses
import importlib.metadata
import importlib.util
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

from hjepa_cli import __version__
from hjepa_cli.compute.interrupts import SIGNALS
from hjepa_cli.errors import ClusterLost, HjepaError, NumericalError, UsageError

MAX_WORKERS = 8  # of some 400 MB each
IN_FLIGHT = 4  # units submitted per worker: enough to keep it busy, few enough to stop soon
LOCAL = "local"
RETRIES = 3  # of a unit whose Dask worker died
CONNECT_S = 10
NUMBERS_FROM = ("numpy", "pymunk", "scipy", "torch")  # another version, other last digits

T = TypeVar("T")
R = TypeVar("R")


@dataclasses.dataclass(frozen=True)
class Placement:
    """Where the user wants parallel work.

    Attributes:
        workers: processes; 0 is this one, ``None`` leaves it to the stage.
        cluster: a Dask scheduler's address, its JSON file, or ``local``.
    """

    workers: int | None = None
    cluster: str | None = None


_placement: ContextVar[Placement | None] = ContextVar("placement", default=None)


def placement() -> Placement:
    """What :func:`placed` set around the caller."""
    return _placement.get() or Placement()


@contextmanager
def placed(workers: int | None = None, cluster: str | None = None) -> Iterator[None]:
    """Place all parallel work inside the ``with`` block.

    Raises:
        UsageError: a cluster without Dask installed.
    """
    if cluster is not None and importlib.util.find_spec("distributed") is None:
        raise UsageError(
            "--cluster needs Dask, which is not installed", hint='pip install "hjepa[cluster]"'
        )
    token = _placement.set(Placement(workers, cluster))
    try:
        yield
    finally:
        _placement.reset(token)


def cores() -> int:
    """Cores this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class InProcess(Executor):
    """Runs each unit as it is submitted, in the caller's thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def open_executor(workers: int) -> Iterator[tuple[Executor, int]]:
    """The executor of the :func:`placement`, and how many workers it has.

    Args:
        workers: processes where the user did not say; 0 is this one.

    Raises:
        UsageError: no scheduler answers.
    """
    where = placement()
    count = workers if where.workers is None else where.workers
    if where.cluster is not None:
        with open_cluster(where.cluster, count or cores()) as opened:
            yield opened
    elif count == 0:
        yield InProcess(), 1
    else:
        with worker_pool(count, prepare_worker) as pool:
            yield pool, count


def finished(
    executor: Executor, workers: int, function: Callable[[T], R], units: Sequence[T]
) -> Iterator[R]:
    """Results of ``function`` over ``units``, in the order in which they are ready.

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
    except BrokenProcessPool:
        raise _worker_died() from None
    except Exception as error:
        if type(error).__name__ == "KilledWorker":  # Dask's, after all retries
            raise _worker_died() from None
        raise


def _worker_died() -> NumericalError:
    return NumericalError(
        "a worker process died (out of memory?)",
        hint="free some memory, then run the same command again",
    )


@contextmanager
def worker_pool(
    count: int, initializer: Callable[..., None], *arguments: Any
) -> Iterator[ProcessPoolExecutor]:
    """Spawned processes, ended at once when the ``with`` block fails.

    Spawned, not forked: torch's threads do not survive a fork.
    """
    context = multiprocessing.get_context("spawn")
    others = set(multiprocessing.active_children())  # of the program that calls us
    pool = ProcessPoolExecutor(count, context, initializer=initializer, initargs=arguments)
    with anonymous_main():
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - others:
                process.kill()
            raise
        finally:
            pool.shutdown(cancel_futures=True)


@contextmanager
def open_cluster(where: str, workers: int) -> Iterator[tuple[Executor, int]]:
    """A Dask cluster as an executor, and how many threads it has; ``local`` starts one.

    Workers of other machines must have the same version installed and see the same files.

    Raises:
        UsageError: no scheduler answers at ``where``, it has no workers, or they would compute
            something else.
        ClusterLost: it ends before the ``with`` block.
    """
    import distributed

    dask: Any = distributed  # it has no types
    for name in ("distributed", "distributed.client"):  # a lost worker is no news here
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with anonymous_main():
        if where == LOCAL:
            with signals_blocked():
                local = dask.LocalCluster(
                    n_workers=workers,
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",  # None is port 8787, one per machine
                    silence_logs=logging.CRITICAL,
                )
            target: dict[str, Any] = {"address": local}
        else:
            target = {"scheduler_file": where} if Path(where).is_file() else {"address": where}
        try:
            client = dask.Client(**target, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TypeError) as error:
            raise UsageError(
                f"--cluster {where}: no Dask scheduler answers ({error or 'timeout'})",
                hint=f"hjepa ... --cluster {LOCAL}, or start one: dask scheduler",
            ) from None
        try:
            check_cluster(client, where)
            threads = sum(client.nthreads().values())
            yield client.get_executor(retries=RETRIES, pure=False), max(threads, 1)
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
                    target["address"].close()


def versions() -> dict[str, str]:
    """What the numbers of this process depend on."""
    return {"hjepa": __version__} | {
        name: importlib.metadata.version(name) for name in NUMBERS_FROM
    }


def check_cluster(client: Any, where: str) -> None:
    """Demand workers, and of every one the versions that are here: others give other numbers.

    Raises:
        UsageError: naming what is missing or differs.
    """
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except TimeoutError:
        raise UsageError(
            f"--cluster {where}: the scheduler has no workers",
            hint="dask worker --nthreads 1 with the scheduler's address or --scheduler-file FILE",
        ) from None
    here = versions()
    try:
        found: dict[str, dict[str, str]] = client.run(versions)
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
def anonymous_main() -> Iterator[None]:
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
    """Ctrl-C and SIGTERM, which reach the whole group, are the parent's; a worker ends with it."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
