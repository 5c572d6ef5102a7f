"""Checks of the values that a user's observation, action, reward or task returns.

They are made at every step, so that a mistake is reported by its name where it happens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.observations import ObservationSpec, Observed
from greenhouse_gym.envs.rewards import Transition
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.task import Outcome, Task
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array


class OwnPart:
    """Observation or action of a user.

    Attributes:
        run: Calls a function with its arguments, within limits for the user's code if there are any.
    """

    run: Callable[..., Any] = staticmethod(lambda function, *arguments: function(*arguments))


class CheckedObservation(OwnPart, ObservationSpec):
    """Observation of a user, with checks."""

    def __init__(self, own: Any):
        self._own, self._name = own, f"observation {name_of(own)}"
        self.space: spaces.Space[Any] = own.space
        boxes: dict[str, Any] = own.space.spaces if isinstance(own.space, spaces.Dict) else {"": own.space}
        for key, box in boxes.items():
            if not isinstance(box, spaces.Box):
                raise InvalidValueError(f"{self._name}{_at(key)}: its space must be made of boxes, got {box}")
        self._boxes = boxes
        for name in (
            "layout", "cameras", "renders_arm", "renders_color", "requires_occupancy",
            "requires_roadmap", "target_is_obstacle", "has_goals",
        ):  # fmt: skip
            setattr(self, name, getattr(own, name, getattr(ObservationSpec, name)))
        goals = ("achieved_goal", "desired_goal")
        if self.has_goals and not all(key in boxes and boxes[key].shape == (3,) for key in goals):
            raise InvalidValueError(f"{self._name} has goals: its space must have {' and '.join(goals)} of shape (3,)")

    def __call__(self, state: State) -> Observed:
        """Return checked copies of its observations."""
        return self.run(self._observed, state)  # type: ignore[no-any-return]

    def _observed(self, state: State) -> Observed:
        observed, count = self._own(state), len(state.joints)
        if not isinstance(self.space, spaces.Dict):
            return self._part("", observed, count)
        if not isinstance(observed, Mapping) or observed.keys() != self._boxes.keys():
            given = list(observed) if isinstance(observed, Mapping) else type(observed).__name__
            raise InvalidValueError(f"{self._name} must return a dict with {listed(self._boxes)}, got {given}")
        return {key: self._part(key, observed[key], count) for key in self._boxes}

    def _part(self, key: str, values: Any, count: int) -> npt.NDArray[Any]:
        box, where = self._boxes[key], self._name + _at(key)
        array = _array(where, values, (count, *box.shape))
        if array.dtype != box.dtype:
            raise InvalidValueError(f"{where} must have the type of its space, {box.dtype}, got {array.dtype}")
        outside = ~((array >= box.low) & (array <= box.high))
        if outside.any():
            i = tuple(np.argwhere(outside)[0])
            raise InvalidValueError(
                f"{where} must lie within its space, {box.low[i[1:]]} to {box.high[i[1:]]} at {_index(i[1:])}, got "
                f"{array[i]}"
            )
        return array


class CheckedAction(OwnPart):
    """Kind of action of a user, with checks."""

    def __init__(self, own: Any, joints: int):
        self._own, self._joints, self._name = own, joints, f"action {name_of(own)}"
        self.space: spaces.Box = own.space
        if not isinstance(self.space, spaces.Box) or len(self.space.shape) != 1:
            raise InvalidValueError(f"{self._name}: its space must be a Box of one axis, got {self.space}")

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return the checked changes of the commands."""
        return self.run(self._change, action, state, motion)  # type: ignore[no-any-return]

    def _change(self, action: Array, state: State, motion: ToolMotion) -> Array:
        change = _array(self._name, self._own(action, state, motion), (len(action), self._joints))
        _check_finite(self._name, change)
        return change.astype(np.float64)


