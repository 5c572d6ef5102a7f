"""Executor that runs work on the cores of a Ray cluster, with the interface of `concurrent.futures`."""

from __future__ import annotations

import os
import pickle
import platform
import socket
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, Future, InvalidStateError, ThreadPoolExecutor, wait
from contextlib import suppress
from functools import partial
from importlib import import_module
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, TypeVar

from greenhouse_gym import __version__
from greenhouse_gym.common.executors.spreading import WorkerLostError
from greenhouse_gym.common.extras import needs
from greenhouse_gym.errors import GreenhouseError, InvalidValueError

Result = TypeVar("Result")

_TIMEOUT = 5.0  # seconds to wait for an answer from an address
_LOOK = 10.0  # seconds between two looks at the nodes
_LOOKS = 3  # in a row without a node for the tasks, after which they are given up
_GRACE = 1.0  # seconds in which a canceled task may end: Ray aborts this process if one ends while it is being stopped
_SETTINGS = b"\x04"  # the kind of frame that opens a connection of HTTP/2, which Ray's head speaks
_GREETING = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(3) + _SETTINGS + bytes(5)


class RayExecutor(Executor):
    """Executor on the cores of a Ray cluster; use it in a ``with`` block.

    Work travels by pickle, as with processes: functions must belong to modules that every node has, in the same
    version of this package. Each task starts in the caller's working folder where the node has that folder, so that
    relative paths keep their meaning. Tasks of a lost node are repeated on another. If none that is left has the cores
    or the memory for them, they end with a `WorkerLostError` after half a minute, instead of waiting forever.

    Args:
        address: "local" for the cores of this machine, "HOST:PORT" of a cluster's head, or "auto" for the cluster this
            machine belongs to. A process that has already joined a cluster stays in it.
        cpus: Cores per task.
        memory: Bytes per task; Ray starts only as many tasks as fit. With None, memory is not counted.
        retries: Number of times that a task is repeated after its node or process died.
        workers: Number of cores to use with "local"; None for all.

    Attributes:
        stranded: Reason why none of the nodes that are left can run a task; empty if one can.

    Raises:
        MissingDependencyError: Ray is not installed.
        InvalidValueError: No cluster answers at the address, it runs another version of Python or Ray, or none of its
            nodes has the cores or the memory that a task takes.
    """

    def __init__(
        self,
        address: str = "local",
        cpus: float = 1,
        memory: int | None = None,
        retries: int = 3,
        workers: int | None = None,
    ):
        with needs("cluster"):
            self.ray: Any = import_module("ray")
        self.cpus, self.memory, self.retries = cpus, memory, retries
        if address not in ("local", "auto"):
            _check_listens(address)
        self._owns = not self.ray.is_initialized()
        if self._owns:
            _join(self.ray, address, workers)
        elif address not in ("local", "auto"):
            raise InvalidValueError(f"this process is in a Ray cluster already: leave it before joining {address}")
        self._futures: set[_RayFuture[Any]] = set()
        self._stops = ThreadPoolExecutor(1, "stop tasks of a Ray cluster")
        self._open, self._closed, self.stranded = True, threading.Event(), ""
        try:
            _check_fits([node for node in self.ray.nodes() if node["Alive"]], cpus, memory)
        except InvalidValueError:
            self.shutdown()
            raise
        options = {"num_cpus": cpus, "max_retries": retries, "retry_exceptions": False}
        self._call = self.ray.remote(_call).options(**options, **({} if memory is None else {"memory": memory}))
        self._max_workers = max(1, int(self.ray.cluster_resources().get("CPU", 1) // cpus))
        threading.Thread(target=self._watch, name="watch over the nodes of a Ray cluster", daemon=True).start()

    def submit(self, fn: Callable[..., Result], /, *args: Any, **kwargs: Any) -> Future[Result]:
        """Schedule a call of a function of a module.

        Raises:
            RuntimeError: The executor was shut down.
        """
        if not self._open:
            raise RuntimeError("cannot schedule new futures after shutdown")
        reference = self._call.remote(self.message(fn, *args, **kwargs), *self.home())
        done: Future[tuple[bool, bytes]] = reference.future()
        future: _RayFuture[Result] = _RayFuture(partial(self._stop, reference, done))
        self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        done.add_done_callback(partial(_settle, future))
        return future

    def message(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> bytes:
        """Return a function of a module and its arguments, serialized."""
        return self.dumps((fn, args, kwargs))

    def dumps(self, thing: object) -> bytes:
        """Return an object pickled, also one of a class of the caller's script."""
        # Protocol 5 would leave arrays unaligned in the message, which changes the last bits of matrix products.
        return bytes(self.ray.cloudpickle.dumps(thing, protocol=4))

    def home(self) -> tuple[str, list[str], str]:
        """Return the caller's working folder, module search path and version of this package."""
        return str(Path.cwd()), sys.path, __version__

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Accept no more work; leave the cluster if this executor joined it.

        Args:
            wait: Whether to wait for scheduled tasks.
            cancel_futures: Whether to cancel scheduled tasks; running ones are stopped after a second.
        """
        self._open = False
        self._closed.set()
        if cancel_futures:
            for future in list(self._futures):
                future.cancel()
        if wait:
            _wait(list(self._futures))
        self._stops.shutdown(wait)
        if self._owns and self.ray.is_initialized():
            self.ray.shutdown()

    def _stop(self, reference: Any, done: Future[tuple[bool, bytes]]) -> None:
        with suppress(RuntimeError):  # the executor was shut down, and has stopped its tasks
            self._stops.submit(self._stop_at, monotonic() + _GRACE, reference, done)

    def _stop_at(self, time: float, reference: Any, done: Future[tuple[bool, bytes]]) -> None:
        """Stop a task that has not ended by then."""
        wait([done], max(0.0, time - monotonic()))
        if not done.done():
            with suppress(Exception):  # the cluster may be gone
                self.ray.cancel(reference, force=True)

    def _watch(self) -> None:
        """End the tasks that wait for nodes which were lost."""
        looks = 0
        while not self._closed.wait(_LOOK):
            try:
                _check_fits([node for node in self.ray.nodes() if node["Alive"]], self.cpus, self.memory)
            except InvalidValueError as error:
                looks += 1
                self.stranded = f"nodes of the cluster were lost: {error}" if looks >= _LOOKS else ""
            except Exception:  # the cluster is being left
                return
            else:
                looks, self.stranded = 0, ""
            for future in list(self._futures) if self.stranded else ():
                with suppress(InvalidStateError):  # it ended meanwhile
                    future.set_exception(WorkerLostError(self.stranded))
                future.stop()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.shutdown(cancel_futures=kind is not None)


class _RayFuture(Future[Result]):
    """Future whose cancellation also stops a running task."""

    def __init__(self, stop: Callable[[], None]):
        super().__init__()
        self.stop = stop

    def cancel(self) -> bool:
        canceled = super().cancel()
        if canceled:
            self.stop()
        return canceled


def _wait(futures: Iterable[Future[Any]]) -> None:
    wait(futures)


def _join(ray: Any, address: str, workers: int | None) -> None:
    """Start a cluster on this machine's cores, or join one.

    Raises:
        InvalidValueError: The cluster cannot be started or joined.
    """
    own = (
        {"num_cpus": workers, "include_dashboard": False, "_system_config": {"worker_niceness": 0}}
        if address == "local"
        else {}
    )
    try:
        ray.init(address=address, log_to_driver=False, logging_level="warning", configure_logging=True, **own)
    except (ConnectionError, RuntimeError, ValueError) as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise InvalidValueError(f"no Ray cluster can be joined at {address!r}: {first}") from error


def _check_fits(nodes: list[dict[str, Any]], cpus: float, memory: int | None) -> None:
    """Raise `InvalidValueError` where no node can run a task; Ray would wait forever."""
    cores = max((node["Resources"].get("CPU", 0.0) for node in nodes), default=0.0)
    largest = max((node["Resources"].get("memory", 0.0) for node in nodes), default=0.0)
    if not 0 < cpus <= cores:
        raise InvalidValueError(f"the nodes of the cluster have up to {cores:g} cores, got cpus={cpus!r}")
    if memory is not None and not 0 < memory <= largest:
        raise InvalidValueError(f"the nodes of the cluster have up to {largest / 1e9:.1f} GB, got memory={memory!r}")


def _check_listens(address: str) -> None:
    """Raise `InvalidValueError` within seconds where Ray would retry for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise InvalidValueError(f'address must be "local", "auto" or HOST:PORT, got {address!r}')
    try:
        with socket.create_connection((host, int(port)), _TIMEOUT) as connection:
            connection.settimeout(_TIMEOUT)
            connection.sendall(_GREETING)
            answer = connection.recv(9)
    except (OSError, OverflowError) as error:
        raise InvalidValueError(
            f"no Ray cluster listens at {address} ({error}): expected the head of a Ray cluster"
        ) from error
    if answer[3:4] != _SETTINGS and os.environ.get("RAY_USE_TLS", "0") in ("", "0"):
        raise InvalidValueError(f"the server at {address} is not the head of a Ray cluster")


def _call(message: bytes, folder: str, path: list[str], version: str) -> tuple[bool, bytes]:
    """Run a task on a node; return whether it succeeded, and its pickled result or error.

    Args:
        message: The pickled function and its arguments.
        folder: The caller's working folder.
        path: The caller's module search path.
        version: The caller's version of this package.
    """
    try:
        match_caller(folder, path, version)
        function, arguments, keywords = pickle.loads(message)
        return True, pickle.dumps(function(*arguments, **keywords))
    except Exception as error:
        return False, pickle.dumps(with_node_name(error))


def with_node_name(error: Exception) -> Exception:
    """Add this node's name to an error about a file that the node does not see."""
    path = getattr(error, "path", None)
    if isinstance(error, GreenhouseError) and isinstance(path, str | Path) and not Path(path).exists():
        error.args = (f"{error} (on node {platform.node()}, which sees no such path; all nodes must see the same)",)
    return error


def match_caller(folder: str, path: list[str], version: str) -> None:
    """Give this process the caller's working folder and module search path.

    Raises:
        InvalidValueError: The node has another version of this package.
    """
    if version != __version__:
        raise InvalidValueError(
            f"node {platform.node()} has greenhouse-gym {__version__}, the head {version}: install the same on all"
        )
    if Path(folder).is_dir():
        os.chdir(folder)
    sys.path += [entry for entry in path if entry not in sys.path]


def _settle(future: Future[Any], done: Future[tuple[bool, bytes]]) -> None:
    """Set the result of a caller's future from Ray's."""
    with suppress(InvalidStateError):  # it was canceled meanwhile
        try:
            succeeded, message = done.result()
        except BaseException as error:
            future.set_exception(WorkerLostError(f"a task was lost: {reason_of(error)}"))
            return
        try:
            result = pickle.loads(message)
        except Exception as error:
            future.set_exception(error)
            return
        if succeeded:
            future.set_result(result)
        else:
            future.set_exception(result)


def reason_of(error: BaseException) -> str:
    """Return Ray's error in one line, without its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {(lines or ['no reason given'])[0][:300]}"
