"""Commands along a path with proven motions between them, because between two commands the arm leaves the path."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import LEAVES, MARGIN, CollisionChecker, planning_model
from greenhouse_gym.motion.path import CORNER_TOLERANCE, follow_path
from greenhouse_gym.scene.mjcf import CompiledScene

_MAX_HALVINGS = 4  # of the corner tolerance


def free_commands(
    compiled: CompiledScene,
    target: int,
    path: npt.ArrayLike,
    velocity_limits: npt.ArrayLike,
    acceleration_limits: npt.ArrayLike,
    interval: float,
    leaves: str = LEAVES[0],
) -> Array:
    """Return commands at equal intervals along a path such that the straight motions between them are free.

    They keep half of the planner's margin. If a motion that cuts a corner does not, all corners are passed more slowly
    and closer to the path.

    Args:
        compiled: The scene the path was planned in.
        target: Index of the tomato.
        path: (k, n) configurations, radians, proven free.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        interval: Seconds from one command to the next.
        leaves: "brush" if the path may touch leaves.

    Returns:
        (m, n) commands of `follow_path`; the slowest ones if even those are not free.
    """
    start, lag = np.asarray(path, dtype=np.float64)[:1], compiled.robot.lag
    checker = CollisionChecker(planning_model(compiled, target, margin=MARGIN / 2, leaves=leaves))
    for halving in range(_MAX_HALVINGS + 1):
        tolerance = CORNER_TOLERANCE / 2**halving
        commands = follow_path(path, velocity_limits, acceleration_limits, interval, tolerance, lag)
        if checker.path_is_free(np.concatenate([start, commands]), MARGIN):
            break
    return commands
