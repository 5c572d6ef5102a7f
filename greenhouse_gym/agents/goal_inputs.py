"""Additional inputs of networks that choose a goal configuration: its offset, and the room around the arm there."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.features import Layout
from greenhouse_gym.envs.state import ACTION_STEP
from greenhouse_gym.geometry import Array

OFFSET, DIRECTION, CLEARANCE = "goal_offset", "goal_direction", "goal_clearance"
"""Features of a goal configuration, the last ones of a network's input."""


def goal_layout(joints: int, probes: int) -> Layout:
    """Return the layout of the features of a goal configuration."""
    return (OFFSET, joints), (DIRECTION, joints), (CLEARANCE, probes)


def observes_goal(layout: Layout) -> bool:
    """Return whether a layout has features of a goal configuration."""
    return not {OFFSET, DIRECTION, CLEARANCE}.isdisjoint(name for name, _ in layout)


def flaw_of(layout: Layout, has_critic: bool) -> str:
    """Return the reason why a layout with these features, or a critic, is invalid; empty if there is no reason."""
    if not observes_goal(layout):
        return "it has a critic, but no goal configuration to choose" if has_critic else ""
    sizes = dict(layout)
    expected = goal_layout(sizes.get("joint_position", 0), sizes.get("clearance", 0))
    if tuple(layout[-len(expected) :]) != expected or len(sizes) != len(layout):
        return f"the observation_layout must end in {[*map(list, expected)]}, each group once, as it observes a goal"
    if not 0 < sizes["joint_position"] == sizes.get("command_error"):
        return "with a goal, the observation_layout needs the groups joint_position and command_error of equal size"
    return "" if has_critic else "it observes a goal configuration, but has no critic to choose it"


def goal_parts(
    seen: Any, at: Mapping[str, slice], configuration: Any, clearance: Any, largest: Callable[[Any], Any]
) -> list[Any]:
    """Return the parts of a network's input: the observation and the features of a goal configuration.

    Args:
        seen: (n, size) observations "state", arrays or tensors.
        at: Slice of each feature in them.
        configuration: (n, j) goal configurations, radians.
        clearance: (n, p) clearances of the arm there, see `greenhouse_gym.motion.goal_options.GoalOptions`, metres.
        largest: Returns the largest absolute values (n, 1) of rows (n, j).
    """
    offset = configuration - seen[:, at["joint_position"]] - seen[:, at["command_error"]]  # from the commanded joints
    return [seen, offset, offset / largest(offset).clip(ACTION_STEP), clearance]


def goal_input(seen: Any, at: Mapping[str, slice], configuration: Array, clearance: Array) -> npt.NDArray[np.float32]:
    """Return the input of a network (n, size + features), as `goal_parts` does, for arrays."""
    parts = goal_parts(np.asarray(seen, dtype=np.float64), at, configuration, clearance, _largest)
    return np.concatenate(parts, axis=1).astype(np.float32)


def _largest(rows: Array) -> Array:
    return np.asarray(np.abs(rows).max(axis=1, keepdims=True))
