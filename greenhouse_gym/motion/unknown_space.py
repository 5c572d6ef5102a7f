"""Unknown space as an obstacle: boxes over the voxels that a scan did not observe."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from numbers import Real

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError, is_number, require_choice
from greenhouse_gym.geometry import Array, ShapeArrays, bounding_balls, distance_to_shapes
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.path import along_path
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import MAX_CAPACITY, CompiledScene, compile_scene
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
"""Rules for unknown space: it is free, avoided if possible, or an obstacle."""

DEPTHS = (0.0, 0.1, 0.15, 0.2, float("inf"))
"""Depths in unknown space that "avoid" tries in turn, metres; the last one is no limit."""

_SLOTS = 100  # smallest number of slots; scenes of similar size share the model whose slots they fill
_RESOLUTION = 0.02  # metres, at which the length of a path in unknown space is measured


def depths_of(rule: str | float) -> tuple[float, ...]:
    """Return the depths in unknown space that a rule allows in turn, metres.

    Raises:
        UnknownNameError: No such rule.
        InvalidValueError: A negative depth.
    """
    if isinstance(rule, str):
        named = {"free": DEPTHS[-1:], "avoid": DEPTHS, "forbid": DEPTHS[:1]}
        return named[require_choice("unknown", rule, UNKNOWN_RULES)]
    if not (isinstance(rule, Real) and (is_number(rule) or rule == math.inf) and rule >= 0):
        raise InvalidValueError(f"unknown must be a rule or a depth of 0 m or more, got {rule!r}")
    return (float(rule),)


def occupancy_of(scene: Scene) -> OccupancyGrid:
    """Return a scene's occupancy.

    Raises:
        InvalidValueError: The scene has none; the message gives the alternatives.
    """
    return require_occupancy(
        scene.occupancy,
        scene.name,
        'unknown="avoid", "forbid" or a depth, or unexplained=True',
        'plan with unknown="free"',
    )


def unknown_boxes(scene: Scene, robot: Robot, start: npt.ArrayLike, depth: float = 0.0) -> ShapeArrays:
    """Return boxes over the unknown space within reach that the arm must not enter.

    The space of the arm and its cart at the start counts as known, and so does the inside of tomatoes. Beyond the reach
    the boxes extend or end, whichever takes fewer of them.

    Args:
        scene: The scene; it must have an occupancy.
        robot: The arm.
        start: (joints,) its configuration, radians.
        depth: Distance from known space up to which unknown space may be entered, metres.
    """
    space = occupancy_of(scene)
    depths, beyond = _depths(ByIdentity(scene), robot, tuple(np.asarray(start, dtype=np.float64).tolist()))
    return boxes_covering((depths > depth) & ~beyond, space.origin, space.voxel, optional=beyond)


def guarded(scene: Scene, robot: Robot, start: npt.ArrayLike, depth: float = 0.0) -> CompiledScene:
    """Compile a scene with `unknown_boxes` as additional clutter; the last results are cached."""
    return _guarded(ByIdentity(scene), robot, tuple(np.asarray(start, dtype=np.float64).tolist()), float(depth))


def unknown_length(scene: Scene, robot: Robot, path: Array) -> float:
    """Return the length of the tip's path with any part of the arm in unknown space, for a path (k, joints), metres."""
    return unknown_lengths(scene, robot, [path])[0][0]


def unknown_lengths(scene: Scene, robot: Robot, paths: Sequence[Array]) -> list[tuple[float, float]]:
    """Return `unknown_length` and the whole length of the tip's path, metres, of paths (k, joints) from one start."""
    compiled = guarded(scene, robot, paths[0][0])
    model = planning_model(compiled, 0, margin=0.0, pairs=("clutter",))
    tomatoes, stems, clutter = scene.counts
    first = compiled.obstacle_geoms.start + tomatoes + stems
    known = slice(first, first + clutter)
    model.geom_contype[known] = model.geom_conaffinity[known] = 0
    checker = search_checker(model, arm_reaches(robot))
    chain = tool_chain(compiled.model, compiled.tip_site)
    return [_unknown_and_whole(checker, chain, np.asarray(path)) for path in paths]


def _unknown_and_whole(checker: CollisionChecker, chain: Chain, path: Array) -> tuple[float, float]:
    """Return both lengths of a path by a checker for which only unknown space is an obstacle."""
    configurations = along_path(path, checker.reaches, _RESOLUTION)
    inside = ~checker.are_free(configurations)
    steps = np.linalg.norm(np.diff(tool_state(chain, configurations, 0.0).point, axis=0), axis=-1)
    return float(steps[inside[:-1] | inside[1:]].sum()), float(steps.sum())


@dataclass(frozen=True, eq=False)
class ByIdentity:
    """A scene as a cache key, compared by identity: scenes are never changed."""

    scene: Scene

    def __hash__(self) -> int:
        return id(self.scene)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ByIdentity) and self.scene is other.scene


@lru_cache(maxsize=16)
def _guarded(key: ByIdentity, robot: Robot, start: tuple[float, ...], depth: float) -> CompiledScene:
    scene = key.scene
    if not np.isinf(depth):
        scene = scene.with_space(unknown_boxes(scene, robot, start, depth))
    doublings = math.ceil(math.log2(max(scene.count / _SLOTS, 1.0)))  # empty models of many sizes would take long
    return compile_scene(scene, robot, min(_SLOTS << doublings, MAX_CAPACITY))


@lru_cache(maxsize=4)
def _depths(key: ByIdentity, robot: Robot, start: tuple[float, ...]) -> tuple[Array, Cells]:
    """Return the depth (x, y, z) of each voxel in unknown space, metres, 0 if known; and which lie beyond the reach."""
    scene = key.scene
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
    """Return which points (n, 3) lie inside a tomato, (n,)."""
    inside = np.zeros(len(points), dtype=np.bool_)
    if tomatoes:
        shapes = [tomato.shape for tomato in tomatoes]
        centers, radii = bounding_balls(shapes)
        away, _ = cKDTree(centers).query(points, distance_upper_bound=float(radii.max()))
        near = np.isfinite(away)
        inside[near] = distance_to_shapes(points[near], shapes).min(axis=1) < 0
    return inside


def boxes_around_arm(scene: Scene, robot: Robot, start: npt.ArrayLike) -> list[tuple[Array, Array, Array]]:
    """Return center, half extents and rotation of a box around each geom of the arm at its start and of its cart."""
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
