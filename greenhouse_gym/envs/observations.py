"""Observations: from the state of n simulations to arrays in a Gymnasium space."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.features import FEATURES, MAX_OFFSET, Feature, FeatureVector, Layout
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.task import GoalTask, Task
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.robots import Robot

Observed: TypeAlias = npt.NDArray[Any] | dict[str, npt.NDArray[Any]]

REACH = TomatoReach()
"""Default task of observations that are made outside an environment."""


class Observation(Protocol):
    """Kind of observation: a space and a function from states to values in it.

    Pass such an object as ``observation=``, or a class or function that makes one from the arm. Compute elementwise (no
    2-D matrix products), so that the numbers of a simulation do not depend on how many there are.

    An object may also have the attributes of `ObservationSpec`; missing ones have the defaults of that class.

    Attributes:
        space: Space of one simulation's observation: a `Box`, or a `Dict` of boxes.
    """

    @property
    def space(self) -> spaces.Space[Any]:
        """Space of one simulation's observation."""

    def __call__(self, state: State) -> Observed:
        """Return observations of n simulations within the space, (n, *shape) or a dict of such arrays."""


class ObservationSpec(ABC):
    """`Observation` that declares what it contains and what it requires.

    Attributes:
        space: Space of one simulation's observation.
        layout: Name and size of each feature of its vector, in order.
        cameras: Cameras that it requires, all of the same image size.
        renders_arm: Depth images show the arm.
        renders_color: Color images are rendered as well.
        requires_occupancy: It reads `State.unknown`; every scene must have an occupancy grid.
        requires_roadmap: It reads `State.waypoint`, `State.path_length` or `State.path_free`.
        target_is_obstacle: Clearances include the target.
        has_goals: It is an observation of a goal environment.
    """

    space: spaces.Space[Any]
    layout: Layout = ()
    cameras: tuple[DepthCamera, ...] = ()
    renders_arm: bool = False
    renders_color: bool = False
    requires_occupancy: bool = False
    requires_roadmap: bool = False
    target_is_obstacle: bool = False
    has_goals: bool = False

    @abstractmethod
    def __call__(self, state: State) -> Observed:
        """Return observations of n simulations, new arrays within the space."""


ObservationFactory: TypeAlias = Callable[[Robot], Observation]
ObservationChoice: TypeAlias = str | Observation | ObservationFactory

ARM_FEATURES = ("joint_position", "joint_velocity", "command_error", "tip_position", "tool_axis")
"""Features of the arm itself."""

TOOL_FEATURES = ("tip_position", "tool_axis", "target_direction", "turn_to_target")
"""Features of the tool's pose and of its turn to the target."""

PATH_FEATURES = ("waypoint_offset", "waypoint_direction", "path")
"""Features of the roadmap: offset and direction to the waypoint, and length and freedom of the path."""


def body_features(task: Task) -> dict[str, Feature]:
    """Return the features of the arm itself, followed by those of the task."""
    return {**named_features(*ARM_FEATURES), **task.features}


def named_features(*names: str) -> dict[str, Feature]:
    """Return features of `FEATURES` by name."""
    return {name: FEATURES[name] for name in names}


class StateObservation(ObservationSpec):
    """Features of arm and task and clearances in one vector; `GreenhouseEnv` documents every index.

    Args:
        robot: The arm.
        task: The task.
        extra: Names of further features to append: "unknown" or those in `PATH_FEATURES`.
        without: Names of features to leave out, such as `TOOL_FEATURES`.
    """

    def __init__(self, robot: Robot, task: Task = REACH, extra: Sequence[str] = (), without: Sequence[str] = ()):
        features = body_features(task) | named_features("clearance", "obstacle_direction", *extra)
        features = {name: feature for name, feature in features.items() if name not in without}
        self._vector = FeatureVector(robot, features)
        self.space, self.layout = self._vector.space, self._vector.layout
        self.requires_occupancy = "unknown" in extra
        self.requires_roadmap = not set(PATH_FEATURES).isdisjoint(extra)

    def __call__(self, state: State) -> Observed:
        """Return observations (n, size)."""
        return self._vector(state)


class TaskObservation(ObservationSpec):
    """Features of arm and task, without those of the scan, and the arrays that the task remembers.

    Args:
        robot: The arm.
        task: The task.
    """

    def __init__(self, robot: Robot, task: Task = REACH):
        self._vector = FeatureVector(robot, body_features(task))
        self.layout = self._vector.layout
        self._arrays = tuple(task.arrays)
        self.space = spaces.Dict({**task.arrays, "state": self._vector.space})

    def __call__(self, state: State) -> Observed:
        """Return the vectors (n, size), and the arrays (n, ...)."""
        return {name: state.memory[name].copy() for name in self._arrays} | {"state": self._vector(state)}


class GoalObservation(ObservationSpec):
    """Observation of a goal environment; its part ``observation`` does not depend on the target.

    Args:
        robot: The arm.
        task: The task, which must have goals.
        path: Append the waypoint and the path to the target, which do depend on it. A goal in hindsight does not change
            them.

    Raises:
        InvalidValueError: The task has no goals.
    """

    target_is_obstacle = has_goals = True

    def __init__(self, robot: Robot, task: Task = REACH, path: bool = False):
        if not isinstance(task, GoalTask):
            raise InvalidValueError(
                f"a goal environment needs a GoalTask, got the task {type(task).__name__}; choose another observation"
            )
        self._task, self.requires_roadmap = task, path
        features = (*ARM_FEATURES, "clearance", "obstacle_direction", *(PATH_FEATURES if path else ()))
        self._vector = FeatureVector(robot, named_features(*features))
        self.layout = self._vector.layout
        goal = spaces.Box(-MAX_OFFSET, MAX_OFFSET, (3,), dtype=np.float64)
        self.space = spaces.Dict({"observation": self._vector.space, "achieved_goal": goal, "desired_goal": goal})

    def __call__(self, state: State) -> Observed:
        """Return observations (n, size), and achieved and desired goals (n, 3), which are exact (float64)."""
        achieved, desired = self._task.goals(state)
        return {
            "achieved_goal": achieved.copy(),
            "desired_goal": desired.copy(),
            "observation": self._vector(state),
        }


def select(observed: Observed, ids: Any) -> Any:
    """Return the observations of some simulations, or of one."""
    if isinstance(observed, dict):
        return {key: values[ids] for key, values in observed.items()}
    return observed[ids]


def check_goals(observation: ObservationSpec, hidden: str, reward_requires_roadmap: bool) -> None:
    """Check that rewards in a goal environment can be computed from its goals.

    Args:
        observation: The observation.
        hidden: Setting that makes the observed goals differ from the true ones, if any.
        reward_requires_roadmap: The reward reads the roadmap, which knows no path to goals in hindsight.

    Raises:
        InvalidValueError: They cannot.
    """
    if not observation.has_goals:
        return
    if hidden:
        raise InvalidValueError(
            f'observation="goal" computes rewards from the observed goals, but {hidden} makes these differ from the '
            'true goals; choose observation="state"'
        )
    if reward_requires_roadmap:
        raise InvalidValueError(
            'a reward that requires the roadmap, such as "path", has no path to goals in hindsight; choose '
            'reward="dense" or "sparse", or observation="roadmap"'
        )
