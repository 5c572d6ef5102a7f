"""What an agent sees: from a `Situation` of n simulations to an array that fits a Gymnasium space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from gymnasium import spaces

from greenhouse_gym.envs.reach_task import MAX_LEAD, Float32, Situation
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.field import MAX_DISTANCE

JOINT_MARGIN = 0.1
"""How far beyond its limit a joint is reported, radians (limits are soft in the physics)."""

MAX_OFFSET = 3.0
"""Positions are reported up to here along each axis, metres."""

MIN_CLEARANCE = -0.1
"""Clearances are reported down to here, metres."""


class Observation(Protocol):
    """A kind of observation.

    Attributes:
        space: The space of one simulation's observation.
        layout: Name of each group of entries with its number of entries, in order.
    """

    space: spaces.Space[Float32]
    layout: tuple[tuple[str, int], ...]

    def __call__(self, situation: Situation) -> Float32:
        """Observations (n, *space.shape), new arrays within the space."""


class StateObservation:
    """Joints, target and clearances as one vector; `TomatoReachEnv` documents every index."""

    def __init__(self, robot: Robot):
        joints, probes = len(robot.joints), len(robot.probes)
        speed = 2.0 * robot.velocity_limits
        groups = [
            ("joint_position", robot.lower - JOINT_MARGIN, robot.upper + JOINT_MARGIN),
            ("joint_velocity", -speed, speed),
            ("command_error", np.full(joints, -2 * MAX_LEAD), np.full(joints, 2 * MAX_LEAD)),
            ("grasp_offset", np.full(3, -MAX_OFFSET), np.full(3, MAX_OFFSET)),
            ("target_position", np.full(3, -MAX_OFFSET), np.full(3, MAX_OFFSET)),
            ("clearance", np.full(probes, MIN_CLEARANCE), np.full(probes, MAX_DISTANCE)),
            ("obstacle_direction", np.full(3 * probes, -1.0), np.full(3 * probes, 1.0)),
        ]
        self.layout = tuple((name, len(low)) for name, low, _ in groups)
        self.low, self.high = (
            np.concatenate(bounds).astype(np.float32) for bounds in ([g[1] for g in groups], [g[2] for g in groups])
        )
        self.space: spaces.Space[Float32] = spaces.Box(self.low, self.high, dtype=np.float32)

    def __call__(self, situation: Situation) -> Float32:
        """Observations (n, size)."""
        s = situation
        parts = (
            s.joints,
            s.velocities,
            s.command - s.joints,
            s.target - s.grasp,
            s.target,
            s.clearance,
            s.obstacle.reshape(len(s.obstacle), -1),
        )
        result = np.empty((len(s.joints), len(self.low)), dtype=np.float32)
        np.concatenate(parts, axis=1, out=result, casting="same_kind")
        np.clip(result, self.low, self.high, out=result)
        return result


OBSERVATIONS: dict[str, Callable[[Robot], Observation]] = {"state": StateObservation}
"""Kinds of observations by name."""
