"""What an agent sees: from a `Situation` of n simulations to arrays that fit a Gymnasium space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.actions import max_lead
from greenhouse_gym.envs.approach import ROOM
from greenhouse_gym.envs.reach_task import ACTION_STEP, Float32, Situation
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import Robot

JOINT_MARGIN = 0.1
"""How far beyond its limit a joint is reported, radians (limits are soft in the physics)."""

MAX_OFFSET = 3.0
"""Positions are reported up to here along each axis, metres."""

MIN_CLEARANCE = -0.1
"""Clearances are reported down to here, metres."""

MAX_WAY = 6.3
"""Ways of a joint are reported up to here, radians."""

Layout: TypeAlias = tuple[tuple[str, int], ...]
Observed: TypeAlias = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]


class Observation(Protocol):
    """A kind of observation: its space, and what is seen.

    ``observation=`` takes an object like this, or a class or function that makes one from the arm. Compute elementwise
    (no 2-D matrix products), so that a simulation's numbers do not depend on how many there are.

    An object may have the attributes of `Sight`, too; left out, they are what that class says.

    Attributes:
        space: The space of one simulation's observation: a `Box`, or a `Dict` of boxes.
    """

    @property
    def space(self) -> spaces.Space[Any]:
        """The space of one simulation's observation."""

    def __call__(self, situation: Situation) -> Observed:
        """Observations of n simulations within the space, (n, *shape) or a dict of such arrays."""


class Sight(ABC):
    """An `Observation` that says what it needs to be computed, and what is in it.

    Attributes:
        space: The space of one simulation's observation.
        layout: Name of each group of entries of its vector with its number of entries, in order.
        cameras: What takes images for it; all of one size.
        sees_arm: Whether the arm is in the depth images.
        sees_color: Whether there are color images, too.
        asks_what_was_seen: Whether it tells which places the scan saw; all scenes must then say so.
        asks_for_room: Whether it tells how much room there is around the target.
        asks_for_way: Whether it tells where the arm can go straight.
        target_is_obstacle: Whether the clearances count the target too.
        has_goals: Whether it is a goal environment's.
    """

    space: spaces.Space[Any]
    layout: Layout = ()
    cameras: tuple[DepthCamera, ...] = ()
    sees_arm: bool = False
    sees_color: bool = False
    asks_what_was_seen: bool = False
    asks_for_room: bool = False
    asks_for_way: bool = False
    target_is_obstacle: bool = False
    has_goals: bool = False

    @abstractmethod
    def __call__(self, situation: Situation) -> Observed:
        """Observations of n simulations, new arrays within the space."""


ObservationFactory: TypeAlias = Callable[[Robot], Observation]
ObservationChoice: TypeAlias = str | Observation | ObservationFactory


_GROUPS: dict[str, tuple[Callable[[Situation], npt.NDArray[Any]], Callable[[Robot], tuple[Any, Any]]]] = {
    "joint_position": (lambda s: s.joints, lambda r: (r.lower - JOINT_MARGIN, r.upper + JOINT_MARGIN)),
    "joint_velocity": (lambda s: s.velocities, lambda r: (-2.0 * r.velocity_limits, 2.0 * r.velocity_limits)),
    "command_error": (lambda s: s.lead, lambda r: _around(2 * max_lead(r), len(r.joints))),
    "grasp_offset": (lambda s: s.target - s.grasp, lambda r: _around(MAX_OFFSET, 3)),
    "target_position": (lambda s: s.target, lambda r: _around(MAX_OFFSET, 3)),
    "tip_position": (lambda s: s.tip, lambda r: _around(MAX_OFFSET, 3)),
    "tool_axis": (lambda s: s.axis, lambda r: _around(1.0, 3)),
    "clearance": (
        lambda s: s.clearance,
        lambda r: (np.full(len(r.probes), MIN_CLEARANCE), np.full(len(r.probes), MAX_DISTANCE)),
    ),
    "obstacle_direction": (
        lambda s: s.obstacle.reshape(len(s.obstacle), -1),
        lambda r: _around(1.0, 3 * len(r.probes)),
    ),
    "unknown": (lambda s: ~s.seen, lambda r: (np.zeros(len(r.probes)), np.ones(len(r.probes)))),
    "waypoint_offset": (lambda s: s.waypoint, lambda r: _around(MAX_WAY, len(r.joints))),
    "waypoint_direction": (lambda s: _direction(s.waypoint), lambda r: _around(1.0, len(r.joints))),
    "way": (lambda s: s.way, lambda r: (np.zeros(2), np.array([MAX_WAY, 1.0]))),
    "room": (lambda s: s.room, lambda r: (np.full(ROOM, MIN_CLEARANCE), np.full(ROOM, MAX_DISTANCE))),
}


def _around(limit: float, size: int) -> tuple[Array, Array]:
    return np.full(size, -limit), np.full(size, limit)


def _direction(offset: Array) -> Array:
    """(n, j) the action that moves a command straight by an offset (n, j), as fast as may be."""
    return np.asarray(offset / np.maximum(ACTION_STEP, np.abs(offset).max(axis=1, keepdims=True)))


