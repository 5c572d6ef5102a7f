"""Points on and off the skin of tomatoes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.evidence import SHELL, nearest_shapes

Mask = npt.NDArray[np.bool_]

_NOISE = 0.0015  # metres that points may stand out of a fruit and still be skin
_ALIGNMENT = 0.9  # cosine between a point's normal and the sphere's above which it is skin
_MAX_DISTANCE = 0.008  # metres from a fruit at which aligned points are still skin, as a distant camera sees it


def skin_mask(points: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) lie within noise of a tomato's surface."""
    return nearest_shapes(points, [tomato.shape for tomato in tomatoes], _NOISE).owner >= 0


def noisy_skin_mask(points: Array, normals: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) with normals (n, 3) are skin of a tomato under strong sensor noise."""
    owner = nearest_shapes(points, [tomato.shape for tomato in tomatoes], _MAX_DISTANCE).owner
    return (owner >= 0) & _aligned(points, normals, tomatoes, owner)


def off_skin_mask(points: Array, normals: Array, tomatoes: Sequence[Tomato]) -> Mask:
    """Return which points (n, 3) with normals (n, 3) are not skin of a tomato; a stem in front of it stands out."""
    owner, residual = nearest_shapes(points, [tomato.shape for tomato in tomatoes], SHELL)
    return (owner < 0) | (~_aligned(points, normals, tomatoes, owner) & (residual > _NOISE))


def _aligned(points: Array, normals: Array, tomatoes: Sequence[Tomato], owner: npt.NDArray[np.int32]) -> Mask:
    """Return which points (n, 3) face away from the center of the tomato that owns them."""
    on = np.flatnonzero(owner >= 0)
    outwards = points[on] - np.array([t.center for t in tomatoes]).reshape(-1, 3)[owner[on]]
    aligned = np.zeros(len(points), dtype=np.bool_)
    aligned[on] = (outwards * normals[on]).sum(axis=1) > _ALIGNMENT * np.linalg.norm(outwards, axis=1)
    return aligned
