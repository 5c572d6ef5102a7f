"""Features: named groups of numbers from which observations are composed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.actions import max_command_error
from greenhouse_gym.envs.state import ACTION_STEP, Float32, State, lengths
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.robots import Robot

JOINT_MARGIN = 0.1
"""Margin beyond the joint limits in observations, radians (limits are soft in the physics)."""

MAX_OFFSET = 3.0
"""Bound of observed positions along each axis, metres, from an arm that does not slide."""

MIN_CLEARANCE = -0.1
"""Lower bound of observed clearances, metres."""

MAX_PATH_LENGTH = 6.3
"""Bound of observed waypoint offsets and path lengths, radians."""

Layout: TypeAlias = tuple[tuple[str, int], ...]
"""Name and size of each feature of a vector, in order."""


class Feature(NamedTuple):
    """Named group of numbers in an observation.

    Attributes:
        value: Function from the state of n simulations to numbers (n, size); elementwise over simulations.
        bounds: Function from the arm to lower and upper bounds (size,); values are clipped to them.
    """

    value: Callable[[State], npt.NDArray[Any]]
    bounds: Callable[[Robot], tuple[Array, Array]]


def _within(limit: float, size: int) -> tuple[Array, Array]:
    return np.full(size, -limit), np.full(size, limit)


def _between(low: float, high: float, size: int) -> tuple[Array, Array]:
    return np.full(size, low), np.full(size, high)


def _positions(robot: Robot) -> tuple[Array, Array]:
    """Return the bounds of positions, which a rail extends along the row."""
    rail = float(np.abs([robot.lower[0], robot.upper[0]]).max()) if robot.on_rail else 0.0
    high = np.array([MAX_OFFSET, MAX_OFFSET + rail, MAX_OFFSET])
    return -high, high


def _direction(offset: Array) -> Array:
    """Return the action (n, j) that moves a command straight by an offset (n, j) as fast as possible."""
    return np.asarray(offset / np.maximum(ACTION_STEP, np.abs(offset).max(axis=1, keepdims=True)))


def _target_direction(state: State) -> Array:
    """Return unit vectors (n, 3) from the tip to the target, which is at least its radius away before a contact."""
    offset = state.target - state.tip
    return np.asarray(offset / np.maximum(lengths(offset), 1e-6)[:, None])


def _turn_to_target(state: State) -> Array:
    """Return cross products (n, 3) of the tool axis and the direction to the target."""
    (ax, ay, az), (bx, by, bz) = state.axis.T, _target_direction(state).T  # np.cross takes ten times as long for one
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=1)


FEATURES: Mapping[str, Feature] = MappingProxyType(
    {
        "joint_position": Feature(lambda s: s.joints, lambda r: (r.lower - JOINT_MARGIN, r.upper + JOINT_MARGIN)),
        "joint_velocity": Feature(
            lambda s: s.velocities, lambda r: (-2.0 * r.velocity_limits, 2.0 * r.velocity_limits)
        ),
        "command_error": Feature(lambda s: s.command_error, lambda r: _within(2 * max_command_error(r), len(r.joints))),
        "grasp_offset": Feature(lambda s: s.target - s.grasp, lambda r: _within(MAX_OFFSET, 3)),
        "target_position": Feature(lambda s: s.target, _positions),
        "target_direction": Feature(_target_direction, lambda r: _within(1.0, 3)),
        "turn_to_target": Feature(_turn_to_target, lambda r: _within(1.0, 3)),
        "tip_position": Feature(lambda s: s.tip, _positions),
        "tool_axis": Feature(lambda s: s.axis, lambda r: _within(1.0, 3)),
        "clearance": Feature(lambda s: s.clearance, lambda r: _between(MIN_CLEARANCE, MAX_DISTANCE, len(r.probes))),
        "obstacle_direction": Feature(
            lambda s: s.obstacle.reshape(len(s.obstacle), -1), lambda r: _within(1.0, 3 * len(r.probes))
        ),
        "unknown": Feature(lambda s: s.unknown, lambda r: _between(0.0, 1.0, len(r.probes))),
        "waypoint_offset": Feature(lambda s: s.waypoint, lambda r: _within(MAX_PATH_LENGTH, len(r.joints))),
        "waypoint_direction": Feature(lambda s: _direction(s.waypoint), lambda r: _within(1.0, len(r.joints))),
        "path": Feature(
            lambda s: np.stack([s.path_length, s.path_free], axis=1),
            lambda r: (np.zeros(2), np.array([MAX_PATH_LENGTH, 1.0])),
        ),
    }
)
"""Features by name."""


class FeatureVector:
    """Concatenated features, clipped to their bounds.

    Args:
        robot: The arm.
        features: The features in order.

    Attributes:
        layout: Name and size of each feature.
        space: Space of the vector of one simulation.
    """

    def __init__(self, robot: Robot, features: Mapping[str, Feature]):
        self._values = [feature.value for feature in features.values()]
        bounds = [feature.bounds(robot) for feature in features.values()]
        self.layout: Layout = tuple((name, len(low)) for name, (low, _) in zip(features, bounds, strict=True))
        self._low, self._high = (np.concatenate(side).astype(np.float32) for side in zip(*bounds, strict=True))
        self.space = spaces.Box(self._low, self._high, dtype=np.float32)

    def __call__(self, state: State) -> Float32:
        """Return the vectors (n, size)."""
        result = np.empty((len(state.joints), len(self._low)), dtype=np.float32)
        np.concatenate([value(state) for value in self._values], axis=1, out=result, casting="same_kind")
        np.maximum(result, self._low, out=result)
        np.minimum(result, self._high, out=result)
        return result


def feature_slices(layout: Layout) -> dict[str, slice]:
    """Return the slice of each feature in a vector of this layout."""
    ends = np.cumsum([size for _, size in layout]).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(layout, ends, strict=True)}
