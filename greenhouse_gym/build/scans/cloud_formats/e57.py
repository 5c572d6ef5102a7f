"""Points of E57 files: all scans in the common frame of the file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from greenhouse_gym.build.scans.cloud_formats import parts
from greenhouse_gym.build.scans.cloud_formats.columns import fractions
from greenhouse_gym.build.scans.cloud_formats.native import native_output
from greenhouse_gym.build.scans.cloud_formats.native_script import E57_POINT
from greenhouse_gym.build.scans.cloud_formats.parts import Parts
from greenhouse_gym.errors import FileFormatError


def read_e57(path: Path) -> Parts:
    """Read positions and colors of all scans.

    Raises:
        FileFormatError: The file is damaged.
        MissingDependencyError: The package pye57 is not installed.
    """
    with native_output(path, "write_e57", [parts.MAX_POINTS], "pye57") as file:
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
