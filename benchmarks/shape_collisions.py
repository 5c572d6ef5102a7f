"""Whether an arm among extracted shapes collides where it collides among the true ones, in MuJoCo, as scenes do.

Configurations are drawn evenly between the joint limits; those whose tip lies near a point of the cloud count. The
truth is compared in two ways. What the recording could show of it must not be missing from the shapes: pieces of the
visible stems and leaves, and the visible tomatoes whole. What the shapes claim must be there: all of the true row.
Both hold the same floor and cart, and the arm itself, which therefore cannot make a difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.accuracy import VisibleRow
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.plant_row import STEM_LINE
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, Sphere, distance_to_shapes, pose, transformed
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

NEAR = 0.3
"""Metres from a point of the cloud within which the tip must lie."""


class Collisions(NamedTuple):
    """Counts over the configurations looked at.

    Attributes:
        configurations: All of them.
        free_in_shapes: Those that touch none of the shapes.
        missed: Of these, those that touch the visible truth.
        free_in_truth: Those that touch nothing of the truth.
        invented: Of these, those that touch a shape.
    """

    configurations: int
    free_in_shapes: int
    missed: int
    free_in_truth: int
    invented: int


def compare_collisions(
    shapes: Sequence[Shape],
    truth: PlantRow,
    visible: VisibleRow,
    points: Array,
    stands: Sequence[float],
    configurations: int,
    seed: int = 0,
    settings: BuildSettings | None = None,
) -> Collisions:
    """Count on which configurations shapes and truth disagree.

    Args:
        shapes: What was extracted, in the world.
        truth: The grown row.
        visible: What a recording could show of it.
        points: (n, 3) the cloud in the world.
        stands: Where the arm is put up, metres along the row.
        configurations: Over all stands together.
        seed: Of the configurations.
        settings: The arm, how far it stands from the stem line, and how far it reaches.
    """
    settings = settings or BuildSettings()
    seen = [t.shape for t, shown in zip(truth.tomatoes, visible.tomatoes.visible, strict=True) if shown]
    worlds: tuple[list[Shape], ...] = (
        list(shapes),
        [*seen, *visible.stems, *visible.clutter],
        list(truth.shapes),
    )
    tree = cKDTree(points[:: max(1, len(points) // 50_000)])
    rng = np.random.default_rng(seed)
    total = np.zeros(5, dtype=int)
    for k, along in enumerate(stands):
        origin = np.array([STEM_LINE - settings.stem_distance, along, 0.0])
        compiled = [arm_among(world, origin, settings) for world in worlds]
        count = configurations * (k + 1) // len(stands) - configurations * k // len(stands)
        drawn = configurations_near(tree, origin, compiled[0], count, rng)
        checkers = [CollisionChecker(scene.model) for scene in compiled]
        in_shapes, in_visible, in_truth = (np.array([not c.is_free(q) for q in drawn]) for c in checkers)
        free, possible = ~in_shapes, ~in_truth
        total += [len(drawn), free.sum(), (free & in_visible).sum(), possible.sum(), (possible & in_shapes).sum()]
    return Collisions(*total.tolist())


def arm_among(shapes: Sequence[Shape], origin: Array, settings: BuildSettings) -> CompiledScene:
    """The arm above ``origin`` (3,) on the floor, among the shapes within its reach."""
    stand = ArmPlacement()
    shoulder = origin + [0.0, 0.0, stand.shoulder_height]
    near = distance_to_shapes(shoulder[None], shapes)[0] < settings.reach if shapes else []
    shift = pose(translation=-origin)
    obstacles = [plain(transformed(shape, shift)) for shape, kept in zip(shapes, near, strict=True) if kept]
    scene = Scene(name="compared", clutter=tuple(obstacles), placement=stand, provenance=Provenance(row="compared"))
    return compile_scene(scene, settings.robot)


def plain(shape: Shape) -> Sphere | Capsule | Box:
    """A shape without its meaning: any shape may stand among a scene's clutter."""
    if isinstance(shape, Ellipsoid):
        return Sphere(shape.center, shape.radius)
    return Capsule(shape.start, shape.end, shape.radius) if isinstance(shape, Capsule) else shape


def configurations_near(
    tree: cKDTree, origin: Array, compiled: CompiledScene, count: int, rng: np.random.Generator
) -> Array:
    """Random configurations (count, joints) whose tip, the arm standing at ``origin``, lies `NEAR` a tree's points."""
    robot, model = get_robot(compiled.robot), compiled.model
    data = mujoco.MjData(model)
    found: list[Array] = []
    while len(found) < count:
        drawn = rng.uniform(robot.lower, robot.upper, (2000, len(robot.lower)))
        tips = np.empty((len(drawn), 3))
        for i, q in enumerate(drawn):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            tips[i] = data.site_xpos[compiled.tip_site]
        found += list(drawn[tree.query(tips + origin)[0] < NEAR])
    return np.array(found[:count])
