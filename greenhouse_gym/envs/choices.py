"""Choices of users, by name or as their own objects, and checks of the values these objects return.

Values from a user's code are checked at every step, so that a mistake is reported by its name where it happens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.common.own_code import is_own, load_own, make
from greenhouse_gym.envs.actions import ACTIONS, ActionChoice, ActionRule, ToolMotion
from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import (
    PATH_FEATURES,
    TOOL_FEATURES,
    GoalObservation,
    ObservationChoice,
    ObservationSpec,
    Observed,
    StateObservation,
    TaskObservation,
)
from greenhouse_gym.envs.rewards import DenseReward, PathReward, Reward, SparseReward, Transition
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.task import Outcome, Task
from greenhouse_gym.envs.tasks import TASKS, TomatoReach
from greenhouse_gym.errors import InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot

OBSERVATIONS: Mapping[str, Callable[[Robot, Task], ObservationSpec]] = {
    "state": StateObservation,
    "state_occupancy": partial(StateObservation, extra=("unknown",)),
    "clearance_rays": partial(StateObservation, extra=("clearance_rays",)),
    "roadmap": partial(StateObservation, extra=PATH_FEATURES, without=TOOL_FEATURES),
    "task": TaskObservation,
    "goal": GoalObservation,
    "goal_roadmap": partial(GoalObservation, path=True),
    "depth": DepthObservation(),
    "points": PointsObservation(),
    "rgb": RgbObservation(),
    "rgbd": RgbObservation(depth=True),
}
"""Observations by name."""

_OWN_SETTINGS = (DepthObservation, PointsObservation, RgbObservation)


def make_task(
    choice: str | Task | type[Task] | Mapping[str, Any], success_radius: float, size: str | None = None
) -> Task:
    """Return a task by name, by file or module, or as the user's own object.

    Args:
        choice: See `EnvSettings.task`.
        success_radius: Setting of the task "reach".
        size: Setting of the task "harvest"; None for its default.

    Raises:
        UnknownNameError: The task or one of its contact groups does not exist.
        InvalidValueError: The choice is not a `Task`, or a size is given for another task than "harvest".
        FileFormatError: The file of a task is missing or cannot be run.
    """
    if size is not None and choice != "harvest":
        raise InvalidValueError(f'size belongs to task="harvest", got size={size!r} with task={choice!r}')
    own = load_own(choice, "task", lambda value: isinstance(value, type) and issubclass(value, Task))
    if isinstance(own, str):
        kind = _named("task", own, TASKS)
        task = TomatoReach(success_radius) if kind is TomatoReach else kind(**({} if size is None else {"size": size}))
    else:
        task = make(own, f"task {_name(own)}", {}) if isinstance(own, type) else own
    if not isinstance(task, Task):
        raise InvalidValueError(f"task must be a Task, got {task!r}")
    for group in (*task.ends_on, *task.costs):
        require_choice("contact group", group, CONTACT_GROUPS)
    return task


def step_limit_of(settings: EnvSettings) -> int:
    """Return the steps after which an episode is truncated: those of the settings, else those of their task."""
    if settings.step_limit is not None:
        return settings.step_limit
    return make_task(settings.task, settings.success_radius, settings.size).step_limit


def make_observation(kind: ObservationChoice | Mapping[str, Any], robot: Robot, task: Task) -> ObservationSpec:
    """Return an observation by name, with other settings, or the user's own.

    Raises:
        UnknownNameError: The name does not exist.
        InvalidValueError: The object is not an `Observation`.
    """
    kind = _loaded("observation", kind)
    if isinstance(kind, str):
        return _named("observation", kind, OBSERVATIONS)(robot, task)
    if isinstance(kind, _OWN_SETTINGS):
        return kind(robot, task)
    own = _made("observation", kind, robot)
    return own if isinstance(own, ObservationSpec) and _is_ours(own) else _Checked(own)


def make_action(kind: ActionChoice | Mapping[str, Any], robot: Robot, interval: float) -> ActionRule:
    """Return a kind of action by name, or the user's own.

    Args:
        kind: A name or an `ActionRule`, or a function that makes one.
        robot: The arm.
        interval: Time between two actions, seconds.

    Raises:
        UnknownNameError: The name does not exist.
        InvalidValueError: The object is not an `ActionRule`.
    """
    kind = _loaded("action", kind)
    if isinstance(kind, str):
        return _named("action", kind, ACTIONS)(robot, interval)
    return _CheckedAction(_made("action", kind, robot, interval), len(robot.joints))


def make_reward(kind: str | Reward | Mapping[str, Any], task: Task) -> Reward:
    """Return a reward of the task by name, or the user's own.

    Raises:
        UnknownNameError: The name does not exist.
        InvalidValueError: The object is not a function.
    """
    own = _loaded("reward", kind)
    if isinstance(own, str):
        return _named("reward", own, task.rewards)
    if isinstance(own, type) or not callable(own):
        choices = _listed(task.rewards)
        raise InvalidValueError(f"reward must be one of {choices} or a function of a Transition, got {own!r}")
    return own if type(own) in (DenseReward, SparseReward, PathReward) else _CheckedReward(own)


def outcome_check(task: Task) -> Callable[[Outcome, int], Outcome]:
    """Return the function that checks the outcomes of a task for n simulations; a user's task may have mistakes."""
    return (lambda outcome, count: outcome) if _is_ours(task) else partial(_checked_outcome, task)


