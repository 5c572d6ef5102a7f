"""Run a script in a process of its own, with limits on time and memory.

Native readers of damaged files may crash, run forever or take all memory; in that process they harm nothing else.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from greenhouse_gym.errors import GreenhouseError

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
