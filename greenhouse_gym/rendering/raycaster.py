"""Rays of a depth camera against models of one layout.

MuJoCo asks every geom of a model for every ray, and of the hundreds in a padded model a camera may see a few. So the
rays are cast in a smaller model of the same arm, into which the obstacles within their cone are copied. Where these are
many, the rays are parted, and each part has a narrower cone with fewer of them.
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

_ROOMS = (16, 32, 64, 128, 256)
"""Obstacles that the smaller models have room for; the smallest that suffices is used."""

_MANY, _LEAST = 64, 96
"""Obstacles from which on rays are parted, and rays of a part that is not parted further."""

_BODY_FIELDS = ("body_pos", "body_quat", "body_sameframe")
_GEOM_FIELDS = (
    "geom_type", "geom_size", "geom_pos", "geom_quat", "geom_sameframe", "geom_aabb", "geom_rbound", "geom_rgba",
)  # fmt: skip


class Hits(NamedTuple):
    """What m rays hit.

    Attributes:
        distance: (m,) along the ray, metres; -1 where nothing is hit.
        on_arm: (m,) whether it is the arm.
        rgba: (m, 4) color of what is hit, 0 to 1; m is 0 unless asked for.
        normal: (m, 3) unit normals of the surfaces; m is 0 unless asked for.
    """

    distance: Array
    on_arm: npt.NDArray[np.bool_]
    rgba: npt.NDArray[np.float32]
    normal: Array


class RayCaster:
    """Casts rays against models of one layout, one at a time.

    Args:
        compiled: Any of the scenes.
    """

    def __init__(self, compiled: CompiledScene):
        self._obstacles = compiled.obstacle_geoms
        scene, capacity = compiled.scene, self._obstacles.stop - self._obstacles.start
        empty = Surroundings(name="view", placement=scene.placement)
        rooms = [*(room for room in _ROOMS if room < capacity), capacity]
        models = [compile_scene(empty, compiled.robot, room).model for room in rooms]
        self._views = [(room, model, mujoco.MjData(model)) for room, model in zip(rooms, models, strict=True)]

    def cast(
        self,
        model: mujoco.MjModel,
        joints: Array,
        origin: Array,
        directions: Array,
        reach: float,
        surfaces: bool = False,
    ) -> Hits:
        """What m rays hit.

        Args:
            model: A model of the layout, its geoms in either order (`greenhouse_gym.scene.geom_order`).
            joints: (j,) joint positions, radians.
            origin: (3,) where the rays start in the scene, metres.
            directions: (m, 3) unit vectors, less than 90 degrees from their mean.
            reach: Hits farther away do not count, metres.
            surfaces: Whether to tell colors and normals.
        """
        obstacles = first_world_geom(model) + np.arange(self._obstacles.start, self._obstacles.stop)
        distance, on_arm = np.empty(len(directions)), np.empty(len(directions), dtype=np.bool_)
        told = len(directions) if surfaces else 0
        rgba, normal = np.empty((told, 4), dtype=np.float32), np.empty((told, 3))
        for rays, seen in _parts(model, origin, directions, reach, np.arange(len(directions)), obstacles):
            hits = self._cast(model, joints, origin, directions[rays], reach, surfaces, seen)
            distance[rays], on_arm[rays] = hits.distance, hits.on_arm
            if surfaces:
                rgba[rays], normal[rays] = hits.rgba, hits.normal
        return Hits(distance, on_arm, rgba, normal)

    def _cast(
        self,
        model: mujoco.MjModel,
        joints: Array,
        origin: Array,
        directions: Array,
        reach: float,
        surfaces: bool,
        seen: npt.NDArray[np.int64],
    ) -> Hits:
        """As `cast`, where the rays hit no other obstacles than some."""
        room, view, data = next(own for own in self._views if own[0] >= len(seen))
        first = self._obstacles.start
        rows = np.concatenate([first_world_geom(model) + np.arange(first), seen])
        for name in _GEOM_FIELDS:
            getattr(view, name)[: len(rows)] = getattr(model, name)[rows]
        view.geom_rgba[len(rows) : first + room, 3] = 0.0  # rays pass through what cannot be seen
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
        return Hits(distance, geom >= first + room, view.geom_rgba[geom[: len(normal)]], normal)


def _parts(
    model: mujoco.MjModel,
    origin: Array,
    directions: Array,
    reach: float,
    rays: npt.NDArray[np.int64],
    among: npt.NDArray[np.int64],
) -> Iterator[tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]]:
    """Parts of some rays, each with the obstacles among some that it may hit: the fewer there are, the larger it is."""
    seen = _in_cone(model, origin, directions[rays], reach, among)
    if len(seen) <= _MANY or len(rays) <= _LEAST:
        yield rays, seen
        return
    for half in _halves(directions[rays]):
        yield from _parts(model, origin, directions, reach, rays[half], seen)


def _in_cone(
    model: mujoco.MjModel, origin: Array, directions: Array, reach: float, among: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """The geoms among some whose bounding spheres reach into the cone around the rays."""
    axis = directions.mean(axis=0)
    axis /= np.linalg.norm(axis)
    half = np.arccos(min((directions @ axis).min(), 1.0)) + 1e-6
    towards, radius = model.geom_pos[among] - origin, model.geom_rbound[among]
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    angle = np.arccos(np.clip(towards @ axis / distance, -1.0, 1.0))
    beside = np.arcsin(np.minimum(radius / distance, 1.0))
    inside = (angle - beside <= half) | (distance <= radius)
    return np.asarray(among[inside & (distance - radius <= reach)])


def _halves(directions: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices of rays (m, 3) on either side of the middle of where they spread most."""
    off = directions - directions.mean(axis=0)
    order = (off @ np.linalg.eigh(off.T @ off)[1][:, -1]).argsort(kind="stable")
    return order[: len(order) // 2], order[len(order) // 2 :]