def remembered(task: Task, values: Mapping[str, npt.ArrayLike]) -> dict[str, npt.NDArray[Any]]:
    """Return new values of the memory of a task in one simulation as arrays.

    Raises:
        InvalidValueError: The task does not declare them, or with another shape.
    """
    where = f"task {_name(task)}"
    for name in values:
        if name not in task.memory:
            raise InvalidValueError(f"{where}: memory must be one of {_listed(task.memory)}, got {name!r}")
    return {name: _array(f"{where}, memory {name!r}", v, np.shape(task.memory[name])) for name, v in values.items()}


def _checked_outcome(task: Task, outcome: Outcome, count: int) -> Outcome:
    where = f"task {_name(task)}"
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
        raise InvalidValueError(f"{where}, memory must have {_listed(task.memory)}, got {_listed(outcome.memory)}")
    memory = {
        name: _array(f"{where}, memory {name!r}", values, (count, *np.shape(task.memory[name])))
        for name, values in outcome.memory.items()
    }
    return Outcome(distance.astype(np.float64), memory=memory, **checked)


class _Checked(ObservationSpec):
    """Observation of a user, with checks."""

    def __init__(self, own: Any):
        self._own, self._name = own, f"observation {_name(own)}"
        self.space: spaces.Space[Any] = own.space
        boxes: dict[str, Any] = own.space.spaces if isinstance(own.space, spaces.Dict) else {"": own.space}
        for key, box in boxes.items():
            if not isinstance(box, spaces.Box):
                raise InvalidValueError(f"{self._name}{_at(key)}: its space must be made of boxes, got {box}")
        self._boxes = boxes
        for name in (
            "layout", "cameras", "renders_arm", "renders_color", "requires_occupancy",
            "requires_clearance_rays", "requires_roadmap", "target_is_obstacle", "has_goals",
        ):  # fmt: skip
            setattr(self, name, getattr(own, name, getattr(ObservationSpec, name)))
        goals = ("achieved_goal", "desired_goal")
        if self.has_goals and not all(key in boxes and boxes[key].shape == (3,) for key in goals):
            raise InvalidValueError(f"{self._name} has goals: its space must have {' and '.join(goals)} of shape (3,)")

    def __call__(self, state: State) -> Observed:
        """Return checked copies of its observations."""
        observed, count = self._own(state), len(state.joints)
        if not isinstance(self.space, spaces.Dict):
            return self._part("", observed, count)
        if not isinstance(observed, Mapping) or observed.keys() != self._boxes.keys():
            given = list(observed) if isinstance(observed, Mapping) else type(observed).__name__
            raise InvalidValueError(f"{self._name} must return a dict with {_listed(self._boxes)}, got {given}")
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


class _CheckedAction:
    """Kind of action of a user, with checks."""

    def __init__(self, own: Any, joints: int):
        self._own, self._joints, self._name = own, joints, f"action {_name(own)}"
        self.space: spaces.Box = own.space
        if not isinstance(self.space, spaces.Box) or len(self.space.shape) != 1:
            raise InvalidValueError(f"{self._name}: its space must be a Box of one axis, got {self.space}")

    def __call__(self, action: Array, state: State, motion: ToolMotion) -> Array:
        """Return the checked changes of the commands."""
        change = _array(self._name, self._own(action, state, motion), (len(action), self._joints))
        _check_finite(self._name, change)
        return change.astype(np.float64)


def is_of_user(part: object) -> bool:
    """Return whether an observation or an action is a user's, not one of the package."""
    return isinstance(part, _Checked | _CheckedAction)


class _CheckedReward:
    """Reward of a user, with checks."""

    def __init__(self, own: Callable[[Transition], Any]):
        self._own, self._name = own, f"reward {_name(own)}"
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


def _loaded(kind: str, choice: Any) -> Any:
    """Return the object that a choice names; a class that a command names is made if it needs no arguments."""
    own = load_own(choice, kind)
    if not is_own(choice) or not isinstance(own, type):
        return own
    try:
        parameters = signature(own).parameters.values()
    except ValueError:  # of some classes that are not written in Python
        return own
    complete = not parameters or (is_dataclass(own) and all(p.default is not p.empty for p in parameters))
    return make(own, f"{kind} {_name(own)}", {}) if complete else own


def _named(kind: str, name: str, choices: Mapping[str, Any]) -> Any:
    if name not in choices:
        raise UnknownNameError(kind, name, choices)
    return choices[name]


def _made(kind: str, own: Any, *arguments: Any) -> Any:
    """Return the user's object if it has a space, else the result of calling it."""
    if callable(own) and (isinstance(own, type) or not isinstance(getattr(own, "space", None), spaces.Space)):
        try:
            signature(own).bind(*arguments)
        except (TypeError, ValueError) as error:
            given = " and ".join(type(argument).__name__ for argument in arguments)
            raise InvalidValueError(
                f"{kind} {_name(own)} must be an object or a function of {given} that makes one: {error}"
            ) from error
        try:
            made = own(*arguments)
        except Exception as error:  # any error in the user's code
            raise InvalidValueError(f"{kind} {_name(own)} cannot be made: {type(error).__name__}: {error}") from error
    else:
        made = own
    if not callable(made) or not isinstance(getattr(made, "space", None), spaces.Space):
        raise InvalidValueError(
            f"{kind} must be a name, or a callable object (or a function that makes one) with a Gymnasium space as "
            f"its attribute 'space', got {made!r}"
        )
    return made


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


def _is_ours(own: object) -> bool:
    return type(own).__module__.startswith("greenhouse_gym.")


def _name(own: Any) -> str:
    return str(getattr(own, "__qualname__", type(own).__qualname__))


def _at(key: str) -> str:
    return f"[{key!r}]" if key else ""


def _index(index: tuple[Any, ...]) -> str:
    return str([int(i) for i in index])


def _listed(names: Any) -> str:
    return ", ".join(map(repr, names))
