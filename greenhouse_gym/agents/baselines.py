"""Simple agents to measure others against."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.envs.observations import PATH_FEATURES, StateObservation
from greenhouse_gym.planning import goal_configurations

_NOTHING_SPECIAL: Mapping[str, Any] = MappingProxyType({})


class StillAgent:
    """Never moves."""

    name = "still"
    env_options = _NOTHING_SPECIAL

    def __init__(self) -> None:
        self._action = np.zeros(0, dtype=np.float32)

    def reset(self, problem: Problem) -> None:
        """Note the size of an action."""
        self._action = np.zeros(problem.action_space.shape, dtype=np.float32)

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Zero."""
        return self._action


class RandomAgent:
    """Draws every action uniformly."""

    name = "random"
    env_options = _NOTHING_SPECIAL

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._bounds: tuple[Any, Any] = (0.0, 0.0)

    def reset(self, problem: Problem) -> None:
        """Begin the episode's own random sequence."""
        self._random = np.random.default_rng(problem.seed)
        self._bounds = problem.action_space.low, problem.action_space.high

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Uniform in the space of actions."""
        return np.asarray(self._random.uniform(*self._bounds), dtype=np.float32)


class StraightLineAgent:
    """Takes the free goal configuration nearest to the start and moves there straight, whatever is in between.

    It needs an environment whose actions move the joints.
    """

    name = "straight-line"
    env_options = _NOTHING_SPECIAL

    def __init__(self) -> None:
        self._follower: PathFollower | None = None

    def reset(self, problem: Problem) -> None:
        """Choose the goal."""
        ends = goal_configurations(problem.scene, problem.target, problem.robot, seed=problem.seed).configurations
        nearest = np.abs(ends - problem.start).max(-1).argsort()[:1]  # empty where no goal exists
        self._follower = PathFollower(np.concatenate([problem.start[None], ends[nearest]]), problem)

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The next action along the line."""
        if self._follower is None:
            raise RuntimeError("reset the agent before it acts")
        return self._follower.action()


class WaypointAgent:
    """Goes straight to the waypoint that it is told, and stays where it is while there is no free way to one.

    That is what `observation="waypoint"` is worth without any learning.
    It needs an environment whose actions move the joints.
    """

    name = "waypoint"
    env_options: Mapping[str, Any] = MappingProxyType({"observation": "waypoint"})

    def __init__(self) -> None:
        self._direction = self._way = slice(0)

    def reset(self, problem: Problem) -> None:
        """Find the places of the direction, and of whether it is free, in the observation."""
        ends = {}
        end = 0
        for name, size in StateObservation(problem.robot, extra=PATH_FEATURES).layout:
            end += size
            ends[name] = slice(end - size, end)
        self._direction, self._way = ends["waypoint_direction"], ends["path"]

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The action that goes as far that way as it may."""
        free = observation[self._way][1]
        return np.asarray(observation[self._direction] * free, dtype=np.float32)
