"""Goal configurations for an agent to choose from, with the room around the arm in each of them."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.distances import distance_to_nearest
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.motion.goals import GoalSampler, nearest_free_goals
from greenhouse_gym.motion.proof import checker_of
from greenhouse_gym.scene.mjcf import CompiledScene

MAX_OPTIONS = 24
"""Largest number of goal configurations."""


class GoalOptions(NamedTuple):
    """Collision-free goal configurations for one target, those nearest to the start first.

    Attributes:
        configurations: (k, j) radians; k = 0 if none was found.
        clearance: (k, p) distance from the arm's surface at its probe points to the nearest obstacle, the target
            excepted, metres, at most `MAX_DISTANCE` less the radius of the arm.
    """

    configurations: Array
    clearance: Array


def goal_options(compiled: CompiledScene, target: int, start: Array) -> GoalOptions:
    """Find goal configurations near a start, by inverse kinematics and collision checks alone.

    Args:
        compiled: The scene as agents know it, with its arm.
        target: Index of the target tomato.
        start: (j,) start of the arm, radians.
    """
    goals = nearest_free_goals(checker_of(compiled, target).search, GoalSampler(compiled, target, start))[:MAX_OPTIONS]
    model, scene = compiled.model, compiled.scene
    data = mujoco.MjData(model)
    points = np.empty((len(goals), len(compiled.probe_sites), 3))
    for k, configuration in enumerate(goals):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(model, data)
        points[k] = data.site_xpos[compiled.probe_sites]
    obstacles = scene.arrays.select(np.delete(np.arange(scene.count), target))
    distance = distance_to_nearest(points.reshape(-1, 3), obstacles, MAX_DISTANCE).reshape(points.shape[:2])
    return GoalOptions(goals, np.minimum(distance, MAX_DISTANCE) - compiled.robot.probe_radii)
