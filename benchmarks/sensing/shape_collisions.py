"""Comparison of an arm's collisions among extracted shapes with those among the true ones, in MuJoCo.

Configurations are sampled uniformly between the joint limits; those whose tip lies near a point of the cloud count.
Collisions with the visible truth (visible pieces of stems and leaves, and whole visible tomatoes) must not be missed
among the shapes; collisions with the shapes must exist in the whole truth. Floor, cart and arm are the same in both.
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
from greenhouse_gym.crops.crop import STEM_LINE
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, Sphere, distance_to_shapes, pose, transformed
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import ArmPlacement, Provenance, Scene
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene

NEAR = 0.3
"""Maximum distance of the tip from a point of the cloud, m."""


class Collisions(NamedTuple):
    """Counts of sampled configurations.

    Attributes:
        configurations: All configurations.
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
    """Count the configurations on which shapes and truth disagree.

    Args:
        shapes: Extracted shapes in the world frame.
        truth: The grown row.
        visible: Parts of it that the recording could show.
        points: (n, 3) cloud in the world frame.
        stands: Arm placements along the row, m.
        configurations: Number of configurations over all arm placements.
        seed: Seed of the configurations.
        settings: The arm, its distance from the stem line, and its reach.
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
    """Return the arm above ``origin`` (3,) on the floor, among the shapes within its reach."""
    stand = ArmPlacement()
    shoulder = origin + [0.0, 0.0, stand.shoulder_height]
    near = distance_to_shapes(shoulder[None], shapes)[0] < settings.reach if shapes else []
    shift = pose(translation=-origin)
    obstacles = [plain(transformed(shape, shift)) for shape, kept in zip(shapes, near, strict=True) if kept]
    scene = Scene(name="compared", clutter=tuple(obstacles), placement=stand, provenance=Provenance(row="compared"))
    return compile_scene(scene, settings.robot)


def plain(shape: Shape) -> Sphere | Capsule | Box:
    """Return the geometric shape of a plant part, which any scene's clutter may hold."""
    if isinstance(shape, Ellipsoid):
        return Sphere(shape.center, shape.radius)
    return Capsule(shape.start, shape.end, shape.radius) if isinstance(shape, Capsule) else shape


def configurations_near(
    tree: cKDTree, origin: Array, compiled: CompiledScene, count: int, rng: np.random.Generator
) -> Array:
    """Sample configurations (count, joints) of the arm at ``origin`` whose tip lies `NEAR` a tree's points."""
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
