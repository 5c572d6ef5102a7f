"""Tables of whole numbers as numbers that take fewer bits, and back exactly.

Neighbours in a table are neighbours in space, so a center or a start is told from the end before it, and an end from
its start. Of a unit quaternion, the largest number follows from the three others up to its sign and a little rounding.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

Numbers = npt.NDArray[np.int64]

QUATERNION_UNIT = 1e-5
"""What 1 stands for in the columns of a quaternion."""


def width(columns: str) -> int:
    """Number of columns that `differences` makes of some (names: `greenhouse_gym.crops.shape_tables.COLUMNS`)."""
    return len(columns) + ("q" in columns)


def differences(table: Numbers, columns: str) -> Numbers:
    """(n, `width`) numbers that take fewer bits than those of a table (n, columns)."""
    points = columns.count("x")
    ends = table[:, points - 3 : points]
    before = np.vstack([np.zeros((1, 3), dtype=np.int64), ends[:-1]])[: len(table)]
    parts = [table[:, :3] - before, ends - table[:, :3]][: points // 3]
    rest = table[:, points:]
    if "q" in columns:
        rest = np.column_stack([rest[:, :-4], _shorter(rest[:, -4:])])
    return np.column_stack([*parts, rest])


def restored(numbers: Numbers, columns: str) -> Numbers:
    """The table (n, columns) of `differences`.

    Raises:
        InvalidValueError: There is no such table.
    """
    points = columns.count("x")
    steps, lengths, rest = numbers[:, :3], numbers[:, 3:points], numbers[:, points:]
    ends = np.cumsum(steps + lengths if points > 3 else steps, axis=0)
    if "q" in columns:
        rest = np.column_stack([rest[:, :-5], _whole(rest[:, -5:])])
    return np.column_stack([ends - lengths, ends, rest] if points > 3 else [ends, rest])


def _shorter(quaternions: Numbers) -> Numbers:
    """(n, 5) of quaternions (n, 4): three numbers, which is left out and its sign, and how far off its guess is."""
    largest = np.abs(quaternions).argmax(axis=1)
    left_out = np.arange(4) == largest[:, None]
    others, size = quaternions[~left_out].reshape(-1, 3), quaternions[left_out]
    return np.column_stack([others, 2 * largest + (size < 0), np.abs(size) - _guess(others)])


def _whole(shorter: Numbers) -> Numbers:
    """The quaternions (n, 4) of `_shorter`."""
    others, said, off = shorter[:, :3], shorter[:, 3], shorter[:, 4]
    if ((said < 0) | (said > 7)).any():
        raise InvalidValueError("damaged data: a quaternion has four numbers")
    left_out = np.arange(4) == (said // 2)[:, None]
    whole = np.empty(left_out.shape, dtype=np.int64)
    whole[~left_out] = others.reshape(-1)
    whole[left_out] = (_guess(others) + off) * np.where(said % 2, -1, 1)
    return whole


def _guess(others: Numbers) -> Numbers:
    """The largest number of unit quaternions by the three others (n, 3), the same on every processor."""
    return np.rint(np.sqrt(np.maximum(QUATERNION_UNIT**-2 - (others.astype(float) ** 2).sum(axis=1), 0.0))).astype(
        np.int64
    )
