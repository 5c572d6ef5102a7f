"""Fill the obstacle slots of a compiled model, which takes a tenth of the time of compiling it.

The arrays of the model become those that MuJoCo's compiler makes of the same obstacles, bit for bit.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array, ShapeArrays
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, ELLIPSOID

MIN_LENGTH = 1e-6
"""Length below which a capsule becomes a sphere, metres."""

TYPES = np.array(
    [
        mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        mujoco.mjtGeom.mjGEOM_BOX,
    ]
)  # fmt: skip
_EQUAL = 1e-6  # difference below which the compiler takes frames as equal
_MIN_VALUE = 1e-15  # MuJoCo's mjMINVAL
_X, _Y, _Z = (7, 5, -1), (2, 6, -1), (3, 1, -1)
_XY, _XZ, _YZ = (1, 3, 1), (2, 6, 1), (5, 7, 1)
_LARGEST_ENTRIES = (  # signs of the diagonal, and the others as sums of two entries, for each largest entry
    ((1, 1, 1), {1: _X, 2: _Y, 3: _Z}),
    ((1, -1, -1), {0: _X, 2: _XY, 3: _XZ}),
    ((-1, 1, -1), {0: _Y, 1: _XY, 3: _YZ}),
    ((-1, -1, 1), {0: _Z, 1: _XZ, 2: _YZ}),
)
_NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])


def fill_slots(model: mujoco.MjModel, first: int, shapes: ShapeArrays, colors: Array) -> None:
    """Turn geoms of the world body into shapes.

    Args:
        model: A model whose geoms from ``first`` on are spheres in empty slots.
        first: Id of the first slot.
        shapes: At most as many shapes as there are slots.
        colors: (n, 4) their colors.
    """
    write_geoms(model, slice(first, first + len(shapes.kinds)), shapes, colors)
    build_tree(model)


def write_geoms(
    model: mujoco.MjModel,
    slots: slice | npt.NDArray[np.int64],
    shapes: ShapeArrays,
    colors: npt.NDArray[np.floating],
) -> None:
    """Turn geoms into shapes, given in the frame of their body; `build_tree` has to follow.

    Args:
        model: The model.
        slots: Ids of as many geoms as there are shapes.
        shapes: The shapes.
        colors: (n, 4) their colors.
    """
    kinds, positions, sizes, quats = geoms_of(shapes)
    boxes = np.zeros((len(kinds), 6))
    boxes[:, 3:] = sizes
    round_, capsule = kinds == 0, kinds == CAPSULE
    boxes[round_ | capsule, 3:] = sizes[round_ | capsule, :1]
    boxes[capsule, 5] += sizes[capsule, 1]
    x, y, z = boxes[:, 3:].T
    model.geom_type[slots], model.geom_pos[slots], model.geom_size[slots] = TYPES[kinds], positions, sizes
    model.geom_quat[slots], model.geom_aabb[slots], model.geom_rgba[slots] = quats, boxes, colors
    model.geom_rbound[slots] = np.where(kinds == BOX, np.sqrt(x * x + y * y + z * z), boxes[:, 3:].max(axis=1))
    rotated = np.minimum(np.abs(quats - _NO_ROTATION).max(axis=1), np.abs(quats + _NO_ROTATION).max(axis=1)) >= _EQUAL
    shifted = (np.abs(positions) >= _EQUAL).any(axis=1)
    frame = mujoco.mjtSameFrame
    model.geom_sameframe[slots] = np.where(
        rotated, frame.mjSAMEFRAME_NONE, np.where(shifted, frame.mjSAMEFRAME_BODYROT, frame.mjSAMEFRAME_BODY)
    )


def geoms_of(shapes: ShapeArrays) -> tuple[np.ndarray[tuple[int], np.dtype[np.int8]], Array, Array, Array]:
    """Return kinds (n,), positions (n, 3), sizes (n, 3) and quaternions (n, 4) of shapes as geoms of MuJoCo."""
    kinds, sizes = shapes.kinds.copy(), shapes.sizes.copy()
    quats = np.tile(_NO_ROTATION, (len(kinds), 1))
    axes = shapes.ends - shapes.starts
    for k in np.flatnonzero(kinds == CAPSULE).tolist():
        length = math.sqrt(axes[k].dot(axes[k]))
        if length <= MIN_LENGTH:
            kinds[k] = 0
        else:
            sizes[k, 1] = length / 2
            mujoco.mju_quatZ2Vec(quats[k], axes[k])
    rotations = shapes.rotations.reshape(-1, 9)
    turned = (rotations != np.eye(3).reshape(9)).any(axis=1)  # most boxes of observed points are not
    turned &= (kinds == BOX) | (kinds == ELLIPSOID)
    quats[turned] = _quaternions(rotations[turned])
    return kinds, (shapes.starts + shapes.ends) / 2, sizes, quats


def _quaternions(m: Array) -> Array:
    """Return the quaternions (n, 4) of rotations (n, 9) by rows with the arithmetic of `mujoco.mju_mat2Quat`."""
    trace = m[:, 0] + m[:, 4] + m[:, 8]
    first, second = (m[:, 0] > m[:, 4]) & (m[:, 0] > m[:, 8]), m[:, 4] > m[:, 8]
    largest = np.where(trace > 0, 0, np.where(first, 1, np.where(second, 2, 3)))
    quats = np.empty((len(m), 4))
    for k, (signs, entries) in enumerate(_LARGEST_ENTRIES):
        own = largest == k
        a = m[own]
        size = 0.5 * np.sqrt(1 + signs[0] * a[:, 0] + signs[1] * a[:, 4] + signs[2] * a[:, 8])
        quats[own, k] = size
        for j, (one, other, sign) in entries.items():
            quats[own, j] = 0.25 * (a[:, one] + sign * a[:, other]) / size
    w, x, y, z = quats.T
    norm = np.sqrt((w * w + x * x) + (y * y + z * z))
    off = np.abs(norm - 1) > _MIN_VALUE
    quats[off] *= (1 / norm[off])[:, None]
    return quats


def build_tree(model: mujoco.MjModel, body: int = 0) -> None:
    """Build the bounding-volume tree of a body, by default of the world, without which MuJoCo misses contacts."""
    from greenhouse_gym.scene.tree_kernel import tree_over

    geoms, first = int(model.body_geomadr[body]), int(model.body_bvhadr[body])
    own = slice(geoms, geoms + int(model.body_geomnum[body]))
    nodes = slice(first, first + int(model.body_bvhnum[body]))
    positions, quats = model.geom_pos[own], model.geom_quat[own]
    if body:
        positions, quats = _in_inertial_frame(positions, quats, model.body_ipos[body], model.body_iquat[body])
    tree_over(
        positions, quats, model.geom_aabb[own], model.bvh_depth[nodes], model.bvh_child[nodes],
        model.bvh_nodeid[nodes], model.bvh_aabb[nodes],
    )  # fmt: skip
    if geoms:
        ids = model.bvh_nodeid[nodes]
        ids[ids >= 0] += geoms


def _in_inertial_frame(positions: Array, quats: Array, center: Array, rotation: Array) -> tuple[Array, Array]:
    """Return positions (n, 3) and quaternions (n, 4) in the inertial frame of a body, that of its tree."""
    back = np.empty(4)
    mujoco.mju_negQuat(back, rotation)
    moved, turned = np.empty_like(positions), np.empty_like(quats)
    for k, (position, quat) in enumerate(zip(positions - center, quats, strict=True)):
        mujoco.mju_rotVecQuat(moved[k], position, back)
        mujoco.mju_mulQuat(turned[k], back, quat)
    return moved, turned
