"""Actions: three kinds, which change the commanded joint positions of n simulations within the arm's limits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.state import (
    ACTION_STEP,
    DEFAULT_TIMING,
    MAX_COMMAND_ERROR,
    ControlTiming,
    State,
    control_timing,
)
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot

INTERVAL = DEFAULT_TIMING.interval
"""Time between two actions at the default rate, seconds."""

TIP_SPEED, TIP_TURN = 0.5, 1.6
"""Velocity and angular velocity of the tip for an action of 1, m/s and rad/s."""

DAMPING = 0.05
"""Damping of the least squares from tip to joint velocities; it slows the tip near singular configurations."""


class ToolMotion(NamedTuple):
    """Kinematics of the tool with respect to the joints.

    Attributes:
        anchors: (n, j, 3) points on the joint axes, scene frame, metres.
        axes: (n, j, 3) unit vectors along the joint axes, scene frame.
        tip: (n, 3) tip, scene frame, metres.
        heading: (n, 2) cosine and sine of the base's heading.
    """

    anchors: Array
    axes: Array
    tip: Array
    heading: Array


class ActionRule(Protocol):
    """Kind of action: a space and a function from actions to changes of the joints' commands.

    Pass such an object as ``action=``, or a class or function that makes one from the arm and the time between two
    actions. Compute elementwise (no 2-D matrix products), so that the numbers of a simulation do not depend on how many
    there are.

    Attributes:
        space: Space of one simulation's action: a `Box` with one axis. Actions are clipped to it.
    """

    @property
    def space(self) -> spaces.Box:
        """Space of one simulation's action."""

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return desired changes (n, j) of the joints' commands, radians (metres for slides).

        The environment then enforces the arm's position and speed limits and keeps commands near the measured joints.

        Args:
            action: (n, size) actions within the space, float64.
            state: State of the simulations, read-only.
            motion: Kinematics of their tools, read-only.
        """


ActionFactory: TypeAlias = Callable[[Robot, float], ActionRule]
ActionChoice: TypeAlias = str | ActionRule | ActionFactory


def joint_steps(robot: Robot, timing: ControlTiming = DEFAULT_TIMING) -> Array:
    """Return the change (j,) of the joints' commands by a "joint" action of 1: the step, or less for slow slides."""
    slides = np.minimum(timing.action_step, robot.velocity_limits * timing.interval)
    return np.where(robot.sliding, slides, timing.action_step)


def max_command_error(robot: Robot, timing: ControlTiming = DEFAULT_TIMING) -> float:
    """Return the maximum distance of a command from the measured joint: `MAX_COMMAND_ERROR`, or more for arms that lag.

    Joint actions at full speed are never cut, because a cut would be lost to actions that add to the last command.
    """
    step = timing.action_step
    return max(MAX_COMMAND_ERROR + (step - ACTION_STEP), step + 1.1 * robot.lag * step / timing.interval)


class JointIncrements:
    """Changes of the joints' commands by up to one step, see `joint_steps`."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(len(robot.joints))
        self.peak = joint_steps(robot, control_timing(1 / interval))

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return the action times the step."""
        return self.peak * action


class JointVelocities:
    """Joint velocities as fractions of the speed limits."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(len(robot.joints))
        self.peak = robot.velocity_limits * interval

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return the action times the change at full speed."""
        return self.peak * action


class TipVelocity:
    """Velocity and angular velocity of the tip in the base frame, by damped least squares (Wampler, 1986)."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(6)
        self._sliding = robot.sliding[:, None]
        self.scale = interval * np.array([TIP_SPEED] * 3 + [TIP_TURN] * 3)

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return joint steps that approximate the desired motion of the tip."""
        desired = (self.scale * action).reshape(-1, 2, 3)
        cosine, sine = motion.heading[:, :1], motion.heading[:, 1:]
        x = cosine * desired[..., 0] - sine * desired[..., 1]
        y = sine * desired[..., 0] + cosine * desired[..., 1]
        twist = np.stack([x, y, desired[..., 2]], axis=-1).reshape(-1, 6, 1)
        linear = np.where(self._sliding, motion.axes, np.cross(motion.axes, motion.tip[:, None] - motion.anchors))
        turning = np.where(self._sliding, 0.0, motion.axes)
        jacobian = np.concatenate([linear, turning], axis=-1).transpose(0, 2, 1)  # (n, 6, j)
        turned = np.ascontiguousarray(jacobian.transpose(0, 2, 1))
        square = np.ascontiguousarray(jacobian) @ turned + DAMPING**2 * np.eye(6)
        return np.asarray((turned @ np.linalg.solve(square, twist))[..., 0])


