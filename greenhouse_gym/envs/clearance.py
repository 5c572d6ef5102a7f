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

_BLOCK = 32
"""Simulations whose distances to the tomatoes are computed at once: few enough for the processor's cache."""


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
    near = points.astype(np.float32).transpose(2, 0, 1)[..., None]  # (3, n, k, 1)
    n, k = distance.shape
    rows = _starts(min(n, _BLOCK) * k, tomatoes.shape[2])
    for i in range(0, n, _BLOCK):
        part = slice(i, i + _BLOCK)
        offset = tomatoes[:3, part, None] - near[:, part]  # (3, b, k, t)
        x, y, z = offset * offset
        x += y
        x += z
        away = np.sqrt(x, out=x)
        surface = away - tomatoes[3, part, None]
        first = surface.argmin(axis=2)
        first += rows[: first.size].reshape(first.shape)
        gap = surface.reshape(-1)[first]
        towards = offset.reshape(3, -1)[:, first] / np.maximum(away.reshape(-1)[first], np.float32(1e-6))
        nearer = gap < distance[part]
        np.copyto(distance[part], gap, where=nearer)
        np.copyto(direction[part], towards.transpose(1, 2, 0), where=nearer[..., None])
    return distance, direction


@lru_cache(maxsize=64)
def _starts(rows: int, length: int) -> npt.NDArray[np.int64]:
    """Where each of so many rows of that length begins in a flat array."""
    starts = np.arange(rows) * length
    starts.setflags(write=False)
    return starts
