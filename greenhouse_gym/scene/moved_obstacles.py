"""Move the obstacles of a compiled scene without compiling it again.

A true row has up to 20,000 geoms, which MuJoCo compiles in two seconds; moving them takes a twentieth of that.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.mjcf import CompiledScene, geom_of
from greenhouse_gym.scene.obstacles import Surroundings

_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


def move_obstacles(compiled: CompiledScene, scene: Surroundings) -> CompiledScene:
    """Return a copy of a compiled scene with the obstacles where another scene has them.

    Args:
        compiled: The scene before; it stays unchanged.
        scene: The same obstacles in the same order, possibly moved and rotated, capsules possibly stretched.

    Raises:
        InvalidValueError: The scene has other obstacles.
    """
    geoms = [geom_of(shape) for shape in scene.obstacles]
    types = np.array([geom.type for geom in geoms], dtype=np.int64)
    first = compiled.obstacle_geoms.start
    ids = slice(first, first + len(geoms))
    model = copy.copy(compiled.model)
    if len(geoms) != len(compiled.scene.obstacles) or (model.geom_type[ids] != types).any():
        raise InvalidValueError(f"scene {scene.name!r} has other obstacles than it had before they moved")
    quats = np.array([geom.quat for geom in geoms]).reshape(-1, 4)
    model.geom_pos[ids] = np.array([geom.pos for geom in geoms]).reshape(-1, 3)
    model.geom_quat[ids] = quats
    rotated = (quats != _NO_ROTATION).any(axis=1)
    model.geom_sameframe[ids] = np.where(
        rotated, mujoco.mjtSameFrame.mjSAMEFRAME_NONE, mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT
    )
    for k in np.flatnonzero(types == mujoco.mjtGeom.mjGEOM_CAPSULE).tolist():
        radius, half, _ = geoms[k].size
        model.geom_size[first + k, 1] = half
        model.geom_aabb[first + k, 5] = model.geom_rbound[first + k] = radius + half
    _refit_world(model)
    return replace(compiled, scene=scene, model=model)


def _refit_world(model: mujoco.MjModel) -> None:
    """Fit the boxes of the world body's bounding-volume tree to the present poses of its geoms."""
    nodes = slice(model.body_bvhadr[0], model.body_bvhadr[0] + model.body_bvhnum[0])
    geom, depth, child, box = (
        part[nodes] for part in (model.bvh_nodeid, model.bvh_depth, model.bvh_child, model.bvh_aabb)
    )
    leaf = geom >= 0
    matrices = np.empty((int(leaf.sum()), 9))
    for matrix, quat in zip(matrices, model.geom_quat[geom[leaf]], strict=True):
        mujoco.mju_quat2Mat(matrix, quat)
    rotation = matrices.reshape(-1, 3, 3)
    center, half = np.split(model.geom_aabb[geom[leaf]], 2, axis=1)
    box[leaf, :3] = model.geom_pos[geom[leaf]] + np.einsum("nij,nj->ni", rotation, center)
    box[leaf, 3:] = np.einsum("nij,nj->ni", np.abs(rotation), half)
    for level in range(int(depth.max(initial=0)), -1, -1):
        inner = np.flatnonzero((depth == level) & ~leaf)
        both = box[child[inner]]  # (n, 2, 6)
        low = (both[..., :3] - both[..., 3:]).min(axis=1)
        high = (both[..., :3] + both[..., 3:]).max(axis=1)
        box[inner] = np.concatenate([low + high, high - low], axis=1) / 2
