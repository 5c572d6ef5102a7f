"""Available memory, and limits on its use by calls of foreign code."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

_STATM, _MEMINFO = Path("/proc/self/statm"), Path("/proc/meminfo")
_CONTAINER = [Path("/sys/fs/cgroup") / name for name in ("memory.max", "memory/memory.limit_in_bytes")]
_RESERVE = 2**29  # bytes for the caller, once foreign code has taken all that it may


def available_memory() -> int:
    """Return the bytes that can be allocated without swapping on Linux; on other systems, a huge number."""
    free = sys.maxsize
    if _MEMINFO.is_file():
        lines = (line.split() for line in _MEMINFO.read_text().splitlines())
        free = next((int(line[1]) * 1024 for line in lines if line[0] == "MemAvailable:"), free)
    limits = [path.read_text().strip() for path in _CONTAINER if path.is_file()]
    return min([free, *(int(limit) for limit in limits if limit.isdecimal())])


class MemoryLimit:
    """Context in which allocations beyond a limit raise `MemoryError`, instead of exhausting the machine's memory.

    It holds for this process and those that it starts meanwhile, each by itself. Only Linux enforces it.

    Args:
        fraction: Fraction of the available memory that may be added to what the process has now.
    """

    def __init__(self, fraction: float = 1.0):
        self._set: Callable[[int], None] = lambda limit: None
        self._before = self._inside = 0
        try:
            import resource
        except ImportError:  # Windows has no such limits
            return
        if not _STATM.is_file():
            return
        self._before, hard = resource.getrlimit(resource.RLIMIT_DATA)
        taken = int(_STATM.read_text().split()[5]) * os.sysconf("SC_PAGE_SIZE")
        self._inside = taken + int(fraction * available_memory())
        if 0 <= self._before <= self._inside + _RESERVE:
            return
        self._set = lambda limit: resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))

    def __enter__(self) -> None:
        self._set(self._inside)

    def __exit__(self, *_: object) -> None:
        self._set(self._inside + _RESERVE)

    def lift(self) -> None:
        """Restore the limit that the process had before."""
        self._set(self._before)
