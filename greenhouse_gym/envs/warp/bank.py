"""Scenes of a bank as arrays: shapes, arm placements and tomatoes, and the table from which episodes are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.executors import usable_cores
from greenhouse_gym.envs.episodes import UNRATED, EpisodeSampler
from greenhouse_gym.envs.warp.arm import Ints, matrix
from greenhouse_gym.envs.worlds import spheres_in_base
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Box, ShapeArrays, arrays_of, transform
from greenhouse_gym.geometry.distances import distance_to_nearest
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, SPHERE
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.distance_field import NODE, SHAPE, obstacle_field
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import DIFFICULTIES, ArmPlacement, Provenance, Scene, compile_scene
from greenhouse_gym.scene.mjcf import arm_pose
from greenhouse_gym.scene.obstacle_slots import MIN_LENGTH
from greenhouse_gym.scene.truth import own_start, true_scene

RATINGS = (*DIFFICULTIES, UNRATED)
"""Ratings of targets by index."""


@dataclass(frozen=True, eq=False)
class ShapeTable:
    """Shapes of s scenes in one table of m rows, in the frames of their scenes, metres.

    Attributes:
        first: (s,) first row of each scene.
        count: (s,) number of rows of each scene.
        kind: (m,) kind of shape, as in `greenhouse_gym.geometry.shape_arrays`.
        center: (m, 3) center.
        rotation: (m, 3, 3) rotation; the axis of a capsule is its z axis.
        size: (m, 3) radius; radius and half length; semi-axes; half extents.
        bound: (m,) radius of the ball around the center that encloses the shape.
    """

    first: Ints
    count: Ints
    kind: Ints
    center: Array
    rotation: Array
    size: Array
    bound: Array


@dataclass(frozen=True, eq=False)
class SceneArrays:
    """Arm placements of s scenes and their t tomatoes.

    Attributes:
        base: (s, 3) the arm's base in the scene, metres.
        heading: (s, 3, 3) rotation from the base frame, in which observations are, to the scene.
        arm_rotation: (s, 3, 3) rotation of the arm's first body in the scene.
        floor: (s,) height of the floor, metres.
        start: (s, n) the arm's own start, see `greenhouse_gym.scene.truth.own_start`, radians.
        fixtures: (s,) rows of each scene's shapes before its tomatoes.
        tomato_first: (s,) first tomato of each scene.
        scene: (t,) scene of each tomato.
        tomato: (t,) its index in the scene.
        shape: (t,) row of the simulated tomato, counted from the scene's first.
        target: (t, 3) observed center in the base frame, metres.
        goal: (t, 3) simulated center in the base frame, metres.
        radius: (t,) simulated radius, metres.
        rating: (t,) index into `RATINGS`.
    """

    base: Array
    heading: Array
    arm_rotation: Array
    floor: Array
    start: Array
    fixtures: Ints
    tomato_first: Ints
    scene: Ints
    tomato: Ints
    shape: Ints
    target: Array
    goal: Array
    radius: Array
    rating: Ints


class Bank(NamedTuple):
    """Arrays of a bank's scenes.

    Attributes:
        scenes: Placements and tomatoes.
        shapes: Shapes that the arm may touch, those of the true rows if they are simulated; the cart comes first.
        fields: (s, nodes) nodes of the distance fields of the scenes as agents know them.
    """

    scenes: SceneArrays
    shapes: ShapeTable
    fields: npt.NDArray[np.void]


@dataclass(frozen=True, eq=False)
class DrawTable:
    """Distribution of episodes: an entry is drawn, then one of its tomatoes.

    Attributes:
        cumulative: (e,) probability of this or an earlier entry, float32.
        first: (e,) first of the entry's rows.
        count: (e,) number of its rows.
        row: (r,) tomatoes of the entries, indices into `SceneArrays`.
    """

    cumulative: npt.NDArray[np.float32]
    first: Ints
    count: Ints
    row: Ints

    @classmethod
    def of(cls, chances: Sequence[float], rows: Sequence[Sequence[int]]) -> DrawTable:
        """Return the table of entries with these probabilities and rows."""
        count = np.array([len(entry) for entry in rows], dtype=np.int32)
        cumulative = np.cumsum(chances).astype(np.float32)
        cumulative[-1] = 1.0
        together = np.array([row for entry in rows for row in entry], dtype=np.int32)
        return cls(cumulative, (np.cumsum(count) - count).astype(np.int32), count, together)


def bank_of(scenes: Sequence[Scene], sampler: EpisodeSampler, physics: str) -> Bank:
    """Return scenes as arrays.

    Args:
        scenes: The scenes.
        sampler: Sampler of episodes, which rates the targets.
        physics: "reconstruction" or "truth".

    Raises:
        InvalidValueError: A scene carries no truth although the physics need it.
    """
    robot, truth = sampler.robot, physics == "truth"
    placements: list[_Placement] = []
    tables = []
    columns: dict[str, list[Any]] = {name: [] for name in ("scene", "tomato", "shape", "target", "goal", "radius")}
    ratings: list[int] = []
    starts: list[Array] = []
    for s, scene in enumerate(scenes):
        physical = true_scene(scene) if truth else scene
        placement = _placement(scene.placement.model_dump_json(), robot)
        placements.append(placement)
        cart = placement.cart
        tables.append(_table(cart, physical.arrays))
        starts.append(_start(physical, robot, placement.scene_from_base) if truth else robot.start)
        targets = spheres_in_base(scene, placement.scene_from_base).astype(np.float32).astype(np.float64)
        goals, bodies = targets, np.arange(len(targets))
        if truth:
            exact, there = (spheres_in_base(x, placement.scene_from_base) for x in (scene, physical))
            bodies = np.linalg.norm(exact[:, None, :3] - there[None, :, :3], axis=-1).argmin(axis=1)
            goals = there[bodies]
        columns["scene"].append(np.full(len(targets), s))
        columns["tomato"].append(np.arange(len(targets)))
        columns["shape"].append(bodies + len(cart.kinds))
        columns["target"].append(targets[:, :3])
        columns["goal"].append(goals[:, :3])
        columns["radius"].append(goals[:, 3])
        rated = {target.tomato: sampler.rating(target) for target in sampler.fitting(scene, DIFFICULTIES)}
        ratings += [RATINGS.index(rated.get(k, UNRATED)) for k in range(len(targets))]
    whole: dict[str, Any] = {name: np.concatenate(parts) for name, parts in columns.items()}
    counts = np.bincount(whole["scene"].astype(np.int64), minlength=len(scenes))
    arrays = SceneArrays(
        base=np.array([p.scene_from_base[:3, 3] for p in placements]),
        heading=np.array([p.scene_from_base[:3, :3] for p in placements]),
        arm_rotation=np.array([p.arm_rotation for p in placements]),
        floor=np.array([p.floor for p in placements]),
        start=np.array(starts),
        fixtures=np.array([len(p.cart.kinds) for p in placements], dtype=np.int32),
        tomato_first=np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int32),
        rating=np.array(ratings, dtype=np.int32),
        **{name: whole[name].astype(np.int32) for name in ("scene", "tomato", "shape")},
        **{name: whole[name] for name in ("target", "goal", "radius")},
    )
    return Bank(arrays, _joined(tables), _fields(scenes, placements))


def draw_table(scenes: Sequence[Scene], sampler: EpisodeSampler, tomato_first: Ints) -> DrawTable:
    """Return the distribution of `EpisodeSampler.draw`: a difficulty if they have weights, a scene, one of its targets.

    Raises:
        InvalidValueError: No target has one of the difficulties.
    """
    weights = sampler.difficulty
    total = sum(weights.values())
    groups = {(name,): weight / total for name, weight in weights.items()} if total else {tuple(weights): 1.0}
    chances: list[float] = []
    rows: list[list[int]] = []
    for names, weight in groups.items():
        fitting = [
            [int(first) + target.tomato for target in sampler.fitting(scene, names)]
            for scene, first in zip(scenes, tomato_first, strict=True)
        ]
        fitting = [entry for entry in fitting if entry]
        if not fitting:
            raise InvalidValueError(sampler.nothing_fits(f"split {sampler.split!r} of bank {sampler.bank.path}", names))
        chances += [weight / len(fitting)] * len(fitting)
        rows += fitting
    return DrawTable.of(chances, rows)


class _Placement(NamedTuple):
    """Pose of the arm's base in a scene, rotation of its first body, height of the floor, and the cart, if any."""

    scene_from_base: Array
    arm_rotation: Array
    floor: float
    cart: ShapeArrays


