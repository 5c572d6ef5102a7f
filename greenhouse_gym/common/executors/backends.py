"""Executors by name, for the command line."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from greenhouse_gym.common.executors.ray_executor import RayExecutor
from greenhouse_gym.common.executors.spreading import processes, usable_cores
from greenhouse_gym.errors import require_choice

BACKENDS = ("serial", "processes", "ray")
"""Names of the backends: this process, processes of this machine, or a Ray cluster."""


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
        with RayExecutor(address, workers=workers) as cluster:
            yield cluster


def idle_cores() -> int:
    """Return the number of idle cores, estimated from the load of the last minute where the system reports it."""
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return max(0, usable_cores() - round(busy))
