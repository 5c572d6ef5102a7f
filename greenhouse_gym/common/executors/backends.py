"""Executors by name, as the command line asks for them."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager

from greenhouse_gym.common.executors.ray_executor import RayExecutor
from greenhouse_gym.common.executors.spreading import processes, usable_cores
from greenhouse_gym.errors import require_choice

BACKENDS = ("serial", "processes", "ray")
"""Where work may be done: here, in processes of this machine, on a Ray cluster."""


@contextmanager
def executor_for(backend: str, workers: int | None = None, address: str = "local") -> Iterator[Executor | None]:
    """The executor of a backend for the time of a ``with`` block.

    Args:
        backend: One of `BACKENDS`.
        workers: Processes on this machine; None for one per core. Another machine's cluster has its own number.
        address: Address of the Ray cluster, as `RayExecutor` takes it.

    Yields:
        The executor; None for "serial".

    Raises:
        UnknownNameError: There is no such backend.
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
    """Cores of this process that nobody seems to use, by the system's load over the last minute, where it is told."""
    busy = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return max(0, usable_cores() - round(busy))
