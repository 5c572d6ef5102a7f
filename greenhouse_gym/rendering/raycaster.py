"""Fast ray casting of depth cameras against models of one layout.

MuJoCo tests every geom of a model for every ray. Therefore MuJoCo casts the rays in a model of the arm alone, with the
floor and the cart, and a kernel casts them through the model's tree over the obstacles. Hits are those of MuJoCo in the
whole model, to the last bit.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import CompiledScene, compile_scene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.obstacles import Surroundings

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
    """

    def __init__(self, compiled: CompiledScene):
        self._slots = compiled.obstacle_geoms
        empty = Surroundings(name="view", placement=compiled.scene.placement)
        self._arm = compile_scene(empty, compiled.robot, 1).model
        self._data = mujoco.MjData(self._arm)

    def cast(
        self,
        model: mujoco.MjModel,
        joints: Array,
        origin: Array,
        directions: Array,
        reach: float,
        surfaces: bool = False,
    ) -> Hits:
        """Return the first hits of m rays.

        Args:
            model: A model of the layout, its geoms in either order (`greenhouse_gym.scene.geom_order`).
            joints: (j,) joint positions, radians.
            origin: (3,) origin of the rays in the scene, metres.
            directions: (m, 3) unit vectors.
            reach: Maximum distance of a hit, metres.
            surfaces: Return colors and normals as well.
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
        nearer_hits(origin, directions, reach, first, last, geoms, tree, distance, obstacle, normal)
        # the arm's view has one slot
        geom = np.where(geom > self._slots.start, geom + self._slots.stop - self._slots.start - 1, geom)
        geom = np.where(obstacle >= 0, obstacle - world, geom)
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
            getattr(view, name)[:] = getattr(model, name)
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
