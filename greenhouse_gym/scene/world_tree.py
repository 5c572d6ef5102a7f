"""Small trees over the geoms of a world without those that are parked.

A model reserves geoms for the largest scene, so most of them may be parked. The compiled model has all of them in its
tree; simulations use the part of it that holds the others, and find the same contacts.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import first_world_geom


class BoxTree(NamedTuple):
    """Boxes around all that an arm can touch, in depth-first order.

    Attributes:
        boxes: (m, 6) lower and upper corners, metres, rounded outward.
        after: (m,) node that follows the subtree of each node; the next one after a leaf.
    """

    boxes: npt.NDArray[np.float32]
    after: npt.NDArray[np.int32]


class WorldTree(NamedTuple):
    """Part of MuJoCo's tree over the world of a model.

    Attributes:
        reach: Boxes around the geoms of the part; planes, whose boxes have no end, come first.
        child: (m, 2) children of each node; -1 for leaves.
        geom: (m,) geom of each leaf in the compiled order, else -1.
        aabb: (m, 6) centers and half sizes of the boxes, metres.
    """

    reach: BoxTree
    child: npt.NDArray[np.int32]
    geom: npt.NDArray[np.int32]
    aabb: Array

    def load(self, model: mujoco.MjModel) -> None:
        """Let a model, whose geoms may be in either order, use this part."""
        _load(model, self.child, self.geom, self.aabb)


def copy_whole_tree(source: mujoco.MjModel, model: mujoco.MjModel) -> None:
    """Copy the tree over all geoms of the world, parked ones included, from a compiled model into another."""
    own = slice(int(source.body_bvhnum[0]))
    _load(model, source.bvh_child[own], source.bvh_nodeid[own], source.bvh_aabb[own])


def world_tree(model: mujoco.MjModel, used: int) -> WorldTree:
    """Return the tree over the first geoms of the world of a model.

    Args:
        model: The model, its geoms in the compiled order.
        used: Number of these geoms.
    """
    own = slice(int(model.body_bvhnum[0]))
    child, geoms, aabb = model.bvh_child[own], model.bvh_nodeid[own], model.bvh_aabb[own]
    kept = (geoms >= 0) & (geoms < used)
    _, after, source = _pack(child, aabb, kept)
    nodes = np.arange(len(after), dtype=np.int32)
    children = np.stack([nodes + 1, after[np.minimum(nodes + 1, len(nodes) - 1)]], axis=1)
    children[after == nodes + 1] = -1
    reached = aabb.copy()
    reached[:, 3:] += (model.geom_margin[:used] + model.geom_gap[:used]).max(initial=0.0)
    plane = model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_PLANE
    first, second = _pack(child, reached, kept & plane), _pack(child, reached, kept & ~plane)
    reach = BoxTree(np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1] + len(first[1])]))
    return WorldTree(reach, children, geoms[source], aabb[source])


def _load(model: mujoco.MjModel, child: npt.NDArray[np.int32], geom: npt.NDArray[np.int32], aabb: Array) -> None:
    count, ids = len(geom), np.where(geom >= 0, geom + first_world_geom(model), geom)
    model.bvh_child[:count], model.bvh_nodeid[:count], model.bvh_aabb[:count] = child, ids, aabb
    model.body_bvhnum[0] = count


def _pack(
    child: npt.NDArray[np.int32], aabb: Array, chosen: npt.NDArray[np.bool_]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    from greenhouse_gym.scene.reach_kernels import pack_tree

    nodes = 2 * int(chosen.sum())
    boxes, after, source = np.empty((nodes, 6), np.float32), np.empty(nodes, np.int32), np.empty(nodes, np.int32)
    count = pack_tree(child, aabb, chosen, boxes, after, source)
    return boxes[:count], after[:count], source[:count]
