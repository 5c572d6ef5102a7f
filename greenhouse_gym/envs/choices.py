"""From what users choose, names or objects of their own, to what the simulation works with.

What comes from outside is checked at every step, so that a mistake in it is told by its name instead of turning up as a
strange number somewhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.actions import ACTIONS, ActionChoice, ActionRule, ToolMotion
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import (
    ApproachObservation,
    GoalObservation,
    ObservationChoice,
    Observed,
    Sight,
    StateObservation,
    WaypointObservation,
)
from greenhouse_gym.envs.reach_task import Situation
from greenhouse_gym.envs.rewards import REWARDS, DenseReward, Reward, SparseReward, Transition, WayReward
from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot

OBSERVATIONS: Mapping[str, Callable[[Robot], Sight]] = {
    "state": StateObservation,
    "state_seen": partial(StateObservation, unknown=True),
    "approach": ApproachObservation,
    "waypoint": WaypointObservation,
    "goal": GoalObservation,
    "goal_waypoint": partial(GoalObservation, way=True),
    "depth": DepthObservation(),
    "points": PointsObservation(),
    "rgb": RgbObservation(),
    "rgbd": RgbObservation(depth=True),
}
"""Kinds of observations by name."""


def make_observation(kind: ObservationChoice, robot: Robot) -> Sight:
    """The observation of that name, with those settings, or of the user's own.

    Raises:
        UnknownNameError: There is no such name.
        InvalidValueError: It is no `Observation`.
    """
    if isinstance(kind, str):
        return _named("observation", kind, OBSERVATIONS)(robot)
    own = _made("observation", kind, robot)
    return own if isinstance(own, Sight) and type(own).__module__.startswith("greenhouse_gym.") else _Checked(own)


def make_action(kind: ActionChoice, robot: Robot, interval: float) -> ActionRule:
    """The kind of action of that name, or of the user's own.

    Args:
        kind: A name or an `ActionRule`, or what makes one.
        robot: The arm.
        interval: Seconds between two actions.

    Raises:
        UnknownNameError: There is no such name.
        InvalidValueError: It is no `ActionRule`.
    """
    if isinstance(kind, str):
        return _named("action", kind, ACTIONS)(robot, interval)
    return _CheckedAction(_made("action", kind, robot, interval), len(robot.joints))


def make_reward(kind: str | Reward) -> Reward:
    """The reward of that name, with those settings, or the user's own.

    Raises:
        UnknownNameError: There is no such name.
        InvalidValueError: It is no function.
    """
    if isinstance(kind, str):
        return _named("reward", kind, REWARDS)
    if isinstance(kind, type) or not callable(kind):
        raise InvalidValueError(f"reward must be one of {_listed(REWARDS)} or a function of a Transition, got {kind!r}")
    return kind if type(kind) in (DenseReward, SparseReward, WayReward) else _CheckedReward(kind)


class _Checked(Sight):
    """An observation from outside."""

    def __init__(self, own: Any):
        self._own, self._name = own, f"observation {_name(own)}"
        self.space: spaces.Space[Any] = own.space
        boxes: dict[str, Any] = own.space.spaces if isinstance(own.space, spaces.Dict) else {"": own.space}
        for key, box in boxes.items():
            if not isinstance(box, spaces.Box):
                raise InvalidValueError(f"{self._name}{_at(key)}: its space must be made of boxes, got {box}")
        self._boxes = boxes
        for name in (
            "layout", "cameras", "sees_arm", "sees_color", "asks_what_was_seen", "asks_for_room", "asks_for_way",
            "target_is_obstacle", "has_goals",
        ):  # fmt: skip
            setattr(self, name, getattr(own, name, getattr(Sight, name)))
        goals = ("achieved_goal", "desired_goal")
        if self.has_goals and not all(key in boxes and boxes[key].shape == (3,) for key in goals):
            raise InvalidValueError(f"{self._name} has goals: its space must have {' and '.join(goals)} of shape (3,)")

    def __call__(self, situation: Situation) -> Observed:
        """Its observations, checked and copied."""
        seen, count = self._own(situation), len(situation.joints)
        if not isinstance(self.space, spaces.Dict):
            return self._part("", seen, count)
        if not isinstance(seen, Mapping) or seen.keys() != self._boxes.keys():
            given = list(seen) if isinstance(seen, Mapping) else type(seen).__name__
            raise InvalidValueError(f"{self._name} must give a dict with {_listed(self._boxes)}, got {given}")
        return {key: self._part(key, seen[key], count) for key in self._boxes}

    def _part(self, key: str, values: Any, count: int) -> npt.NDArray[Any]:
        box, where = self._boxes[key], self._name + _at(key)
        array = _array(where, values, (count, *box.shape))
        if array.dtype != box.dtype:
            raise InvalidValueError(f"{where} must be of its space's type {box.dtype}, got {array.dtype}")
        outside = ~((array >= box.low) & (array <= box.high))
        if outside.any():
            i = tuple(np.argwhere(outside)[0])
            raise InvalidValueError(
                f"{where} must lie within its space, {box.low[i[1:]]} to {box.high[i[1:]]} at {_index(i[1:])}, got "
                f"{array[i]}"
            )
        return array


class _CheckedAction:
    """A kind of action from outside."""

    def __init__(self, own: Any, joints: int):
        self._own, self._joints, self._name = own, joints, f"action {_name(own)}"
        self.space: spaces.Box = own.space
        self.peak = np.broadcast_to(np.asarray(getattr(own, "peak", np.inf), dtype=np.float64), joints)
        if not isinstance(self.space, spaces.Box) or len(self.space.shape) != 1:
            raise InvalidValueError(f"{self._name}: its space must be a Box of one axis, got {self.space}")

    def __call__(self, action: Array, situation: Situation, motion: ToolMotion) -> Array:
        """Its changes of the commands, checked."""
        change = _array(self._name, self._own(action, situation, motion), (len(action), self._joints))
        _check_finite(self._name, change)
        return change.astype(np.float64)


class _CheckedReward:
    """A reward from outside."""

    def __init__(self, own: Callable[[Transition], Any]):
        self._own, self._name = own, f"reward {_name(own)}"
        self.asks_for_way = bool(getattr(own, "asks_for_way", False))

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Its terms, checked and copied."""
        terms = self._own(step)
        if not isinstance(terms, Mapping) or not terms or not all(isinstance(name, str) for name in terms):
            raise InvalidValueError(f"{self._name} must give a dict of arrays by the terms' names, got {terms!r}")
        result = {}
        for name, values in terms.items():
            where = f"{self._name}, term {name!r}"
            result[name] = _array(where, values, (len(step.after),)).astype(np.float64)
            _check_finite(where, result[name])
        return result


