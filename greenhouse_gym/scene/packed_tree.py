"""Compact tree of boxes around what an arm can touch in the world of a model."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt


class PackedTree(NamedTuple):
    """Tree of boxes, its nodes in depth-first order.

    Attributes:
        boxes: (m, 6) lower and upper corners, metres, float32, rounded outward.
        after: (m,) node that follows the subtree of each node; the next one after a leaf.
    """

    boxes: npt.NDArray[np.float32]
    after: npt.NDArray[np.int32]


def packed_tree(model: mujoco.MjModel, used: int) -> PackedTree:
    """Return boxes around the first geoms of the world of a model, with their margins.

    Planes, whose boxes have no end, come first; the tree over the other geoms follows.

    Args:
        model: The model, its geoms in the compiled order.
        used: Number of these geoms.
    """
    from greenhouse_gym.scene.reach_kernels import pack_tree

    nodes = int(model.body_bvhnum[0])
    geoms = model.bvh_nodeid[:nodes]
    aabb = model.bvh_aabb[:nodes].copy()
    aabb[:, 3:] += model.geom_margin[:used].max(initial=0.0)
    plane = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE
    kept = (geoms >= 0) & (geoms < used)
    boxes, after, count = np.empty((nodes + 1, 6), np.float32), np.empty(nodes + 1, np.int32), 0
    for chosen in (kept & plane, kept & ~plane):
        added = pack_tree(model.bvh_child[:nodes], aabb, chosen, boxes[count:], after[count:])
        after[count : count + added] += count
        count += added
    return PackedTree(boxes[:count].copy(), after[:count].copy())
