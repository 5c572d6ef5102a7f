"""Text files of numbers and of timed poses, and matching of times."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.common.files import parsing, read_bytes
from greenhouse_gym.errors import FileFormatError
from greenhouse_gym.geometry import Array, pose

POSE_TOLERANCE = 0.05
"""Maximum time between an image and its pose, seconds."""


def read_numbers(path: Path, columns: int) -> Array:
    """Read a text file of numbers (lines, columns) without empty lines and those that begin with #.

    Raises:
        FileFormatError: The file cannot be read, or holds something else.
    """
    with parsing(path, f"file of {columns} numbers a line"):
        lines = [line.split() for line in read_bytes(path, "trajectory").decode().splitlines()]
        rows = np.array([list(map(float, line)) for line in lines if line and line[0][0] != "#"])
        if rows.ndim != 2 or rows.shape[1] != columns:
            raise ValueError(f"shape {rows.shape}")
        if not np.isfinite(rows).all():
            raise ValueError("not all are finite")
    return rows


def read_poses(path: Path) -> tuple[Array, Array]:
    """Read times (n,) and poses (n, 4, 4) from lines ``time tx ty tz qx qy qz qw``, sorted by time.

    Raises:
        FileFormatError: The file cannot be read, or holds something else.
    """
    rows = read_numbers(path, 8)
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    if not (lengths > 1e-6).all():
        raise FileFormatError(path, f"the quaternion at {rows[np.argmin(lengths), 0]} is zero")
    turns = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return rows[:, 0], np.array([pose(turn, row[1:4]) for turn, row in zip(turns, rows, strict=True)])


def nearest_in_time(times: Array, others: Array, within: float) -> npt.NDArray[np.int64]:
    """Return the index of the nearest of the sorted ``others`` (m,) for each time (n,), -1 beyond ``within``."""
    if not len(others):
        return np.full(len(times), -1, dtype=np.int64)
    after = np.clip(np.searchsorted(others, times), 1, max(1, len(others) - 1))
    before = after - 1
    after = np.minimum(after, len(others) - 1)
    nearest = np.where(np.abs(others[after] - times) < np.abs(others[before] - times), after, before)
    return np.where(np.abs(others[nearest] - times) <= within, nearest, -1)
