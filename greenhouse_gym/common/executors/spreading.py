"""Spread independent tasks over any executor of `concurrent.futures`.

Paths, seeds and names travel to the workers, values come back, and the caller writes the files. Trainings are the
exception: each writes its own folder (`greenhouse_gym.learning.ppo_sweep`). Without an executor the same tasks run
here, one after the other, with the same results.
"""

from __future__ import annotations

import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from numbers import Integral
from typing import Any, TypeVar

from greenhouse_gym.errors import GreenhouseError, InvalidValueError, require_choice

Item = TypeVar("Item")
Result = TypeVar("Result")

_TASKS_PER_WORKER = 2  # scheduled at a time, the running one included: no worker idles, and few tasks need canceling

BACKENDS = ("serial", "processes", "ray")
"""Names of the backends: this process, processes of this machine, or a Ray cluster."""


class WorkerLostError(GreenhouseError, RuntimeError):
    """A worker process died or was shut down; finished work is unharmed."""


def completed(
    function: Callable[[Item], Result], items: Iterable[Item], executor: Executor | None = None
) -> Iterator[Result]:
    """Yield the results of a function for each item as they finish: in any order, unless there is no executor.

    Items are taken as workers become free, so that there may be any number of them. Tasks that have not started are
    canceled when the caller stops iterating, is interrupted or receives an error.

    Args:
        function: Function to call. With an executor it must belong to a module, and its arguments and results must be
            picklable.
        items: Arguments, one per call. Where results must be matched with items, the function returns the item too.
        executor: Executor that runs the calls; None runs them here, each when its result is requested.

    Raises:
        InvalidValueError: The executor was already shut down.
        WorkerLostError: A worker died.
        Exception: The error of the function for the first item that failed.
    """
    if executor is None:
        yield from map(function, items)
        return
    rest, limit = iter(items), _TASKS_PER_WORKER * workers_of(executor)
    running: set[Future[Result]] = set()
    try:
        while True:
            for item in islice(rest, limit - len(running)):
                running.add(_submitted(executor, function, item))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in sorted(done, key=_failed):  # what was finished is not lost with a worker
                yield _result(future)
    finally:
        for future in running:
            future.cancel()


def portable(executor: Executor | None, what: str, thing: object) -> bytes:
    """Return an object as an executor's workers can unpickle it; nothing for threads and None, which need no pickling.

    Args:
        executor: The executor.
        what: Name of the object in the message.
        thing: The object.

    Raises:
        InvalidValueError: The object cannot be pickled.
    """
    if executor is None or isinstance(executor, ThreadPoolExecutor):
        return b""
    try:
        return bytes(getattr(executor, "dumps", pickle.dumps)(thing))
    except Exception as error:  # any part of the object may raise anything
        raise InvalidValueError(f"{what} cannot be pickled ({error}); work without executor") from error


def workers_of(executor: Executor) -> int:
    """Return the number of an executor's workers where it is known, else the number of usable cores."""
    return int(getattr(executor, "_max_workers", 0)) or usable_cores()


def usable_cores() -> int:
    """Return the number of cores that this process may use; all cores where the system does not say."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _submitted(executor: Executor, function: Callable[[Item], Result], item: Item) -> Future[Result]:
    try:
        return executor.submit(function, item)
    except BrokenExecutor as error:
        raise _lost(error) from error
    except RuntimeError as error:
        raise InvalidValueError(f"expected an open executor, but: {error}") from error


def _result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError) as error:
        raise _lost(error) from error


def _failed(future: Future[Any]) -> bool:
    return future.cancelled() or future.exception() is not None


def _lost(error: BaseException) -> WorkerLostError:
    return WorkerLostError(
        "a worker process ended before its task was done: killed, out of memory, crashed, hanging, or started by a "
        f"script without 'if __name__ == \"__main__\":' ({str(error) or type(error).__name__})"
    )


class _Processes(Executor):
    """Pool of processes that is replaced once it has lost one."""

    def __init__(self, count: int, lifeline: Connection[Any, Any]):
        self._max_workers = count
        self._make = partial(ProcessPoolExecutor, count, get_context("spawn"), _begin, (lifeline,))
        self._pool = self._make()

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """See `concurrent.futures.Executor.submit`."""
        try:
            return self._pool.submit(fn, *args, **kwargs)
        except BrokenExecutor:
            self._pool = self._make()
            return self._pool.submit(fn, *args, **kwargs)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """See `concurrent.futures.Executor.shutdown`."""
        self._pool.shutdown(wait, cancel_futures=cancel_futures)


@contextmanager
def processes(count: int | None = None) -> Iterator[Executor]:
    """Provide a pool of new processes on this machine for the duration of a ``with`` block.

    The processes end with the block: at once if it ends by an error or an interruption, and also if the caller is
    killed. If one dies, the work that was scheduled is lost, and later work gets new processes. Scripts that use it
    keep their commands below ``if __name__ == "__main__":``, since each process imports them.

    Args:
        count: Number of processes; None for one per core.

    Yields:
        The executor.

    Raises:
        InvalidValueError: The count is not a positive integer.
    """
    count = usable_cores() if count is None else count
    if isinstance(count, bool) or not isinstance(count, Integral) or count < 1:
        raise InvalidValueError(f"the number of processes must be a whole number from 1 up, got {count!r}")
    theirs, ours = get_context("spawn").Pipe(duplex=False)
    with theirs, ours, _Processes(int(count), theirs) as executor:
        try:
            yield executor
        except BaseException:
            ours.close()
            executor.shutdown(cancel_futures=True)
            raise


def _begin(lifeline: Connection[Any, Any]) -> None:
    """End this process when its caller closes the connection, and leave Ctrl-C to the caller."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()


def _end_with(lifeline: Connection[Any, Any]) -> None:
    try:
        lifeline.recv_bytes()  # nothing is ever sent
    except (EOFError, OSError):
        os._exit(1)


@contextmanager
def executor_for(backend: str, workers: int | None = None, address: str = "local") -> Iterator[Executor | None]:
    """Provide the executor of a backend for the duration of a ``with`` block.

    Args:
        backend: One of `BACKENDS`.
        workers: Processes on this machine; None for one per core. A cluster elsewhere has its own number.
        address: Address of the Ray cluster, as `RayExecutor` takes it.

    Yields:
        The executor; None for "serial".

    Raises:
        UnknownNameError: The backend does not exist.
    """
    require_choice("backend", backend, BACKENDS)
    if backend == "serial":
        yield None
    elif backend == "processes":
        with processes(workers) as pool:
            yield pool
    else:
        from greenhouse_gym.common.executors.ray_executor import RayExecutor

        with RayExecutor(address, workers=workers) as cluster:
            yield cluster


def idle_cores() -> int:
    """Return the number of idle cores, estimated from the load of the last minute where the system reports it."""
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return max(0, usable_cores() - round(busy))