ACTIONS: dict[str, ActionFactory] = {
    "joint": JointIncrements,
    "joint_velocity": JointVelocities,
    "tip_velocity": TipVelocity,
}
"""Kinds of actions by name."""


def with_controls(space: spaces.Box, controls: Sequence[str]) -> spaces.Box:
    """Return the space of actions with further entries from -1 to 1."""
    if not controls:
        return space
    more = np.ones(len(controls), dtype=space.low.dtype)
    return spaces.Box(np.concatenate([space.low, -more]), np.concatenate([space.high, more]), dtype=space.dtype)  # type: ignore[arg-type]


class Command(NamedTuple):
    """Commands of n simulations and the limits that were enforced.

    Attributes:
        position: (n, j) commanded joint positions, radians.
        speed_limited: (n,) whether the change was scaled down to a speed limit.
        position_limited: (n,) number of joints stopped at a position limit.
    """

    position: Array
    speed_limited: npt.NDArray[np.bool_]
    position_limited: npt.NDArray[np.int64]


class CommandLimits:
    """Speed and position limits on commands, which also stay near the measured joints.

    A change that would exceed the speed limit of a joint is scaled down as a whole, which keeps its direction.

    Args:
        robot: The arm.
        rule: The kind of action.
        timing: Timing of actions.
    """

    def __init__(self, robot: Robot, rule: ActionRule, timing: ControlTiming = DEFAULT_TIMING):
        self._max_error = max_command_error(robot, timing)
        self._max_change = robot.velocity_limits * timing.interval
        self._lower, self._upper = robot.lower, robot.upper
        # a rule of a user may break its promise
        peak = rule.peak if isinstance(rule, JointIncrements | JointVelocities) else np.inf
        self._may_exceed = bool((peak > self._max_change * (1 + 1e-9)).any())
        self._never: dict[int, npt.NDArray[np.bool_]] = {}

    def __call__(self, command: Array, change: Array, joints: Array) -> Command:
        """Return the next commands.

        Args:
            command: (n, j) last commands, radians.
            change: (n, j) desired changes, radians.
            joints: (n, j) measured joint positions, radians.
        """
        if self._may_exceed:
            excess = (np.abs(change) / self._max_change).max(axis=-1)
            speed_limited = np.asarray(excess > 1 + 1e-9)
            change = change / np.maximum(excess, 1.0)[:, None]
        else:
            speed_limited = self._never.setdefault(len(command), np.zeros(len(command), dtype=np.bool_))
        moved = np.minimum(np.maximum(command + change, joints - self._max_error), joints + self._max_error)
        position = np.minimum(np.maximum(moved, self._lower), self._upper)
        return Command(position, speed_limited, (position != moved).sum(axis=-1))


def check_actions(actions: Any, count: int, space: spaces.Box) -> Array:
    """Return the actions of ``count`` simulations as float64, clipped to the space.

    Raises:
        InvalidValueError: The actions have the wrong shape or are not finite.
    """
    shape = (count, *space.shape)
    try:
        given = np.asarray(actions)
        array = given.astype(np.float64) if given.dtype.kind in "buif" else None
    except (TypeError, ValueError, RuntimeError):  # of other libraries' arrays
        array = None
    if array is None:
        raise InvalidValueError(f"an action must be real numbers of shape {shape}, got {actions!r}")
    if array.shape != shape:
        raise InvalidValueError(f"an action must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InvalidValueError(f"an action must be finite, got {array[tuple(where)]} at index {where}")
    return np.minimum(np.maximum(array, space.low), space.high)


def squared_norm(action: Array) -> Array:
    """Return the effort (n,), the sum of squares of each action."""
    return np.asarray((action * action).sum(axis=-1))


def _unit_box(size: int) -> spaces.Box:
    """Return the space of ``size`` numbers in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (size,), dtype=np.float32)
