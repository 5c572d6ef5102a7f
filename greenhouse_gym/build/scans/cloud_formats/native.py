"""Native readers of clouds, in a process of their own."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import IO

import numpy as np

from greenhouse_gym.build.scans.cloud_formats import columns, native_script
from greenhouse_gym.build.scans.cloud_formats.columns import Parts, fractions
from greenhouse_gym.build.scans.cloud_formats.native_script import E57_POINT
from greenhouse_gym.common.isolation import IsolatedError, isolated_output
from greenhouse_gym.errors import FileFormatError, MissingDependencyError

_SECONDS, _SECONDS_PER_BYTE = 5, 2e-6  # processor time that a reader may take
_MEMORY, _MEMORY_PER_BYTE = 2**29, 64  # bytes that it may allocate


@contextmanager
def native_output(path: Path, function: str, arguments: Sequence[int], package: str) -> Iterator[IO[bytes]]:
    """Provide the output of a function of `native_script` for a file.

    Args:
        path: The file.
        function: Name of the function.
        arguments: Its further arguments.
        package: The package that it imports.

    Raises:
        FileFormatError: The function raised an error, crashed, or exceeded a limit of time or memory.
        MissingDependencyError: The package is not installed, or cannot be imported.
    """
    if find_spec(package) is None:
        raise MissingDependencyError(package, "scans")
    size = path.stat().st_size
    seconds, memory = _SECONDS + int(size * _SECONDS_PER_BYTE), _MEMORY + size * _MEMORY_PER_BYTE
    call = json.dumps([function, str(path.absolute()), *arguments])
    try:
        with isolated_output(Path(native_script.__file__), [call], seconds, memory) as output:
            yield output
    except IsolatedError as error:
        if "ImportError" in error.kind or "ModuleNotFoundError" in error.kind:
            raise MissingDependencyError(package, "scans", problem=str(error)) from error
        raise FileFormatError(path, f"cannot be read: {error}") from error


def read_e57(path: Path) -> Parts:
    """Read positions and colors of all scans.

    Raises:
        FileFormatError: The file is damaged.
        MissingDependencyError: The package pye57 is not installed.
    """
    with native_output(path, "write_e57", [columns.MAX_POINTS], "pye57") as file:
        total, scans = json.loads(file.readline())
        points = np.fromfile(file, E57_POINT)
    if len(points) != sum(kept for kept, _, _ in scans):
        raise FileFormatError(path, f"cut short: fewer than its {total} points are there")
    colors, done = points["rgb"].astype(np.float64), 0
    for kept, black, white in scans:
        part = colors[done : done + kept]
        stated = white > black and not ((part < black) | (part > white)).any()
        part[:] = (part - black) / (white - black) if stated else fractions(path, part)
        done += kept
    return Parts(points["xyz"], colors if np.isfinite(colors).any() else None, None, total)
