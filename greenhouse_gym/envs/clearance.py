"""How far the arm's probe points are from the nearest obstacle, and which way it lies, for n simulations at once."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.reach_task import Float32
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.field import MAX_DISTANCE, FieldStore

FAR_AWAY = np.array([1e3, 1e3, 1e3, 0.0], dtype=np.float32)
"""A sphere that is never the nearest: pads the tomatoes, and stands in for the target."""


def nearest_obstacle(
    fields: FieldStore, slots: npt.NDArray[np.int64], tomatoes: Float32, points: Array
) -> tuple[Float32, Float32]:
    """Distances (n, k), metres, and unit directions (n, k, 3) from points to the nearest obstacle.

    Args:
        fields: Where the fields of stems and clutter are kept.
        slots: (n,) slot of each simulation's field.
        tomatoes: (n, t, 4) centers and radii of the tomatoes that count, padded with `FAR_AWAY`.
        points: (n, k, 3), like everything else in the base frame.
    """
    distance, direction = fields.lookup(slots, points)
    near = points.astype(np.float32)
    x, y, z = (tomatoes[:, None, :, axis] - near[:, :, None, axis] for axis in range(3))
    away = np.sqrt(x * x + y * y + z * z)
    surface = away - tomatoes[:, None, :, 3]
    first = surface.argmin(axis=2)[..., None]
    gap = np.take_along_axis(surface, first, 2)[..., 0]
    unit = np.concatenate([np.take_along_axis(part, first, 2) for part in (x, y, z)], axis=2)
    unit /= np.maximum(np.take_along_axis(away, first, 2), np.float32(1e-6))
    nearer = gap < np.minimum(distance, np.float32(MAX_DISTANCE))
    return np.where(nearer, gap, distance), np.where(nearer[..., None], unit, direction)


def to_base(points: Array, frame: Array) -> Array:
    """Points (n, k, 3) of the scene in the frames of the arms' bases: (n, 5) position and cosine, sine of the yaw."""
    offset = points - frame[:, None, :3]
    cosine, sine = frame[:, None, 3], frame[:, None, 4]
    result = offset.copy()
    result[..., 0] = cosine * offset[..., 0] + sine * offset[..., 1]
    result[..., 1] = cosine * offset[..., 1] - sine * offset[..., 0]
    return result
