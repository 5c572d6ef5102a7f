"""Runs of damaged files in a process of its own: no foreign error, no crash, no hang, no full memory."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import pytest

from greenhouse_gym.errors import GreenhouseError

SECONDS, MEMORY = 10, 10**9
"""Processor time and bytes that a mutant may take."""

Damage = Callable[[bytes, int], bytes]


class Source(NamedTuple):
    """A kind of file to damage.

    Attributes:
        write: Write the whole files into a folder and return the one to damage.
        use: Read the damaged file, or what it belongs to.
        damages: Ways to damage its content, used in turn.
        least_refused: Fraction of the mutants that are refused at least.
    """

    write: Callable[[Path], Path]
    use: Callable[[Path], object]
    damages: tuple[Damage, ...]
    least_refused: float = 0.2


def try_mutants(source: Source, first: int, last: int, report: Path) -> None:
    """Use mutants; the report's last line says which one is in use, or how many were refused."""
    import resource

    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder, report.open("w") as log:
        path, refused = source.write(Path(folder)), 0
        content = path.read_bytes()
        source.use(path)
        for seed in range(first, last):
            log.write(f"mutant {seed}\n")
            log.flush()
            path.write_bytes(source.damages[seed % len(source.damages)](content, seed))
            signal.setitimer(signal.ITIMER_PROF, SECONDS)
            try:
                source.use(path)
            except GreenhouseError as error:
                refused += len(str(error)) < 2000
            signal.setitimer(signal.ITIMER_PROF, 0)
        peak = max(_own_peak(), 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)
        log.write(json.dumps([last - first, refused, peak]))


def _own_peak() -> int:
    """Bytes of memory of this process at its peak; the figure of ``getrusage`` includes its parent's at the start."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    assert found
    return 1024 * int(found[1])


_RUN = """
import importlib, json, sys
from pathlib import Path
sys.path[:], module, jobs, folder = json.loads(sys.argv[1])
import resource
resource.setrlimit(resource.RLIMIT_DATA, (2 * 10**9, 2 * 10**9))
from fuzzing import try_mutants
sources = importlib.import_module(module).SOURCES
for kind, first, last in jobs:
    try_mutants(sources[kind], first, last, Path(folder) / f"{kind}.log")
"""


def assert_all_end_well(module: str, folder: Path, jobs: list[tuple[str, int, int]]) -> None:
    """Check mutants of kinds in the ``SOURCES`` of a test module, each job a kind and a range of seeds."""
    arguments = json.dumps([sys.path, module, jobs, str(folder)])
    done = subprocess.run([sys.executable, "-c", _RUN, arguments], capture_output=True, text=True, check=False)
    sources = sys.modules[module].SOURCES
    for kind, first, last in jobs:
        log = folder / f"{kind}.log"
        final = log.read_text().splitlines()[-1] if log.exists() and log.stat().st_size else "not started"
        if not final.startswith("["):
            pytest.fail(f"{kind}, {final}: exit status {done.returncode}\n{done.stderr[-2000:]}")
        count, refused, peak = json.loads(final)
        assert count == last - first
        assert refused >= sources[kind].least_refused * count, (kind, refused)
        assert peak < MEMORY
    assert done.returncode == 0, done.stderr


def assert_what_is_no_file_does_no_harm(source: Source, folder: Path) -> None:
    """Check that a folder, a pipe, a device or a link in a file's place gives an error of the package at most."""
    path = source.write(folder)
    path.unlink()
    puts: tuple[Callable[[], object], ...] = (
        path.touch,
        path.mkdir,
        lambda: os.mkfifo(path),
        lambda: path.symlink_to("/dev/zero"),
        lambda: path.symlink_to("missing"),
        lambda: path.symlink_to(path),
    )
    for put in puts:
        put()
        with suppress(GreenhouseError):
            source.use(path)
        path.rmdir() if path.is_dir() else path.unlink()
