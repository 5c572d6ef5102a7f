"""The task, as functions over arrays of n simulations: command, grasp point, success and reward.

Everything is elementwise, so a simulation's numbers do not depend on how many are computed at once. Points and
directions are in the frame of the arm's base: x forward to the plants, z up, origin at the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

Float32: TypeAlias = npt.NDArray[np.float32]
Bools: TypeAlias = npt.NDArray[np.bool_]

SUCCESS_RADIUS = 0.02
"""The grasp point this near to the target's center is a success, metres."""

STEP_LIMIT = 200
"""Steps after which an episode is truncated."""

SUBSTEPS = 5
"""Physics steps of 10 ms per action: 20 actions per second."""

ACTION_STEP = 0.08
"""What an action of 1 adds to a joint's command, radians."""

MAX_LEAD = 0.2
"""How far a command may lie from the measured joint, radians; at full speed the arm follows 0.1 rad behind."""


@dataclass(frozen=True, eq=False)
class Situation:
    """What n simulations look like at one moment.

    Attributes:
        joints: (n, j) joint positions, radians.
        velocities: (n, j) joint velocities, rad/s.
        command: (n, j) last commanded positions, radians.
        grasp: (n, 3) grasp point, metres.
        target: (n, 3) center of the target as the agent knows it, metres.
        distance: (n,) from the grasp point to the center of what has to be reached, metres.
        clearance: (n, k) from the arm's surface at its probe points to the nearest obstacle, metres.
        obstacle: (n, k, 3) unit vectors from the probe points towards that obstacle, zero where it is far.
        touched: (n,) whether anything was touched in any substep since the last situation.
    """

    joints: Array
    velocities: Array
    command: Array
    grasp: Array
    target: Array
    distance: Array
    clearance: Float32
    obstacle: Float32
    touched: Bools

    @property
    def success(self) -> Bools:
        """(n,) whether the grasp point is at the target and nothing was touched."""
        return np.asarray((self.distance < SUCCESS_RADIUS) & ~self.touched)

    def select(self, ids: npt.NDArray[np.int64]) -> Situation:
        """The situation of some of the simulations."""
        return Situation(**{name: values[ids] for name, values in vars(self).items()})

    def replaced(self, ids: npt.NDArray[np.int64], fresh: Situation) -> Situation:
        """A copy with the ``fresh`` situation of some of the simulations."""
        values = {name: old.copy() for name, old in vars(self).items()}
        for name, array in values.items():
            array[ids] = getattr(fresh, name)
        return Situation(**values)


def check_actions(actions: Any, shape: tuple[int, ...]) -> Array:
    """The actions as float64 within [-1, 1].

    Raises:
        InvalidValueError: Wrong shape, or not finite.
    """
    try:
        array = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"an action must be numbers of shape {shape}, got {actions!r}") from error
    if array.shape != shape:
        raise InvalidValueError(f"an action must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InvalidValueError(f"an action must be finite, got {array[tuple(where)]} at index {where}")
    return np.clip(array, -1.0, 1.0)


def joint_command(command: Array, action: Array, joints: Array, lower: Array, upper: Array) -> Array:
    """The next command (n, j): the last one moved by the action, near the measured joints and within the limits."""
    moved = np.clip(command + ACTION_STEP * action, joints - MAX_LEAD, joints + MAX_LEAD)
    return np.clip(moved, lower, upper)


ACTIONS: dict[str, Callable[[Array, Array, Array, Array, Array], Array]] = {"joint": joint_command}
"""What an action does to the command, by name."""


def sparse_terms(before: Situation, after: Situation, action: Array) -> dict[str, Array]:
    """+1 for success, -1 for a collision."""
    return {"success": np.where(after.success, 1.0, 0.0), "collision": np.where(after.touched, -1.0, 0.0)}


def dense_terms(before: Situation, after: Situation, action: Array) -> dict[str, Array]:
    """Success +10, collision -1, progress 4 per metre, time -0.02 per step, effort -0.003 |action|^2.

    From one start, every success returns more than any crash: progress telescopes to the same 4 d in both, and time
    and effort cost at most 7.6 of the 11 between them.
    """
    return {
        "success": np.where(after.success, 10.0, 0.0),
        "collision": np.where(after.touched, -1.0, 0.0),
        "progress": 4.0 * (before.distance - after.distance),
        "time": np.full(len(action), -0.02),
        "effort": -0.003 * sum_last(action * action),
    }


REWARDS: dict[str, Callable[[Situation, Situation, Array], dict[str, Array]]] = {
    "sparse": sparse_terms,
    "dense": dense_terms,
}
"""Reward terms, each (n,), by the reward's name; the reward is their sum."""


def sum_last(values: Array) -> Array:
    """Sum over a short last axis, one column after the other, so that the result does not depend on n."""
    total = values[..., 0].copy()
    for i in range(1, values.shape[-1]):
        total += values[..., i]
    return total


def total_reward(terms: dict[str, Array]) -> Array:
    """(n,) sum of the terms, in their order."""
    return sum_last(np.stack(list(terms.values()), axis=-1))
