"""Fast ray casting of depth cameras against models of one layout.

MuJoCo tests every geom of a model for every ray, but a camera sees only a few of the hundreds of geoms in a padded
model. Therefore the rays are cast in a smaller model of the same arm, into which the obstacles within the cone of the
rays are copied. If there are many of these, the rays are split into groups with narrower cones.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene import CompiledScene, compile_scene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.obstacles import Surroundings

_CAPACITIES = (16, 32, 64, 128, 256)
"""Obstacle capacities of the smaller models; the smallest sufficient one is used."""

_MAX_OBSTACLES, _MIN_RAYS = 64, 96
"""Number of obstacles above which rays are split, and number of rays that are not split further."""

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
    """Casts rays against models of one layout, one model at a time.

    Args:
        compiled: Any scene of that layout.
    """

    def __init__(self, compiled: CompiledScene):
        self._obstacles = compiled.obstacle_geoms
        scene, capacity = compiled.scene, self._obstacles.stop - self._obstacles.start
        empty = Surroundings(name="view", placement=scene.placement)
        capacities = [*(size for size in _CAPACITIES if size < capacity), capacity]
        models = [compile_scene(empty, compiled.robot, size).model for size in capacities]
        self._views = [(size, model, mujoco.MjData(model)) for size, model in zip(capacities, models, strict=True)]

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
            directions: (m, 3) unit vectors, less than 90 degrees from their mean.
            reach: Maximum distance of a hit, metres.
            surfaces: Return colors and normals as well.
        """
        obstacles = first_world_geom(model) + np.arange(self._obstacles.start, self._obstacles.stop)
        distance, geom = np.empty(len(directions)), np.empty(len(directions), dtype=np.int64)
        count = len(directions) if surfaces else 0
        rgba, normal = np.empty((count, 4), dtype=np.float32), np.empty((count, 3))
        for rays, visible in _split(model, origin, directions, reach, np.arange(len(directions)), obstacles):
            hits = self._cast(model, joints, origin, directions[rays], reach, surfaces, visible)
            distance[rays], geom[rays] = hits.distance, hits.geom
            if surfaces:
                rgba[rays], normal[rays] = hits.rgba, hits.normal
        return Hits(distance, geom, rgba, normal)

    def _cast(
        self,
        model: mujoco.MjModel,
        joints: Array,
        origin: Array,
        directions: Array,
        reach: float,
        surfaces: bool,
        visible: npt.NDArray[np.int64],
    ) -> Hits:
        """Cast rays that can hit no obstacles except those given; see `cast`."""
        capacity, view, data = next(own for own in self._views if own[0] >= len(visible))
        first = self._obstacles.start
        rows = np.concatenate([first_world_geom(model) + np.arange(first), visible])
        for name in _GEOM_FIELDS:
            getattr(view, name)[: len(rows)] = getattr(model, name)[rows]
        view.geom_rgba[len(rows) : first + capacity, 3] = 0.0  # rays pass through transparent geoms
        for name in _BODY_FIELDS:
            getattr(view, name)[:] = getattr(model, name)
        data.qpos[:] = joints
        mujoco.mj_kinematics(view, data)
        count = len(directions)
        distance, geom = np.empty(count), np.empty(count, dtype=np.int32)
        normal = np.zeros((count if surfaces else 0, 3))
        mujoco.mj_multiRay(
            view, data, origin, directions.reshape(-1), None, True, -1, geom, distance,
            normal.reshape(-1) if surfaces else None, count, reach,
        )  # fmt: skip
        ids = np.arange(-1, view.ngeom)  # of the view's geoms in the compiled model, after that of no geom
        ids[1 + first : 1 + first + len(visible)] = visible - first_world_geom(model)
        ids[1 + first + capacity :] += self._obstacles.stop - first - capacity
        return Hits(distance, ids[1 + geom], view.geom_rgba[geom[: len(normal)]], normal)


def _split(
    model: mujoco.MjModel,
    origin: Array,
    directions: Array,
    reach: float,
    rays: npt.NDArray[np.int64],
    among: npt.NDArray[np.int64],
) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Yield groups of rays, each with the obstacles that it may hit; groups with few obstacles are large."""
    visible = _in_cone(model, origin, directions[rays], reach, among)
    if len(visible) <= _MAX_OBSTACLES or len(rays) <= _MIN_RAYS:
        yield rays, visible
        return
    for half in _halves(directions[rays]):
        yield from _split(model, origin, directions, reach, rays[half], visible)


def _in_cone(
    model: mujoco.MjModel, origin: Array, directions: Array, reach: float, among: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Return the geoms of ``among`` whose bounding spheres intersect the cone around the rays."""
    axis = directions.mean(axis=0)
    axis /= np.linalg.norm(axis)
    half = np.arccos(min((directions @ axis).min(), 1.0)) + 1e-6
    towards, radius = model.geom_pos[among] - origin, model.geom_rbound[among]
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    angle = np.arccos(np.clip(towards @ axis / distance, -1.0, 1.0))
    spread = np.arcsin(np.minimum(radius / distance, 1.0))
    inside = (angle - spread <= half) | (distance <= radius)
    return np.asarray(among[inside & (distance - radius <= reach)])


def _halves(directions: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Split rays (m, 3) at the median of their widest extent and return the indices of both halves."""
    off = directions - directions.mean(axis=0)
    order = (off @ np.linalg.eigh(off.T @ off)[1][:, -1]).argsort(kind="stable")
    return order[: len(order) // 2], order[len(order) // 2 :]
