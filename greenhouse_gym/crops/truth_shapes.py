"""What an arm would touch in a row: every plant organ as convex shapes."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np

from greenhouse_gym.crops.decimation import TOLERANCE, leaf_boxes
from greenhouse_gym.crops.organs import THIN_KINDS, Organ
from greenhouse_gym.crops.plant_row import PlantRow
from greenhouse_gym.geometry import Box, Capsule, Shape


@lru_cache(maxsize=4)
def truth_of(row: PlantRow, tolerance: float = TOLERANCE) -> PlantRow:
    """A row as shapes to collide with: capsules, spheres or ellipsoids, and thin boxes.

    A row of our own generator is made of such shapes already. Of a row of meshes, the fruit and stems are known as
    such; leaves, calyces and flowers are cut into thin boxes (`greenhouse_gym.crops.decimation`), which takes about
    a fifth of a second each. The row behind, which no arm reaches, keeps its leaves as they are.

    Args:
        row: The row.
        tolerance: How far from a leaf its boxes may lie, metres, as in `greenhouse_gym.crops.decimation.leaf_boxes`.
            Twice as much makes about half as many boxes.
    """
    if not row.organs:
        return row
    clutter = (shape for organ in row.organs for shape in _clutter_of(organ, tolerance))
    return replace(row, clutter=(*row.clutter, *clutter))


def _clutter_of(organ: Organ, tolerance: float) -> list[Shape]:
    """The shapes of an organ that is neither fruit nor stem; none of those that are."""
    if organ.kind in THIN_KINDS:
        return list(leaf_boxes(organ.vertices, organ.triangles, tolerance))
    if organ.kind == "petiole" and organ.axis is not None:
        return [Capsule(a[:3], b[:3], max((a[3] + b[3]) / 2, 1e-4)) for a, b in pairwise(organ.axis)]
    if organ.kind == "gutter":
        low, high = organ.vertices.min(axis=0), organ.vertices.max(axis=0)
        return [Box((low + high) / 2, (high - low) / 2, np.eye(3))]
    return []
