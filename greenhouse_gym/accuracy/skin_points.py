"""Skin points of tomatoes in a cloud: fruit without measured depth cannot be found by any extraction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import bounding_balls, distance_to_shapes
from greenhouse_gym.geometry.point_clouds import Cloud

_ON_SKIN = 0.003
"""Largest distance of a skin point from a tomato's surface, metres, given the noise of a depth camera."""

_MIN_COSINE = 0.5
"""Smallest cosine between a skin point's normal and the direction away from the tomato's center."""


def skin_points(cloud: Cloud, tomatoes: Sequence[Tomato]) -> npt.NDArray[np.int64]:
    """Count the points (k,) of a cloud that are skin of each tomato: on its surface and facing outwards.

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
        outwards = (away * cloud.normals[near]).sum(axis=1) > _MIN_COSINE * np.linalg.norm(away, axis=1)
        on = np.abs(distance_to_shapes(cloud.points[near], [tomato.shape])[:, 0]) < _ON_SKIN
        counts[k] = np.count_nonzero(on & outwards)
    return counts
