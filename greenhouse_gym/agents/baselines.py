"""Simple agents for comparison."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import JointAgent, Problem
from greenhouse_gym.agents.planner_agent import PathFollower
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.observations import PATH_FEATURES, TOOL_FEATURES, StateObservation
from greenhouse_gym.planning import goal_configurations


class RandomAgent(JointAgent):
    """Draw every action uniformly."""

    name = "random"
    knows_scene = False

    def __init__(self) -> None:
        self._rng = np.random.default_rng(0)
        self._bounds: tuple[Any, Any] = (0.0, 0.0)

    def reset(self, problem: Problem) -> None:
        """Seed the actions of the episode."""
        self._rng = np.random.default_rng(problem.seed)
        self._bounds = problem.action_space.low, problem.action_space.high

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return a uniform sample of the action space."""
        return np.asarray(self._rng.uniform(*self._bounds), dtype=np.float32)


class StraightLineAgent(JointAgent):
    """Move straight to the free goal configuration nearest to the start, regardless of obstacles.

    It needs an environment whose actions move the joints.
    """

    name = "straight-line"

    def __init__(self) -> None:
        self._follower: PathFollower | None = None

    def reset(self, problem: Problem) -> None:
        """Choose the goal."""
        goals = goal_configurations(problem.scene, problem.target, problem.robot, seed=problem.seed).configurations
        nearest = np.abs(goals - problem.start).max(-1).argsort()[:1]  # empty if there is no goal
        self._follower = PathFollower(np.concatenate([problem.start[None], goals[nearest]]), problem)

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the next action along the line."""
        if self._follower is None:
            raise RuntimeError("reset the agent before it acts")
        return self._follower.action()


class WaypointAgent(JointAgent):
    """Move straight to the observed waypoint; hold still while no collision-free waypoint is known.

    This is what `observation="roadmap"` achieves without any learning.
    It needs an environment whose actions move the joints.
    """

    name = "roadmap"
    env_options: Mapping[str, Any] = MappingProxyType({**JointAgent.env_options, "observation": "roadmap"})

    def __init__(self) -> None:
        self._direction = self._path = slice(0)

    def reset(self, problem: Problem) -> None:
        """Find the indices of the waypoint's direction and of its flag in the observation."""
        groups = feature_slices(StateObservation(problem.robot, extra=PATH_FEATURES, without=TOOL_FEATURES).layout)
        self._direction, self._path = groups["waypoint_direction"], groups["path"]

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the action towards the waypoint at full speed."""
        free = observation[self._path][1]
        return np.asarray(observation[self._direction] * free, dtype=np.float32)
