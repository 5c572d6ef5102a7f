"""Tasks, observations, actions and rewards that users choose, by name or as their own objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import is_dataclass
from functools import partial
from inspect import signature
from typing import Any

from gymnasium import spaces

from greenhouse_gym.common.own_code import failing_as, is_own, load_own, make
from greenhouse_gym.envs.actions import ACTIONS, ActionChoice, ActionRule
from greenhouse_gym.envs.checked_parts import (
    CheckedAction,
    CheckedObservation,
    CheckedReward,
    is_ours,
    listed,
    name_of,
)
from greenhouse_gym.envs.contacts import CONTACT_GROUPS
from greenhouse_gym.envs.image_observations import DepthObservation, PointsObservation, RgbObservation
from greenhouse_gym.envs.observations import (
    PATH_FEATURES,
    TOOL_FEATURES,
    GoalObservation,
    ObservationChoice,
    ObservationSpec,
    StateObservation,
    TaskObservation,
)
from greenhouse_gym.envs.rewards import DenseReward, PathReward, Reward, SparseReward
from greenhouse_gym.envs.settings import EnvSettings
from greenhouse_gym.envs.task import Task
from greenhouse_gym.envs.tasks import TASKS, TomatoReach
from greenhouse_gym.errors import InvalidValueError, UnknownNameError, require_choice
from greenhouse_gym.robots import Robot

OBSERVATIONS: Mapping[str, Callable[[Robot, Task], ObservationSpec]] = {
    "state": StateObservation,
    "state_occupancy": partial(StateObservation, extra=("unknown",)),
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
        task = make(own, f"task {name_of(own)}", {}) if isinstance(own, type) else own
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
    return own if isinstance(own, ObservationSpec) and is_ours(own) else CheckedObservation(own)


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
    return CheckedAction(_made("action", kind, robot, interval), len(robot.joints))


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
        choices = listed(task.rewards)
        raise InvalidValueError(f"reward must be one of {choices} or a function of a Transition, got {own!r}")
    return own if type(own) in (DenseReward, SparseReward, PathReward) else CheckedReward(own)


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
    return make(own, f"{kind} {name_of(own)}", {}) if complete else own


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
                f"{kind} {name_of(own)} must be an object or a function of {given} that makes one: {error}"
            ) from error
        with failing_as(lambda problem: InvalidValueError(f"{kind} {name_of(own)} cannot be made: {problem}")):
            made = own(*arguments)
    else:
        made = own
    if not callable(made) or not isinstance(getattr(made, "space", None), spaces.Space):
        raise InvalidValueError(
            f"{kind} must be a name, or a callable object (or a function that makes one) with a Gymnasium space as "
            f"its attribute 'space', got {made!r}"
        )
    return made
