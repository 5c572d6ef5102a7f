"""Limits on memory, and scripts in a process of their own with limits on time and memory.

Native readers of damaged files may crash, run forever or take all memory; in that process they harm nothing else.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from greenhouse_gym.errors import GreenhouseError

_STATM, _MEMINFO = Path("/proc/self/statm"), Path("/proc/meminfo")
_CONTAINER = [Path("/sys/fs/cgroup") / name for name in ("memory.max", "memory/memory.limit_in_bytes")]
_RESERVE = 2**29  # bytes for the caller, once foreign code has taken all that it may

_BOOT = """
import json, runpy, sys
sys.path[:], sys.argv[:], memory, seconds = json.loads(sys.argv[1])
try:
    import resource
except ImportError:  # Windows has no such limits
    pass
else:
    limits = {"DATA": memory, "FSIZE": memory, "CPU": seconds, "CORE": 0}
    for name, limit in limits.items():
        hard = resource.getrlimit(getattr(resource, f"RLIMIT_{name}"))[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(getattr(resource, f"RLIMIT_{name}"), (limit, hard))
runpy.run_path(sys.argv[0], run_name="__main__")
"""
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1") | {"RUST_BACKTRACE": "0"}
_SLOWEST = 10  # seconds of real time for each allowed second of processor time, on a busy machine
_ERROR_BYTES = 10_000  # of the end of the script's error output


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


class IsolatedError(GreenhouseError):
    """The script failed, crashed or exceeded a limit.

    Attributes:
        kind: Name of the error's class if the script raised one.
    """

    def __init__(self, reason: str, kind: str = "") -> None:
        self.kind = kind
        super().__init__(reason)


@contextmanager
def isolated_output(script: Path, arguments: list[str], seconds: int, memory: int) -> Iterator[IO[bytes]]:
    """Provide the standard output of a script, as a file.

    The script runs in a fresh interpreter with this one's search path.

    Args:
        script: File of the script.
        arguments: Its arguments.
        seconds: Processor time it may take; ten times as much real time.
        memory: Bytes it may allocate, and write.

    Raises:
        IsolatedError: The script raised an error, crashed, or exceeded a limit.
    """
    setup = json.dumps([sys.path, [str(script), *arguments], memory, seconds])
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as errors:
        try:
            code = subprocess.run(
                [sys.executable, "-c", _BOOT, setup], stdin=subprocess.DEVNULL, stdout=output, stderr=errors,
                env=os.environ | _THREADS, timeout=_SLOWEST * seconds, check=False,
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired:
            raise IsolatedError(f"took longer than {_SLOWEST * seconds:g} s") from None
        if code:
            errors.seek(max(0, errors.tell() - _ERROR_BYTES))
            last = errors.read().decode(errors="replace").strip().rpartition("\n")[2]
            kind, _, reason = last.partition(": ")
            if code > 0:
                raise IsolatedError(reason or last or f"ended without a message (exit status {code})", kind)
            limits = f"it may take {seconds} s and {memory >> 20} MiB"
            raise IsolatedError(f"the script ended with signal {-code}; {limits}")
        output.seek(0)
        yield output
