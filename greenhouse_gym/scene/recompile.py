"""A compiled scene after its obstacles moved: the same geoms elsewhere, without compiling anew.

A true row has up to 20,000 geoms, which MuJoCo compiles in two seconds; to move them takes a twentieth of that.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import mujoco
import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.mjcf import CompiledScene, geom_of
from greenhouse_gym.scene.obstacles import Surroundings

_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


def moved_to(compiled: CompiledScene, scene: Surroundings) -> CompiledScene:
    """A compiled scene whose obstacles are those of another, in which they are elsewhere.

    Args:
        compiled: The scene before; it stays as it is.
        scene: The same obstacles in the same order: they may have been moved and turned, and capsules stretched.

    Raises:
        InvalidValueError: They are others.
    """
    geoms = [geom_of(shape) for shape in scene.obstacles]
    types = np.array([geom.type for geom in geoms], dtype=np.int64)
    first = compiled.obstacle_geoms.start
    these = slice(first, first + len(geoms))
    model = copy.copy(compiled.model)
    if len(geoms) != len(compiled.scene.obstacles) or (model.geom_type[these] != types).any():
        raise InvalidValueError(f"scene {scene.name!r} has other obstacles than it had before they moved")
    quats = np.array([geom.quat for geom in geoms]).reshape(-1, 4)
    model.geom_pos[these] = np.array([geom.pos for geom in geoms]).reshape(-1, 3)
    model.geom_quat[these] = quats
    turned = (quats != _UNTURNED).any(axis=1)
    model.geom_sameframe[these] = np.where(
        turned, mujoco.mjtSameFrame.mjSAMEFRAME_NONE, mujoco.mjtSameFrame.mjSAMEFRAME_BODYROT
    )
    for k in np.flatnonzero(types == mujoco.mjtGeom.mjGEOM_CAPSULE).tolist():
        radius, half, _ = geoms[k].size
        model.geom_size[first + k, 1] = half
        model.geom_aabb[first + k, 5] = model.geom_rbound[first + k] = radius + half
    _refit_world(model)
    return replace(compiled, scene=scene, model=model)


def _refit_world(model: mujoco.MjModel) -> None:
    """Have the boxes of the world body's bounding-volume tree enclose its geoms where they are now."""
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
