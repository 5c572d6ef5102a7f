"""What a scan did not see is not free: unknown voxels as obstacles for planning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, Box, bounding_balls, distance_to_shapes
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.scene.occupancy import (
    REACH,
    UNKNOWN,
    Cells,
    OccupancyGrid,
    boxes_covering,
    inside_boxes,
    require_occupancy,
)

UNKNOWN_RULES = ("free", "avoid", "forbid")
"""What planners make of unknown space: nothing; a place to keep out of as far as can be; an obstacle."""

DEPTHS = (0.0, 0.1, 0.15, 0.2, float("inf"))
"""Depths in metres that a path may enter unknown space, in the order in which "avoid" tries them."""

_RESOLUTION = 0.02  # metres, at which a path's way through unknown space is measured


def depths_of(rule: str | float) -> tuple[float, ...]:
    """How deep the arm may go into unknown space by a rule, metres: what is tried, one after the other.

    Raises:
        UnknownNameError: No such rule.
        InvalidValueError: A negative depth.
    """
    if isinstance(rule, str):
        named = {"free": DEPTHS[-1:], "avoid": DEPTHS, "forbid": DEPTHS[:1]}
        return named[require_choice("unknown", rule, UNKNOWN_RULES)]
    if not rule >= 0:
        raise InvalidValueError(f"unknown must be a rule or a depth of 0 m or more, got {rule!r}")
    return (float(rule),)


def occupancy_of(scene: Scene) -> OccupancyGrid:
    """What a scan saw of a scene's space.

    Raises:
        InvalidValueError: The scene does not say; the message tells what helps.
    """
    return require_occupancy(
        scene.occupancy,
        scene.name,
        'unknown="avoid", "forbid" or a depth, or unexplained=True',
        'plan with unknown="free"',
    )


def unknown_boxes(scene: Scene, robot: Robot, start: npt.ArrayLike, depth: float = 0.0) -> list[Box]:
    """Boxes over the unknown space within reach in which no arm may be.

    Known, though not seen, is where the arm and its cart stand, and the inside of tomatoes. Beyond the reach the boxes
    go on or end, as it takes fewer of them.

    Args:
        scene: The scene; it must know what was seen.
        robot: The arm.
        start: (joints,) where it stands, radians.
        depth: How far from seen space unknown space is still allowed, metres.
    """
    space = occupancy_of(scene)
    depths, beyond = _depths(ByIdentity(scene), robot, tuple(np.asarray(start, dtype=np.float64).tolist()))
    return boxes_covering((depths > depth) & ~beyond, space.origin, space.voxel, optional=beyond)


def guarded(scene: Scene, robot: Robot, start: npt.ArrayLike, depth: float = 0.0) -> CompiledScene:
    """Compile a scene for planning with the boxes of `unknown_boxes` as clutter; recent results are cached."""
    return _guarded(ByIdentity(scene), robot, tuple(np.asarray(start, dtype=np.float64).tolist()), float(depth))


def unknown_length(scene: Scene, robot: Robot, path: Array) -> float:
    """Length of the tip's way along a path (k, joints) while some of the arm is in unknown space, metres."""
    return unknown_lengths(scene, robot, [path])[0][0]


def unknown_lengths(scene: Scene, robot: Robot, paths: Sequence[Array]) -> list[tuple[float, float]]:
    """The tip's way along paths (k, joints) from one start, metres: with some of the arm in unknown space, and all."""
    compiled = guarded(scene, robot, paths[0][0])
    model = planning_model(compiled, 0, margin=0.0, pairs=("clutter",))
    first = compiled.obstacle_geoms.start + len(scene.tomatoes) + len(scene.stems)
    known = slice(first, first + len(scene.clutter))
    model.geom_contype[known] = model.geom_conaffinity[known] = 0
    checker = CollisionChecker(model, arm_reaches(robot))
    chain = tool_chain(compiled.model, compiled.tip_site)
    return [_unknown_and_all(checker, chain, np.asarray(path)) for path in paths]


def _unknown_and_all(checker: CollisionChecker, chain: Chain, path: Array) -> tuple[float, float]:
    """As `unknown_lengths`, by a checker to which unknown space is an obstacle."""
    way = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(path, axis=0)) @ checker.reaches)])
    places = np.linspace(0.0, way[-1], 1 + int(np.ceil(way[-1] / _RESOLUTION)))
    between = np.stack([np.interp(places, way, joint) for joint in path.T], axis=-1)
    inside = np.array([not checker.is_free(q) for q in between])
    steps = np.linalg.norm(np.diff(tool_state(chain, between, 0.0).point, axis=0), axis=-1)
    return float(steps[inside[:-1] | inside[1:]].sum()), float(steps.sum())


@dataclass(frozen=True, eq=False)
class ByIdentity:
    """A scene as a key, by its identity: scenes are never changed."""

    scene: Scene

    def __hash__(self) -> int:
        return id(self.scene)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByIdentity) and self.scene is other.scene


@lru_cache(maxsize=16)
def _guarded(kept: ByIdentity, robot: Robot, start: tuple[float, ...], depth: float) -> CompiledScene:
    scene = kept.scene
    if np.isinf(depth):
        return compile_scene(scene, robot)
    boxes = unknown_boxes(scene, robot, start, depth)
    return compile_scene(scene.model_copy(update={"clutter": (*scene.clutter, *boxes)}), robot)


@lru_cache(maxsize=4)
def _depths(kept: ByIdentity, robot: Robot, start: tuple[float, ...]) -> tuple[Array, Cells]:
    """How deep each voxel (x, y, z) lies in unknown space, metres, 0 where it is known; and those beyond the reach."""
    scene = kept.scene
    space = occupancy_of(scene)
    unknown = space.states == UNKNOWN
    if unknown.all():
        depths = np.full(space.shape, np.inf)
    else:
        depths = np.asarray(distance_transform_edt(unknown, sampling=space.voxel))
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    beyond = np.linalg.norm(space.centers - shoulder, axis=-1) > REACH
    cells = np.argwhere(unknown & ~beyond)
    centers = space.origin + (cells + 0.5) * space.voxel
    known = inside_boxes(centers, boxes_around_arm(scene, robot, start), space.voxel)
    known |= _inside_tomatoes(centers, scene.tomatoes)
    depths[tuple(cells[known].T)] = 0.0
    return depths, beyond


def _inside_tomatoes(points: Array, tomatoes: Sequence[Tomato]) -> npt.NDArray[np.bool_]:
    """Which of points (n, 3) lie inside of a tomato, (n,)."""
    inside = np.zeros(len(points), dtype=np.bool_)
    if tomatoes:
        shapes = [tomato.shape for tomato in tomatoes]
        centers, radii = bounding_balls(shapes)
        away, _ = cKDTree(centers).query(points, distance_upper_bound=float(radii.max()))
        near = np.isfinite(away)
        inside[near] = distance_to_shapes(points[near], shapes).min(axis=1) < 0
    return inside


def boxes_around_arm(scene: Scene, robot: Robot, start: npt.ArrayLike) -> list[tuple[Array, Array, Array]]:
    """Center, half extents and rotation of a box around each geom of the arm at its start, and of its cart."""
    bare = Scene(name=scene.name, placement=scene.placement, provenance=scene.provenance)
    model = compile_scene(bare, robot).model
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_kinematics(model, data)
    boxes = []
    for geom in np.flatnonzero(model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE).tolist():
        rotation = data.geom_xmat[geom].reshape(3, 3)
        boxes.append((data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:], rotation))
    return boxes
