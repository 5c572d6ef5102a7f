"""The caller's side of the OMPL process: started when first needed, kept warm, killed when it hangs, replaced.

Nothing that happens in that process harms the caller. It is started as a fresh interpreter that does not run the
caller's ``__main__``, so it works from a script without a guard, an interactive session or a notebook.
"""

from __future__ import annotations

import atexit
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from importlib.util import find_spec
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

from greenhouse_gym.errors import GreenhouseError, MissingDependencyError

_BOOT = (
    "import json, os, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from greenhouse_gym.planning.ompl_worker import serve; serve(*map(int, sys.argv[2:])); "
    "os._exit(0)"  # OMPL 2 dies when its objects are torn down
)
MEMORY_LIMIT = 4 << 30
"""Bytes of data a planning process may hold."""

_START_LIMIT = 120.0  # seconds an interpreter may take to start and import OMPL on a busy machine


class WorkerCrashedError(GreenhouseError):
    """The planning process died while it worked on a query."""


class WorkerTimeoutError(GreenhouseError):
    """The planning process did not answer in time and was killed."""


class WorkerFailedError(GreenhouseError):
    """The query raised an error in the planning process."""


class Worker:
    """One planning process; safe to use from several threads, which then take turns.

    Args:
        memory_limit: Bytes of data the process may hold; what wants more fails or dies, and the caller lives on.
    """

    def __init__(self, memory_limit: int = MEMORY_LIMIT) -> None:
        self._memory_limit = memory_limit
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection[Any, Any] | None = None
        self._owner = 0

    @property
    def pid(self) -> int | None:
        """The process id, or None while no process runs."""
        return None if self._process is None else self._process.pid

    def call(self, command: str, argument: Any, hard_limit: float) -> Any:
        """Have the process work on something.

        Args:
            command: One of the commands of `greenhouse_gym.planning.ompl_worker.serve`.
            argument: Goes with the command.
            hard_limit: Seconds after which the process is killed.

        Raises:
            WorkerTimeoutError: It took longer than the hard limit.
            WorkerCrashedError: The process died.
            WorkerFailedError: The command raised an error.
            MissingDependencyError: OMPL is not installed.
        """
        with self._lock:
            try:
                try:
                    succeeded, result = self._exchange((command, argument, hard_limit))
                except ConnectionError:  # it died before it read the message: a new process takes over
                    self._kill()
                    succeeded, result = self._exchange((command, argument, hard_limit))
            except BaseException:  # KeyboardInterrupt included: the answer to this query must not reach the next one
                self._kill()
                raise
            if not succeeded:
                self._kill()  # what is wrong with it, such as memory that it has lost, must not fail the next query too
                raise WorkerFailedError(result)
        return result

    def close(self) -> None:
        """End the process, if one runs; the next call starts another."""
        with self._lock:
            self._kill()

    def _started(self) -> Connection[Any, Any]:
        if self._connection is not None and self._owner != os.getpid():
            # this interpreter was forked: the process belongs to the parent
            self._process = self._connection = None
        if self._process is not None and self._process.poll() is not None:
            self._kill()
        if self._connection is not None:
            return self._connection
        if find_spec("ompl") is None:
            raise MissingDependencyError("ompl", "plan")
        ours, theirs = multiprocessing.Pipe()
        handle = theirs.fileno()
        with theirs:
            self._process = _launched(handle, self._memory_limit)
        self._connection, self._owner = ours, os.getpid()
        succeeded, reply = self._receive(ours, _START_LIMIT)
        if not succeeded:
            raise WorkerCrashedError(f"the planning process cannot start: {reply}")
        return ours

    def _exchange(self, message: tuple[str, Any, float]) -> tuple[bool, Any]:
        connection = self._started()
        connection.send(message)
        return self._receive(connection, message[2])

    def _receive(self, connection: Connection[Any, Any], limit: float) -> tuple[bool, Any]:
        if not connection.poll(limit):
            raise WorkerTimeoutError(f"the planning process did not answer within {limit:.1f} s and was killed")
        try:
            reply: tuple[bool, Any] = connection.recv()
        except EOFError as error:
            assert self._process is not None
            code = self._process.wait()
            how = f"signal {-code}" if code < 0 else f"exit status {code}"
            raise WorkerCrashedError(f"the planning process died with {how}") from error
        return reply

    def _kill(self) -> None:
        process, connection = self._process, self._connection
        self._process = self._connection = None
        if connection is not None:
            connection.close()
        if process is not None:
            process.kill()
            process.wait()


def _launched(handle: int, memory_limit: int) -> subprocess.Popen[bytes]:
    """A planning process, started by a thread that lives as long as the process.

    The process dies with the thread that started it (Linux knows no other way to tie it to its caller), and the thread
    that happens to plan first may end long before the caller does.
    """
    arguments = [json.dumps(sys.path), str(handle), str(memory_limit), str(os.getpid())]
    started: SimpleQueue[subprocess.Popen[bytes] | OSError] = SimpleQueue()

    def start_and_wait() -> None:
        try:
            process = subprocess.Popen(
                [sys.executable, "-c", _BOOT, *arguments],
                pass_fds=[handle],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for the caller
            )
        except OSError as error:
            started.put(error)
        else:
            started.put(process)
            process.wait()

    threading.Thread(target=start_and_wait, name="planning process", daemon=True).start()
    process = started.get()
    if isinstance(process, OSError):
        raise process
    return process


_WORKER = Worker()
atexit.register(_WORKER.close)


def shared_worker() -> Worker:
    """The process that `greenhouse_gym.planning.plan` uses."""
    return _WORKER
