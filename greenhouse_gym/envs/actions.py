"""What an action does to the commanded joint positions of n simulations: three kinds, one set of limits."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.reach_task import (
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
"""Seconds from one action to the next at the usual rate."""

TIP_SPEED, TIP_TURN = 0.5, 1.6
"""What a tip action of 1 asks for: metres per second, radians per second."""

DAMPING = 0.05
"""Damping of the least squares from tip to joint velocities: near singular configurations the tip slows."""


class ToolMotion(NamedTuple):
    """How the tool moves with the joints.

    Attributes:
        anchors: (n, j, 3) points on the joints' axes, scene frame, metres.
        axes: (n, j, 3) unit vectors along the joints' axes, scene frame.
        tip: (n, 3) the tip, scene frame, metres.
        heading: (n, 2) cosine and sine of the base's heading.
    """

    anchors: Array
    axes: Array
    tip: Array
    heading: Array


class ActionRule(Protocol):
    """A kind of action: its space, and what an action does.

    ``action=`` takes an object like this, or a class or function that makes one from the arm and the seconds between
    two actions. Compute elementwise (no 2-D matrix products), so that a simulation's numbers do not depend on how many
    there are.

    Attributes:
        space: The space of one simulation's action: a `Box` of one axis. Actions are clipped to it.
    """

    @property
    def space(self) -> spaces.Box:
        """The space of one simulation's action."""

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Wished changes (n, j) of the joints' commands, radians (metres for slides).

        The environment keeps them to the arm's limits of position and speed, and near the measured joints.

        Args:
            action: (n, size) actions within the space, float64.
            state: What the simulations look like; read only.
            motion: How their tools move with the joints; read only.
        """


ActionFactory: TypeAlias = Callable[[Robot, float], ActionRule]
ActionChoice: TypeAlias = str | ActionRule | ActionFactory


def joint_steps(robot: Robot, timing: ControlTiming = DEFAULT_TIMING) -> Array:
    """(j,) what an entry of 1 of a "joint" action adds to the joints' commands: the step, less for slow slides."""
    slides = np.minimum(timing.action_step, robot.velocity_limits * timing.interval)
    return np.where(robot.sliding, slides, timing.action_step)


def max_command_error(robot: Robot, timing: ControlTiming = DEFAULT_TIMING) -> float:
    """How far a command may lie from the measured joint: `MAX_COMMAND_ERROR`, more for arms that lag farther behind.

    What a command is cut by is lost to actions that add to the last one, so joint actions at full speed never are.
    """
    step = timing.action_step
    return max(MAX_COMMAND_ERROR + (step - ACTION_STEP), step + 1.1 * robot.lag * step / timing.interval)


class JointIncrements:
    """Each entry moves a joint's command by up to its step, see `joint_steps`."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(len(robot.joints))
        self.peak = joint_steps(robot, control_timing(1 / interval))

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """The wished changes: the action times the step."""
        return self.peak * action


class JointVelocities:
    """Each entry is a joint's speed as a share of its speed limit."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(len(robot.joints))
        self.peak = robot.velocity_limits * interval

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """The wished changes: the action times the way that a joint goes at full speed."""
        return self.peak * action


class TipVelocity:
    """Velocity and turning velocity of the tip in the base frame, by damped least squares (Wampler, 1986)."""

    def __init__(self, robot: Robot, interval: float):
        self.space = _unit_box(6)
        self._sliding = robot.sliding[:, None]
        self._scale = interval * np.array([TIP_SPEED] * 3 + [TIP_TURN] * 3)

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Joint steps that move the tip as wished, as far as the arm can."""
        wished = (self._scale * action).reshape(-1, 2, 3)
        cosine, sine = motion.heading[:, :1], motion.heading[:, 1:]
        x = cosine * wished[..., 0] - sine * wished[..., 1]
        y = sine * wished[..., 0] + cosine * wished[..., 1]
        twist = np.stack([x, y, wished[..., 2]], axis=-1).reshape(-1, 6, 1)
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


class Command(NamedTuple):
    """Commands of n simulations, and what was cut off to get there.

    Attributes:
        position: (n, j) radians.
        speed_limited: (n,) whether the wish was slowed because a joint would have been too fast.
        position_limited: (n,) number of joints stopped at a position limit.
    """

    position: Array
    speed_limited: npt.NDArray[np.bool_]
    position_limited: npt.NDArray[np.int64]


class CommandLimits:
    """Keeps commands within the arm's limits of speed and position, and near the measured joints.

    A wish that would make a joint too fast is slowed as a whole, which keeps the direction of the motion.

    Args:
        robot: The arm.
        rule: The kind of action; its ``peak`` (j,), where it has one, is the most it may ask of each joint, radians.
        timing: How the time goes.
    """

    def __init__(self, robot: Robot, rule: ActionRule, timing: ControlTiming = DEFAULT_TIMING):
        self._max_error = max_command_error(robot, timing)
        self._way = robot.velocity_limits * timing.interval
        self._lower, self._upper = robot.lower, robot.upper
        self._may_be_fast = bool((getattr(rule, "peak", np.inf) > self._way * (1 + 1e-9)).any())
        self._never: dict[int, npt.NDArray[np.bool_]] = {}

    def __call__(self, command: Array, change: Array, joints: Array) -> Command:
        """The next commands.

        Args:
            command: (n, j) the last commands, radians.
            change: (n, j) wished changes.
            joints: (n, j) measured joint positions.
        """
        if self._may_be_fast:
            excess = (np.abs(change) / self._way).max(axis=-1)
            speed_limited = np.asarray(excess > 1 + 1e-9)
            change = change / np.maximum(excess, 1.0)[:, None]
        else:
            speed_limited = self._never.setdefault(len(command), np.zeros(len(command), dtype=np.bool_))
        moved = np.minimum(np.maximum(command + change, joints - self._max_error), joints + self._max_error)
        position = np.minimum(np.maximum(moved, self._lower), self._upper)
        return Command(position, speed_limited, (position != moved).sum(axis=-1))


def check_actions(actions: Any, count: int, space: spaces.Box) -> Array:
    """The actions of ``count`` simulations as float64 within the space.

    Raises:
        InvalidValueError: Wrong shape, or not finite.
    """
    shape = (count, *space.shape)
    try:
        array = np.asarray(actions, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InvalidValueError(f"an action must be numbers of shape {shape}, got {actions!r}") from error
    if array.shape != shape:
        raise InvalidValueError(f"an action must have shape {shape}, got {array.shape}")
    if not np.isfinite(array).all():
        where = np.argwhere(~np.isfinite(array))[0].tolist()
        raise InvalidValueError(f"an action must be finite, got {array[tuple(where)]} at index {where}")
    return np.minimum(np.maximum(array, space.low), space.high)


def squared_norm(action: Array) -> Array:
    """(n,) sum of the squares of an action's entries: the effort."""
    return np.asarray((action * action).sum(axis=-1))


def _unit_box(size: int) -> spaces.Box:
    """Numbers in [-1, 1]."""
    return spaces.Box(-1.0, 1.0, (size,), dtype=np.float32)
