"""How far the arm's probe points are from the nearest obstacle, and which way it lies, for n simulations at once."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.reach_task import Float32
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.field import FieldStore

FAR_AWAY = np.array([1e3, 1e3, 1e3, 0.0], dtype=np.float32)[:, None]
"""A sphere (4, 1) that is never the nearest: pads the tomatoes, and stands in for the target."""


def nearest_obstacle(
    fields: FieldStore, slots: npt.NDArray[np.int64], tomatoes: Float32, points: Array
) -> tuple[Float32, Float32]:
    """Distances (n, k), metres, and unit directions (n, k, 3) from points to the nearest obstacle.

    Args:
        fields: Where the fields of stems and clutter are kept.
        slots: (n,) slot of each simulation's field.
        tomatoes: (4, n, t) x, y, z and radii of the tomatoes that count, padded with `FAR_AWAY`.
        points: (n, k, 3), like everything else in the base frame.
    """
    distance, direction = fields.lookup(slots, points)
    near = points.astype(np.float32)
    x, y, z = (tomatoes[axis, :, None] - near[:, :, None, axis] for axis in range(3))  # (n, k, t)
    away = np.sqrt(x * x + y * y + z * z)
    surface = away - tomatoes[3, :, None]
    n, k, t = surface.shape
    first = surface.argmin(axis=2)
    first += _starts(n * k, t).reshape(n, k)
    gap = surface.reshape(-1)[first]
    nearer = gap < distance
    length = np.maximum(away.reshape(-1)[first], np.float32(1e-6))
    for axis, offset in enumerate((x, y, z)):
        np.divide(offset.reshape(-1)[first], length, out=direction[..., axis], where=nearer)
    return np.minimum(gap, distance), direction


@lru_cache(maxsize=64)
def _starts(rows: int, length: int) -> npt.NDArray[np.int64]:
    """Where each of so many rows of that length begins in a flat array."""
    starts = np.arange(rows) * length
    starts.setflags(write=False)
    return starts


def to_base(points: Array, frame: Array) -> Array:
    """Points (n, k, 3) of the scene in the frames of the arms' bases: (n, 5) position and cosine, sine of the yaw."""
    return turned_back(points - frame[:, None, :3], frame)


def turned_back(offset: Array, frame: Array) -> Array:
    """Vectors (n, k, 3) of the scene in the frames of the arms' bases, given as in `to_base`."""
    cosine, sine = frame[:, None, 3], frame[:, None, 4]
    result = offset.copy()
    result[..., 0] = cosine * offset[..., 0] + sine * offset[..., 1]
    result[..., 1] = cosine * offset[..., 1] - sine * offset[..., 0]
    return result
