"""Caller's side of the OMPL process, which starts on first use, stays alive, and is replaced if it hangs or dies.

Nothing that happens in that process harms the caller. It is a fresh interpreter that does not run the caller's
``__main__``, so planning works from a script without a main guard, an interactive session or a notebook.
"""

from __future__ import annotations

import atexit
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Literal

import mujoco

from greenhouse_gym.errors import GreenhouseError, MissingDependencyError
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.parameters import Value

_BOOT = (
    "import json, os, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from greenhouse_gym.planning.ompl_worker import serve; serve(*map(int, sys.argv[2:])); "
    "os._exit(0)"  # OMPL 2 crashes when its objects are destroyed
)
MEMORY_LIMIT = 4 << 30
"""Bytes of data that a planning process may allocate."""

_START_LIMIT = 120.0  # seconds an interpreter may take to start and import OMPL on a busy machine

Outcome = Literal["solved", "approximate", "no_solution", "invalid"]


@dataclass(frozen=True, eq=False)
class PlannerQuery:
    """A query to a planner. Joint positions are radians, metres for slides.

    Attributes:
        model: The model to check collisions with, made by `planning_model`.
        reaches: (joints,) its `joint_reaches`.
        lower: (joints,) lower limits.
        upper: (joints,) upper limits.
        start: (joints,) start configuration.
        goals: (k, joints) goal configurations; the path may end at any of them.
        planner: Name of a planner.
        settings: Parameters of the planner that differ from its defaults.
        time_limit: Seconds; inf if only the checks limit the search.
        max_checks: Number of configurations that may be checked, or None.
        optimizing: True if the planner uses all its time; motions are then checked at `PROOF` from the start. Otherwise
            it stops at its first path, if it reports that it has one.
        seed: Seed of the planner's random numbers.
        gradual_goals: True if the compiled RRTConnect takes up the goals one by one, as OMPL's does.
    """

    model: mujoco.MjModel
    reaches: Array
    lower: Array
    upper: Array
    start: Array
    goals: Array
    planner: str
    settings: Mapping[str, Value]
    time_limit: float
    max_checks: int | None
    optimizing: bool
    seed: int
    gradual_goals: bool = False


@dataclass(frozen=True, eq=False)
class PlannerAnswer:
    """A planner's answer to a query.

    Attributes:
        status: "invalid" if the planner's path could not be proven free.
        path: (k, joints) the simplified path, or None.
        raw_path: (k, joints) the planner's own path, or None.
        planning_time: Seconds the planner took.
        simplification_time: Seconds for shortening the path and proving it free.
        checks: Number of configurations the planner checked.
        tree_size: Number of nodes in the planner's trees or roadmap; 0 if they are not counted.
        costs: (m, 2) seconds and length of the best path at that time, radians: the first one and each shorter one.
    """

    status: Outcome
    path: Array | None
    raw_path: Array | None
    planning_time: float
    simplification_time: float
    checks: int
    tree_size: int
    costs: Array


class WorkerCrashedError(GreenhouseError):
    """The planning process died during a query."""


class WorkerTimeoutError(GreenhouseError):
    """The planning process was killed because it did not answer in time."""


class WorkerFailedError(GreenhouseError):
    """The query raised an error in the planning process."""


class Worker:
    """A planning process. Several threads may use it; they take turns.

    Args:
        memory_limit: Bytes of data the process may allocate; a planner that needs more fails, and the caller lives on.
    """

    def __init__(self, memory_limit: int = MEMORY_LIMIT) -> None:
        self._memory_limit = memory_limit
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Connection[Any, Any] | None = None
        self._owner = 0

    @property
    def pid(self) -> int | None:
        """Process id, or None while no process runs."""
        return None if self._process is None else self._process.pid

    def call(self, command: str, argument: Any, hard_limit: float) -> Any:
        """Have the process execute a command.

        Args:
            command: One of the commands of `greenhouse_gym.planning.ompl_worker.serve`.
            argument: Argument of the command.
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
                except ConnectionError:  # it died before it read the message: start a new one
                    self._kill()
                    succeeded, result = self._exchange((command, argument, hard_limit))
            except BaseException:  # KeyboardInterrupt included: the answer to this query must not reach the next one
                self._kill()
                raise
            if not succeeded:
                self._kill()  # a fault such as lost memory must not fail the next query too
                raise WorkerFailedError(result)
        return result

    def close(self) -> None:
        """End the process if one runs; the next call starts another."""
        with self._lock:
            self._kill()

    def _connected(self) -> Connection[Any, Any]:
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
            self._process = _launch(handle, self._memory_limit)
        self._connection, self._owner = ours, os.getpid()
        succeeded, reply = self._receive(ours, _START_LIMIT)
        if not succeeded:
            raise WorkerCrashedError(f"the planning process cannot start: {reply}")
        return ours

    def _exchange(self, message: tuple[str, Any, float]) -> tuple[bool, Any]:
        connection = self._connected()
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


def _launch(handle: int, memory_limit: int) -> subprocess.Popen[bytes]:
    """Start a planning process in a thread that lives as long as the process.

    The process dies with the thread that started it (the only way on Linux to tie it to its caller), and the thread
    that plans first may end long before the caller does.
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
                start_new_session=True,  # Ctrl-C goes to the caller only
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
    """Return the process that `greenhouse_gym.planning.plan` uses."""
    return _WORKER