@lru_cache(maxsize=4096)
def _placement(written: str, robot: Robot) -> _Placement:
    """Compute what a placement of the arm, written as JSON, gives; composed scenes share those of their stands."""
    placement = ArmPlacement.model_validate_json(written)
    scene = Scene(name="placement", placement=placement, provenance=Provenance(row=""))
    compiled = compile_scene(scene, robot)
    model = compiled.model
    fixtures = range(model.geom("floor").id + 1, compiled.obstacle_geoms.start)
    return _Placement(
        arm_pose(scene, robot),
        matrix(model.body_quat[1]),
        float(model.geom("floor").pos[2]),
        arrays_of([Box(model.geom_pos[g], model.geom_size[g], matrix(model.geom_quat[g])) for g in fixtures]),
    )


def _start(true: Scene, robot: Robot, scene_from_base: Array) -> Array:
    """Return the arm's own start in a true row, compiled only where something is near."""
    arm = arm_spheres(robot)
    centers = transform(scene_from_base, arm.centers(robot.start[None])[0])
    near = distance_to_nearest(centers, true.arrays, float(arm.radius.max())) <= arm.radius
    return own_start(compile_scene(true, robot)) if near.any() else robot.start


def _fields(scenes: Sequence[Scene], placements: Sequence[_Placement]) -> npt.NDArray[np.void]:
    """Return the nodes (s, nodes) of the distance fields, computed on all cores."""
    fields = np.empty((len(scenes), *SHAPE), dtype=NODE)

    def fill(scene: Scene, placement: _Placement, nodes: npt.NDArray[np.void]) -> None:
        out = nodes.reshape(-1).view(np.uint64)
        obstacle_field(scene.arrays, len(scene.tomatoes), placement.scene_from_base, out)

    with ThreadPoolExecutor(usable_cores()) as threads:
        list(threads.map(fill, scenes, placements, fields))
    return fields


