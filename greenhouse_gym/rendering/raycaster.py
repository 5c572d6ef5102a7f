"""Fast ray casting of depth cameras against models of one layout.

MuJoCo tests every geom of a model for every ray. Therefore MuJoCo casts the rays in a model of the arm alone, with the
floor and the cart, and a kernel casts them through the model's tree over the obstacles. Hits are those of MuJoCo in the
whole model, to the last bit. Plants that move are cast through a tree over where they are now.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import CompiledScene, compile_scene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.obstacles import Surroundings

_TILE = 4  # pixels: side of a tile

_BODY_FIELDS = ("body_pos", "body_quat", "body_sameframe")
_GEOM_FIELDS = (
    "geom_type", "geom_size", "geom_pos", "geom_quat", "geom_sameframe", "geom_aabb", "geom_rbound", "geom_rgba",
)  # fmt: skip


class Hits(NamedTuple):
    """First hits of m rays.

    Attributes:
        distance: (m,) distance along the ray, metres; -1 without a hit.
        geom: (m,) id of the geom in the compiled model; -1 without a hit.
        rgba: (m, 4) surface colors, 0 to 1; m is 0 unless requested.
        normal: (m, 3) unit surface normals; m is 0 unless requested.
    """

    distance: Array
    geom: npt.NDArray[np.int64]
    rgba: npt.NDArray[np.float32]
    normal: Array


class RayCaster:
    """Ray caster for models of one layout, one model at a time.

    Args:
        compiled: Any scene of that layout.

    Attributes:
        arm: Ids of the arm's geoms in the compiled model.
    """

    def __init__(self, compiled: CompiledScene):
        self._slots = compiled.obstacle_geoms
        empty = Surroundings(name="view", placement=compiled.scene.placement)
        self._arm = compile_scene(empty, compiled.robot, 1).model
        self.arm = range(self._slots.stop, self._slots.stop + self._arm.ngeom - self._slots.start - 1)
        self._data = mujoco.MjData(self._arm)

    def cast(
        self,
        model: mujoco.MjModel,
        joints: Array,
        origin: Array,
        directions: Array,
        reach: float,
        surfaces: bool = False,
        plants: mujoco.MjData | None = None,
        width: int = 1,
    ) -> Hits:
        """Return the first hits of m rays.

        Args:
            model: A model of the layout, its geoms in either order (`greenhouse_gym.scene.geom_order`).
            joints: (j,) joint positions, radians.
            origin: (3,) origin of the rays in the scene, metres.
            directions: (m, 3) unit vectors.
            reach: Maximum distance of a hit, metres.
            surfaces: Return colors and normals as well.
            plants: State of the model, if it has bodies besides the arm.
            width: Width of the image whose rows the rays are, pixels.
        """
        from greenhouse_gym.rendering.ray_kernels import nearer_hits

        directions = np.ascontiguousarray(directions)
        distance, geom, normal = self._cast_at_arm(model, joints, origin, directions, reach, surfaces)
        world = first_world_geom(model)
        first, last, obstacle = world + self._slots.start, world + self._slots.stop, np.full(len(directions), -1)
        geoms = (
            model.geom_type, model.geom_size, model.geom_pos, model.geom_quat, model.geom_rbound, model.geom_rgba,
        )  # fmt: skip
        tree = model.bvh_child, model.bvh_nodeid, model.bvh_aabb
        order = _in_tiles(len(directions) // width, width)
        nearer_hits(origin, directions, order, reach, first, last, geoms, tree, distance, obstacle, normal)
        # the arm's view has one slot
        geom = np.where(geom > self._slots.start, geom + self._slots.stop - self._slots.start - 1, geom)
        geom = np.where(obstacle >= 0, obstacle - world, geom)
        if plants is not None:
            first = (self.arm.stop + world) % model.ngeom
            shown = first + np.flatnonzero(model.geom_rgba[first : first + model.ngeom - self.arm.stop, 3])
            if len(shown):
                plant = np.full(len(directions), -1)
                moving = _geoms_of(model, plants, shown)
                tree = _tree(model, shown, moving)
                nearer_hits(origin, directions, order, reach, 0, len(shown), moving, tree, distance, plant, normal)
                geom = np.where(plant >= 0, (shown[plant] - world) % model.ngeom, geom)
        rgba = model.geom_rgba[(geom[: len(normal)] + world) % model.ngeom]
        return Hits(distance, geom, rgba, normal)

    def _cast_at_arm(
        self, model: mujoco.MjModel, joints: Array, origin: Array, directions: Array, reach: float, surfaces: bool
    ) -> tuple[Array, npt.NDArray[np.int64], Array]:
        """Return distances, geoms of the view and normals of hits on anything except obstacles; see `cast`."""
        view, fixture = self._arm, np.arange(self._slots.start)
        for name in _GEOM_FIELDS:
            getattr(view, name)[fixture] = getattr(model, name)[first_world_geom(model) + fixture]
        for name in _BODY_FIELDS:
            getattr(view, name)[:] = getattr(model, name)[: view.nbody]
        self._data.qpos[:] = joints
        mujoco.mj_kinematics(view, self._data)
        count = len(directions)
        distance, geom = np.empty(count), np.empty(count, dtype=np.int32)
        normal = np.zeros((count if surfaces else 0, 3))
        mujoco.mj_multiRay(
            view, self._data, origin, directions.reshape(-1), None, True, -1, geom, distance,
            normal.reshape(-1) if surfaces else None, count, reach,
        )  # fmt: skip
        return distance, geom.astype(np.int64), normal


@lru_cache(maxsize=16)
def _in_tiles(height: int, width: int) -> npt.NDArray[np.int64]:
    """Return the indices of an image's pixels, tile by tile: neighbors meet the same shapes."""
    row, column = (each.reshape(-1) for each in np.indices((height, width)))
    return np.lexsort((column, row, column // _TILE, row // _TILE))


def _geoms_of(model: mujoco.MjModel, data: mujoco.MjData, ids: npt.NDArray[np.int64]) -> tuple[Any, ...]:
    """Return the geoms of moving bodies where they are now, see `ray_kernels.nearer_hits`."""
    quats = np.empty((len(ids), 4))
    for quat, rotation in zip(quats, data.geom_xmat[ids], strict=True):
        mujoco.mju_mat2Quat(quat, rotation)
    return (
        model.geom_type[ids], model.geom_size[ids], data.geom_xpos[ids], quats, model.geom_rbound[ids],
        model.geom_rgba[ids],
    )  # fmt: skip


def _tree(model: mujoco.MjModel, ids: npt.NDArray[np.int64], geoms: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the tree over such geoms."""
    from greenhouse_gym.scene.tree_kernel import tree_over

    nodes = 2 * len(ids) - 1
    child, geom, boxes = np.empty((nodes, 2), np.int32), np.empty(nodes, np.int32), np.empty((nodes, 6))
    _, _, positions, quats, *_ = geoms
    tree_over(positions, quats, model.geom_aabb[ids], np.empty(nodes, np.int32), child, geom, boxes)
    return child, geom, boxes
