"""Smallest distance of an arm from the obstacles of a scene, in configurations and along paths."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import LEAVES, CollisionChecker, clearance_model, set_margin
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import RANGE, gaps_in, kernel_world
from greenhouse_gym.motion.path import along_path
from greenhouse_gym.scene.mjcf import CompiledScene

CLEARANCE_RANGE = RANGE
"""Largest clearance that is measured, metres."""

_STEP = 0.01  # metres that any point of the arm moves between two measurements of a path's clearance
_SLACK = 2e-5  # metres, more than the distances of the kernels and of MuJoCo differ


def path_clearance(compiled: CompiledScene, target: int, path: npt.ArrayLike, leaves: str = LEAVES[0]) -> float:
    """Return the smallest distance of the arm from obstacles along a path (k, joints), up to `CLEARANCE_RANGE`, metres.

    The target, the floor, the cart, and leaves that give way (``leaves="brush"``) do not count. It is measured at
    configurations between which no point of the arm moves farther than 1 cm; negative inside an obstacle.
    """
    configurations = along_path(np.asarray(path, dtype=np.float64), arm_reaches(compiled.robot), _STEP)
    return smallest_clearance(compiled, compiled.model, target, configurations, leaves)


def smallest_clearance(
    compiled: CompiledScene, model: mujoco.MjModel, target: int, configurations: Array, leaves: str = LEAVES[0]
) -> float:
    """Return the smallest distance of the arm from obstacles in some configurations, up to `CLEARANCE_RANGE`.

    The target, the floor, the cart, the arm itself, and leaves that give way do not count.

    Args:
        compiled: The scene.
        model: Its model, or a copy with the arm at another position.
        target: Index of the target tomato.
        configurations: (k, joints) radians.
        leaves: One of `greenhouse_gym.motion.collision.LEAVES`.

    Returns:
        Metres; negative inside an obstacle.
    """
    model = clearance_model(compiled, model, target, leaves)
    configurations = _nearest(model, configurations)
    set_margin(model, np.arange(compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop), CLEARANCE_RANGE)
    checker, smallest, safe = CollisionChecker(model), CLEARANCE_RANGE, 0.0
    moved = np.abs(np.diff(configurations, axis=0, prepend=configurations[:1])) @ arm_reaches(compiled.robot)
    for configuration, motion in zip(configurations, moved.tolist(), strict=True):
        safe -= motion  # no point has moved farther
        if safe <= 0:
            clearance = min(CLEARANCE_RANGE, checker.clearance(configuration))
            smallest = min(smallest, clearance)
            safe = clearance - max(smallest, 0.0)
    return smallest


def _nearest(model: mujoco.MjModel, configurations: Array) -> Array:
    """Return the configurations among (k, joints) that may be nearest to a contact, by kernels if possible."""
    world = kernel_world(model)
    if world is None:
        return configurations
    gaps = gaps_in(world, configurations[::-1], -_SLACK)[::-1]  # most paths are narrowest at their ends
    limit = max(gaps.min(initial=RANGE), 0.0)  # the depth inside an obstacle is left to MuJoCo
    return configurations[(gaps < RANGE) & (gaps <= limit + _SLACK)]