def _table(cart: ShapeArrays, shapes: ShapeArrays) -> ShapeTable:
    """Return the shapes of one scene after its cart."""
    both = ShapeArrays._make(np.concatenate([getattr(x, name) for x in (cart, shapes)]) for name in ShapeArrays._fields)
    kinds, starts, ends, sizes, rotations = both
    axes = (ends - starts) / 2
    half = np.linalg.norm(axes, axis=1)
    kinds = np.where((kinds == CAPSULE) & (2 * half <= MIN_LENGTH), SPHERE, kinds)
    capsule = kinds == CAPSULE
    rotations, sizes = rotations.copy(), sizes.copy()
    rotations[capsule, :, 2] = axes[capsule] / half[capsule, None]  # the kernels read no other column
    sizes[capsule, 1] = half[capsule]
    bound = np.where(kinds == BOX, np.linalg.norm(sizes, axis=1), sizes.max(axis=1))
    bound[capsule] = sizes[capsule, :2].sum(axis=1)
    count = np.array([len(kinds)], dtype=np.int32)
    return ShapeTable(
        np.zeros(1, dtype=np.int32), count, kinds.astype(np.int32), (starts + ends) / 2, rotations, sizes, bound
    )


def _joined(tables: Sequence[ShapeTable]) -> ShapeTable:
    count = np.concatenate([table.count for table in tables])
    columns = {
        name: np.concatenate([getattr(table, name) for table in tables])
        for name in ("kind", "center", "rotation", "size", "bound")
    }
    return ShapeTable((np.cumsum(count) - count).astype(np.int32), count.astype(np.int32), **columns)
