"""What an action does to the commanded joint positions of n simulations: three kinds, one set of limits."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.reach_task import ACTION_STEP, MAX_LEAD, SUBSTEPS
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.mjcf import TIMESTEP

INTERVAL = SUBSTEPS * TIMESTEP
"""Seconds from one action to the next."""

TIP_SPEED, TIP_TURN = 0.5, 1.6
"""What a tip action of 1 asks for: metres per second, radians per second."""

DAMPING = 0.05
"""Of the least squares that turn tip velocities into joint velocities: near singular configurations the tip slows."""


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
    """A kind of action.

    Attributes:
        size: Entries of an action, each in [-1, 1].
        needs_motion: Whether it reads the `ToolMotion`.
        peak: (j,) the most it may ask of each joint, radians per action; inf where unbounded.
    """

    size: int
    needs_motion: bool
    peak: Array

    def __call__(self, action: Array, motion: ToolMotion | None) -> Array:
        """Wished changes (n, j) of the commands, radians, for actions (n, size)."""


def joint_steps(robot: Robot) -> Array:
    """(j,) what an entry of 1 of a "joint" action adds to the joints' commands: `ACTION_STEP`, less for slow slides."""
    slides = np.minimum(ACTION_STEP, robot.velocity_limits * INTERVAL)
    return np.where(robot.sliding, slides, ACTION_STEP)


def max_lead(robot: Robot) -> float:
    """How far a command may lie from the measured joint: `MAX_LEAD`, more for arms that lag farther behind.

    What a command is cut by is lost to actions that add to the last one, so joint actions at full speed never are.
    """
    return max(MAX_LEAD, ACTION_STEP + 1.1 * robot.lag * ACTION_STEP / INTERVAL)


class JointIncrements:
    """Each entry moves a joint's command by up to its step, see `joint_steps`."""

    needs_motion = False

    def __init__(self, robot: Robot):
        self.size = len(robot.joints)
        self.peak = joint_steps(robot)

    def __call__(self, action: Array, motion: ToolMotion | None) -> Array:
        """The action times the step."""
        return self.peak * action


class JointVelocities:
    """Each entry is a joint's speed as a share of its speed limit."""

    needs_motion = False

    def __init__(self, robot: Robot):
        self.size = len(robot.joints)
        self.peak = robot.velocity_limits * INTERVAL

    def __call__(self, action: Array, motion: ToolMotion | None) -> Array:
        """The action times the way at full speed."""
        return self.peak * action


class TipVelocity:
    """Velocity and turning velocity of the tip in the base frame, by damped least squares (Wampler, 1986)."""

    size = 6
    needs_motion = True

    def __init__(self, robot: Robot):
        self.peak = np.full(len(robot.joints), np.inf)
        self._sliding = robot.sliding[:, None]
        self._scale = INTERVAL * np.array([TIP_SPEED] * 3 + [TIP_TURN] * 3)

    def __call__(self, action: Array, motion: ToolMotion | None) -> Array:
        """Joint steps that move the tip as wished, as far as the arm can."""
        assert motion is not None
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


ACTIONS: dict[str, type[JointIncrements] | type[JointVelocities] | type[TipVelocity]] = {
    "joint": JointIncrements,
    "joint_velocity": JointVelocities,
    "tip_velocity": TipVelocity,
}
"""Kinds of actions by name."""


class Command(NamedTuple):
    """Commands of n simulations, and what was cut off to get there.

    Attributes:
        position: (n, j) radians.
        slowed: (n,) whether the wish was slowed because a joint would have been too fast.
        limited: (n,) number of joints stopped at a position limit.
    """

    position: Array
    slowed: npt.NDArray[np.bool_]
    limited: npt.NDArray[np.int64]


class CommandLimits:
    """Keeps commands within the arm's limits of speed and position, and near the measured joints.

    A wish that would make a joint too fast is slowed as a whole, which keeps the direction of the motion.
    """

    def __init__(self, robot: Robot, rule: ActionRule):
        self._lead = max_lead(robot)
        self._way = robot.velocity_limits * INTERVAL
        self._lower, self._upper = robot.lower, robot.upper
        self._may_be_fast = bool((rule.peak > self._way * (1 + 1e-9)).any())
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
            slowed = np.asarray(excess > 1 + 1e-9)
            change = change / np.maximum(excess, 1.0)[:, None]
        else:
            slowed = self._never.setdefault(len(command), np.zeros(len(command), dtype=np.bool_))
        moved = np.minimum(np.maximum(command + change, joints - self._lead), joints + self._lead)
        position = np.minimum(np.maximum(moved, self._lower), self._upper)
        return Command(position, slowed, (position != moved).sum(axis=-1))


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
    return np.minimum(np.maximum(array, -1.0), 1.0)


def squared_norm(action: Array) -> Array:
    """(n,) sum of the squares of an action's entries: the effort."""
    return np.asarray((action * action).sum(axis=-1))