class CheckedReward:
    """Reward of a user, with checks."""

    def __init__(self, own: Callable[[Transition], Any]):
        self._own, self._name = own, f"reward {name_of(own)}"
        self.requires_roadmap = bool(getattr(own, "requires_roadmap", False))

    def __call__(self, step: Transition) -> dict[str, Array]:
        """Return checked copies of its terms."""
        terms = self._own(step)
        if not isinstance(terms, Mapping) or not terms or not all(isinstance(name, str) for name in terms):
            raise InvalidValueError(f"{self._name} must return a dict of arrays by term, got {terms!r}")
        result = {}
        for name, values in terms.items():
            where = f"{self._name}, term {name!r}"
            result[name] = _array(where, values, (len(step.after),)).astype(np.float64)
            _check_finite(where, result[name])
        return result


def outcome_check(task: Task) -> Callable[[Outcome, int], Outcome]:
    """Return the function that checks the outcomes of a task for n simulations; a user's task may have mistakes."""
    return (lambda outcome, count: outcome) if is_ours(task) else partial(_checked_outcome, task)


def remembered(task: Task, values: Mapping[str, npt.ArrayLike]) -> dict[str, npt.NDArray[Any]]:
    """Return new values of the memory of a task in one simulation as arrays.

    Raises:
        InvalidValueError: The task does not declare them, or with another shape.
    """
    where = f"task {name_of(task)}"
    for name in values:
        if name not in task.memory:
            raise InvalidValueError(f"{where}: memory must be one of {listed(task.memory)}, got {name!r}")
    return {name: _array(f"{where}, memory {name!r}", v, np.shape(task.memory[name])) for name, v in values.items()}


def _checked_outcome(task: Task, outcome: Outcome, count: int) -> Outcome:
    where = f"task {name_of(task)}"
    if not isinstance(outcome, Outcome):
        raise InvalidValueError(f"{where} must return an Outcome, got {outcome!r}")
    distance = _array(f"{where}, distance", outcome.distance, (count,))
    _check_finite(f"{where}, distance", distance)
    flags = ("success", "failure", *(() if outcome.next_target is None else ("next_target",)))
    checked = {name: _array(f"{where}, {name}", getattr(outcome, name), (count,)) for name in flags}
    for name, values in checked.items():
        if values.dtype != np.bool_:
            raise InvalidValueError(f"{where}, {name} must be bool, got {values.dtype}")
    if outcome.memory and outcome.memory.keys() != task.memory.keys():
        raise InvalidValueError(f"{where}, memory must have {listed(task.memory)}, got {listed(outcome.memory)}")
    memory = {
        name: _array(f"{where}, memory {name!r}", values, (count, *np.shape(task.memory[name])))
        for name, values in outcome.memory.items()
    }
    return Outcome(distance.astype(np.float64), memory=memory, **checked)


def _array(where: str, values: Any, shape: tuple[int, ...]) -> npt.NDArray[Any]:
    """Return a copy of the values if they are numbers of that shape."""
    try:
        array = np.array(values)
    except ValueError as error:
        raise InvalidValueError(f"{where} must return an array of shape {shape}, got {values!r}") from error
    if array.shape != shape or array.dtype.kind not in "buif":
        raise InvalidValueError(
            f"{where} must return numbers of shape {shape}, one row for each simulation, got {array.dtype} of "
            f"{array.shape}"
        )
    return array


def _check_finite(where: str, array: npt.NDArray[Any]) -> None:
    if not np.isfinite(array).all():
        i = tuple(np.argwhere(~np.isfinite(array))[0])
        raise InvalidValueError(f"{where} must be finite, got {array[i]} in simulation {i[0]}")


def is_ours(own: object) -> bool:
    """Return whether an object's class is the package's."""
    return type(own).__module__.startswith("greenhouse_gym.")


def name_of(own: Any) -> str:
    """Return the name of a class or function, or of an object's class, for messages."""
    return str(getattr(own, "__qualname__", type(own).__qualname__))


def _at(key: str) -> str:
    return f"[{key!r}]" if key else ""


def _index(index: tuple[Any, ...]) -> str:
    return str([int(i) for i in index])


def listed(names: Any) -> str:
    """Return names in quotation marks, separated by commas, for messages."""
    return ", ".join(map(repr, names))