def _named(kind: str, name: str, choices: Mapping[str, Any]) -> Any:
    if name not in choices:
        raise UnknownNameError(kind, name, choices)
    return choices[name]


def _made(kind: str, own: Any, *arguments: Any) -> Any:
    """The user's object: as it is where it has a space, else made from the arguments."""
    if callable(own) and (isinstance(own, type) or not isinstance(getattr(own, "space", None), spaces.Space)):
        try:
            signature(own).bind(*arguments)
        except TypeError as error:
            given = " and ".join(type(argument).__name__ for argument in arguments)
            raise InvalidValueError(
                f"{kind} {_name(own)} must be an object, or what makes one from {given}, but: {error}"
            ) from error
        made = own(*arguments)
    else:
        made = own
    if not callable(made) or not isinstance(getattr(made, "space", None), spaces.Space):
        raise InvalidValueError(
            f"{kind} must be a name, or an object (or what makes one) that has a Gymnasium space as its attribute "
            f"'space' and can be called, got {made!r}"
        )
    return made


def _array(where: str, values: Any, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """A copy of the values, if they are numbers of that shape."""
    try:
        array = np.array(values)
    except ValueError as error:
        raise InvalidValueError(f"{where} must give an array of shape {shape}, got {values!r}") from error
    if array.shape != shape or array.dtype.kind not in "buif":
        raise InvalidValueError(
            f"{where} must give numbers of shape {shape} for {shape[0]} simulations, got {array.dtype} of {array.shape}"
        )
    return array


def _check_finite(where: str, array: npt.NDArray[Any]) -> None:
    if not np.isfinite(array).all():
        i = tuple(np.argwhere(~np.isfinite(array))[0])
        raise InvalidValueError(f"{where} must be finite, got {array[i]} in simulation {i[0]}")


def _name(own: Any) -> str:
    return str(getattr(own, "__qualname__", type(own).__qualname__))


def _at(key: str) -> str:
    return f"[{key!r}]" if key else ""


def _index(index: tuple[Any, ...]) -> str:
    return str([int(i) for i in index])


def _listed(names: Any) -> str:
    return ", ".join(map(repr, names))
