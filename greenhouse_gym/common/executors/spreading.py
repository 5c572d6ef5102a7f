"""Spread independent pieces of work over any executor of `concurrent.futures`.

What travels to the workers are paths, seeds and names, and what comes back are values; the caller, the head, writes
the files, but for trainings, each of which writes its own folder (`greenhouse_gym.learning.sweep`). Without an
executor the same work is done here, one piece after the other, with the same results.
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
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from greenhouse_gym.errors import GreenhouseError, InvalidValueError

Item = TypeVar("Item")
Result = TypeVar("Result")

_WAITING = (
    2  # pieces that are handed out per worker, the one at work included: so none runs dry, and few have to be canceled
)


class WorkerLostError(GreenhouseError, RuntimeError):
    """A process that did a part of the work died, or was shut down; what was done before is unharmed."""


def completed(
    function: Callable[[Item], Result], items: Iterable[Item], executor: Executor | None = None
) -> Iterator[Result]:
    """The results of a function of each item, as they are finished: in any order, unless there is no executor.

    Items are taken as workers get free, so there may be any number of them. What has not begun when the caller stops
    asking, is interrupted or gets an error, is canceled.

    Args:
        function: What is to be done. With an executor it is a function of a module; what it takes and gives can be
            pickled.
        items: What it is done to. A function whose results must be told apart gives back which item they are of.
        executor: Where it is done; None does it here, each piece when it is asked for.

    Raises:
        InvalidValueError: The executor was shut down before.
        WorkerLostError: A worker died on the way.
        Exception: What the function raised, for the first item that failed.
    """
    if executor is None:
        yield from map(function, items)
        return
    rest, most = iter(items), _WAITING * workers_of(executor)
    running: set[Future[Result]] = set()
    try:
        while True:
            for item in islice(rest, most - len(running)):
                running.add(_submitted(executor, function, item))
            if not running:
                return
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield _result(future)
    finally:
        for future in running:
            future.cancel()


def require_portable(executor: Executor | None, what: str, thing: object) -> None:
    """Raise an error unless a thing can travel to an executor's workers.

    Args:
        executor: The executor; threads and None ask for nothing.
        what: What to call the thing.
        thing: What is to travel.

    Raises:
        InvalidValueError: It cannot be pickled.
    """
    if executor is None or isinstance(executor, ThreadPoolExecutor):
        return
    try:
        pickle.dumps(thing)
    except Exception as error:  # whatever a part of it raises
        raise InvalidValueError(f"{what} cannot be sent to another process ({error}); work without executor") from error


def workers_of(executor: Executor) -> int:
    """How many pieces an executor works on at a time, as far as it says; else one per core of this machine."""
    return int(getattr(executor, "_max_workers", 0)) or usable_cores()


def usable_cores() -> int:
    """Cores this process may use, where the system tells; all of them elsewhere."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _submitted(executor: Executor, function: Callable[[Item], Result], item: Item) -> Future[Result]:
    try:
        return executor.submit(function, item)
    except BrokenExecutor as error:
        raise _lost(error) from error
    except RuntimeError as error:
        raise InvalidValueError(f"expected an executor that is at work, but: {error}") from error


def _result(future: Future[Result]) -> Result:
    try:
        return future.result()
    except (BrokenExecutor, CancelledError) as error:
        raise _lost(error) from error


def _lost(error: BaseException) -> WorkerLostError:
    return WorkerLostError(
        "a process that did a part of the work ended before it was done: killed, out of memory, crashed, or begun by a "
        f"script without 'if __name__ == \"__main__\":' ({str(error) or type(error).__name__})"
    )


@contextmanager
def processes(count: int | None = None) -> Iterator[ProcessPoolExecutor]:
    """A pool of fresh processes on this machine for the time of a ``with`` block.

    They end with the block; at once if it ends by an error or an interruption, and also if the caller is killed. A
    script that uses it keeps its own commands below ``if __name__ == "__main__":``, for each process imports it.

    Args:
        count: Number of processes; None for one per core.

    Yields:
        The executor.

    Raises:
        InvalidValueError: The count is not a whole number from 1 up.
    """
    count = usable_cores() if count is None else count
    if isinstance(count, bool) or not isinstance(count, int) or count < 1:
        raise InvalidValueError(f"the number of processes must be a whole number from 1 up, got {count!r}")
    context = get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    with theirs, ours, ProcessPoolExecutor(count, context, _begin, (theirs,)) as executor:
        try:
            yield executor
        except BaseException:
            ours.close()
            executor.shutdown(cancel_futures=True)
            raise


def _begin(lifeline: Connection[Any, Any]) -> None:
    """Tie this process to the other end of a connection that its caller holds, and leave Ctrl-C to the caller."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(lifeline,), name="lifeline", daemon=True).start()


def _end_with(lifeline: Connection[Any, Any]) -> None:
    try:
        lifeline.recv_bytes()  # nothing is ever sent
    except (EOFError, OSError):
        os._exit(1)
