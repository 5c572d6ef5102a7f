"""Of which tomatoes a cloud holds skin: those that a camera saw and measured no depth of, no extraction can find."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import bounding_balls, distance_to_shapes
from greenhouse_gym.reconstruction.point_clouds import Cloud

_ON_SKIN = 0.003
"""Metres from a tomato's surface within which a point is its skin, with a depth camera's noise."""

_FACING = 0.5
"""Least cosine between such a point's normal and the direction away from the tomato's center."""


def skin_points(cloud: Cloud, tomatoes: Sequence[Tomato]) -> npt.NDArray[np.int64]:
    """How many points (k,) of a cloud are skin of each tomato: on its surface, and facing outwards.

    Args:
        cloud: Points with normals, in the tomatoes' frame.
        tomatoes: The k tomatoes.
    """
    tree = cKDTree(cloud.points)
    counts = np.zeros(len(tomatoes), dtype=np.int64)
    for k, tomato in enumerate(tomatoes):
        reach = float(bounding_balls([tomato.shape])[1][0]) + _ON_SKIN
        near = np.array(tree.query_ball_point(tomato.center, reach), dtype=np.int64)
        away = cloud.points[near] - tomato.center
        outwards = (away * cloud.normals[near]).sum(axis=1) > _FACING * np.linalg.norm(away, axis=1)
        on = np.abs(distance_to_shapes(cloud.points[near], [tomato.shape])[:, 0]) < _ON_SKIN
        counts[k] = np.count_nonzero(on & outwards)
    return counts