class Vector:
    """Groups of numbers side by side, clipped to their bounds.

    Args:
        robot: The arm.
        names: Names of the groups, in order.

    Attributes:
        layout: Name of each group with its number of entries.
        space: The space of one simulation's vector.
    """

    def __init__(self, robot: Robot, names: tuple[str, ...]):
        self._parts = [_GROUPS[name][0] for name in names]
        bounds = [_GROUPS[name][1](robot) for name in names]
        self.layout: Layout = tuple((name, len(low)) for name, (low, _) in zip(names, bounds, strict=True))
        self.low, self.high = (np.concatenate(side).astype(np.float32) for side in zip(*bounds, strict=True))
        self.space = spaces.Box(self.low, self.high, dtype=np.float32)

    def __call__(self, situation: Situation) -> Float32:
        """Vectors (n, size)."""
        result = np.empty((len(situation.joints), len(self.low)), dtype=np.float32)
        np.concatenate([part(situation) for part in self._parts], axis=1, out=result, casting="same_kind")
        np.maximum(result, self.low, out=result)
        np.minimum(result, self.high, out=result)
        return result


_STATE = (
    "joint_position", "joint_velocity", "command_error", "grasp_offset", "target_position", "clearance",
    "obstacle_direction",
)  # fmt: skip
_GOAL_STATE = (
    "joint_position", "joint_velocity", "command_error", "tip_position", "tool_axis", "clearance", "obstacle_direction",
)  # fmt: skip
_WAY = ("waypoint_offset", "waypoint_direction", "way")


class StateObservation(Sight):
    """Joints, target and clearances as one vector; `TomatoReachEnv` documents every index.

    Args:
        robot: The arm.
        unknown: Append for each probe point a 1 if it lies in unknown space, else a 0.
    """

    def __init__(self, robot: Robot, unknown: bool = False):
        self._vector = Vector(robot, (*_STATE, "unknown") if unknown else _STATE)
        self.asks_what_was_seen = unknown
        self.space = self._vector.space
        self.layout = self._vector.layout

    def __call__(self, situation: Situation) -> Observed:
        """Observations (n, size)."""
        return self._vector(situation)


class ApproachObservation(Sight):
    """The vector of `StateObservation`, then the room on rays away from the target: how it can be approached."""

    asks_for_room = True

    def __init__(self, robot: Robot):
        self._vector = Vector(robot, (*_STATE, "room"))
        self.space, self.layout = self._vector.space, self._vector.layout

    def __call__(self, situation: Situation) -> Observed:
        """Observations (n, size)."""
        return self._vector(situation)


class WaypointObservation(Sight):
    """As `StateObservation`, and where the arm can go straight on its way: not what to do where it cannot."""

    asks_for_way = True

    def __init__(self, robot: Robot):
        self._vector = Vector(robot, (*_STATE, *_WAY))
        self.space, self.layout = self._vector.space, self._vector.layout

    def __call__(self, situation: Situation) -> Observed:
        """Observations (n, size)."""
        return self._vector(situation)


class GoalObservation(Sight):
    """The three parts of a goal environment; ``observation`` holds nothing that depends on the target.

    Args:
        robot: The arm.
        way: Whether it does end with what does: where the arm can go straight on its way to the target. A goal in
            hindsight does not change it.
    """

    target_is_obstacle = has_goals = True

    def __init__(self, robot: Robot, way: bool = False):
        self.asks_for_way = way
        self._vector = Vector(robot, (*_GOAL_STATE, *_WAY) if way else _GOAL_STATE)
        self.layout = self._vector.layout
        goal = spaces.Box(-MAX_OFFSET, MAX_OFFSET, (3,), dtype=np.float64)
        self.space = spaces.Dict({"observation": self._vector.space, "achieved_goal": goal, "desired_goal": goal})

    def __call__(self, situation: Situation) -> Observed:
        """Observations (n, size), grasp points (n, 3) and centers (n, 3); the goals are exact, float64."""
        return {
            "achieved_goal": situation.grasp.copy(),
            "desired_goal": situation.target.copy(),
            "observation": self._vector(situation),
        }


def places_in(layout: Layout) -> dict[str, slice]:
    """Where each group of a layout lies in its vector."""
    ends = np.cumsum([size for _, size in layout]).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(layout, ends, strict=True)}


def select(observed: Observed, ids: Any) -> Any:
    """The observations of some simulations, or of one, out of those of all."""
    if isinstance(observed, dict):
        return {key: values[ids] for key, values in observed.items()}
    return observed[ids]


def check_goals_are_known(observation: Sight, hidden: str) -> None:
    """Refuse goal environments in which the goal that counts differs from the one that is told.

    Raises:
        InvalidValueError: They differ.
    """
    if observation.has_goals and hidden:
        raise InvalidValueError(
            f'observation="goal" computes rewards from the goals it tells, which {hidden} makes differ from those that '
            'count; choose observation="state"'
        )


def check_goals_stay(observation: Sight, pays_for_way: bool) -> None:
    """Refuse goal environments whose reward depends on the way to the goal, which no other goal in hindsight has.

    Raises:
        InvalidValueError: Such a reward is chosen.
    """
    if observation.has_goals and pays_for_way:
        raise InvalidValueError(
            'a reward that asks for the way, as "way" does, knows none to goals in hindsight; choose reward="dense" '
            'or "sparse", or observation="waypoint"'
        )
