"""Common helpers of all benchmarks: result files, rates with intervals, tables, processes of their own, timing."""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.evaluation.records import wilson_interval
from greenhouse_gym.planning.worker import shared_worker

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
TESTS = ROOT / "tests"
"""Folder of helpers that write recordings in the formats of others."""
REAL_DATA = Path(os.environ.get("GREENHOUSE_GYM_REAL_DATA", "/nonexistent"))
"""Folder of recordings and clouds of real things; benchmarks that need it do nothing without it."""

PACKAGES = (
    "greenhouse-gym", "numpy", "scipy", "mujoco", "gymnasium", "ompl", "open3d", "opencv-python-headless", "pyhelios3d",
    "rosbags", "torch", "stable-baselines3", "ray",
)  # fmt: skip
"""Packages whose versions are written next to every result."""

# -- the command line -------------------------------------------------------------------------------------------------


def parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser whose help is a script's docstring."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_workdir(to: argparse.ArgumentParser) -> None:
    """Add the option ``--workdir``."""
    to.add_argument("--workdir", type=Path, help="folder for everything that is made; by default nothing is kept")


@contextmanager
def kept_or_temporary(folder: Path | None) -> Iterator[Path]:
    """Yield the folder, or a temporary one when None is given."""
    if folder is not None:
        yield folder
    else:
        with tempfile.TemporaryDirectory() as temporary:
            yield Path(temporary)


# -- result files -----------------------------------------------------------------------------------------------------


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write figures as JSON with the command, the versions of the packages, and the machine."""
    write_atomically(path, json.dumps({**results, **_circumstances()}, indent=1) + "\n")


def write_entry(path: Path, name: str, figures: Mapping[str, Any]) -> None:
    """Add an entry to a file of results, or replace the one of that name; the other entries stay as they are."""
    entries = json.loads(path.read_text())["entries"] if path.is_file() else {}
    entries[name] = {**figures, **_circumstances()}
    write_atomically(path, json.dumps({"entries": entries}, indent=1) + "\n")


def read_entry(path: Path, name: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return an entry of a file of results; an empty one if it is missing or holds other settings."""
    entry: dict[str, Any] = json.loads(path.read_text())["entries"].get(name, {}) if path.is_file() else {}
    same = all(entry.get(key) == value for key, value in json.loads(json.dumps(settings)).items())
    return entry if same else {}


def command_line() -> str:
    """Return the module that runs with its arguments, without folders and files of this machine."""
    spec, words = sys.modules["__main__"].__spec__, sys.argv[1:]
    left_out = {"--workdir", "--results", "--python"}
    kept = (word for before, word in pairwise(["", *words]) if not {before, word} & left_out)
    return " ".join([spec.name if spec else Path(sys.argv[0]).name, *kept])


def _circumstances() -> dict[str, Any]:
    return {
        "command": command_line(),
        "versions": dict(_versions()),
        "machine": {
            "processor": processor(),
            "cores": os.cpu_count(),
            "system": platform.platform(),
            "python": platform.python_version(),
            "load": round(os.getloadavg()[0], 2),
        },
    }


def _versions() -> Iterator[tuple[str, str]]:
    for name in PACKAGES:
        try:
            yield name, version(name)
        except PackageNotFoundError:
            continue


def processor() -> str:
    """Return the processor's name."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


def fingerprint(*modules: ModuleType) -> str:
    """Return a checksum of the code and data of packages and modules, by which outdated measurements are recognized."""
    digest = hashlib.sha256()
    for path in (Path(str(module.__file__)) for module in modules):
        files = sorted(path.parent.rglob("*")) if path.name == "__init__.py" else [path]
        for file in (file for file in files if file.suffix in (".py", ".json", ".xml")):
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def hashes(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of every file below a folder, by its path."""
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


# -- figures ----------------------------------------------------------------------------------------------------------


def rate(count: int, total: int) -> dict[str, Any]:
    """Return a count as a rate with its 95 % Wilson interval."""
    return {
        "count": count,
        "rate": round(count / total, 4) if total else None,
        "interval": [round(bound, 4) for bound in wilson_interval(count, total)],
    }


def percent(found: Mapping[str, Any], digits: int = 1) -> str:
    """Return a `rate` as text."""
    if found["rate"] is None:
        return "-"
    low, high = found["interval"]
    return f"{found['rate']:.{digits}%} [{low:.{digits}%}, {high:.{digits}%}]"


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]], align: str = "---:") -> str:
    """Return a Markdown table, by default with columns after the first aligned to the right; nothing without rows."""
    if not rows:
        return ""
    lines = [heads, ["---", *[align] * (len(heads) - 1)], *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


# -- processes and time -----------------------------------------------------------------------------------------------


def in_own_process(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a new process, so that its memory and its threads are its own."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def processor_seconds() -> float:
    """Return the processor time of this process and of the planning process so far (Linux)."""
    pid = shared_worker().pid
    if pid is None:
        return time.process_time()
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return time.process_time() + (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def seconds_of(act: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the seconds that a function takes."""
    began = clock()
    act()
    return clock() - began
