"""An agent that plans once at an episode's start and follows its path."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.envs.reach_task import ACTION_STEP, SUBSTEPS
from greenhouse_gym.geometry import Array
from greenhouse_gym.planning import PlanResult, follow_path, plan
from greenhouse_gym.scene.mjcf import TIMESTEP

INTERVAL = SUBSTEPS * TIMESTEP
"""Seconds from one action to the next."""


class PlannerAgent:
    """Plans with OMPL and follows the path through the environment's joint actions; stays still without a path.

    Attributes:
        result: The last episode's plan, or None before the first.
        commands: (steps, joints) commands of the last episode, radians.
    """

    env_options: Mapping[str, Any] = MappingProxyType({})

    def __init__(
        self,
        planner: str = "RRTConnect",
        time_limit: float = 5.0,
        max_checks: int | None = None,
        goals: int = 60,
        name: str | None = None,
    ):
        """Keep what `greenhouse_gym.planning.plan` shall be called with, and the name shown in tables."""
        self.name = name or planner
        self.planner, self.time_limit, self.max_checks, self.goals = planner, time_limit, max_checks, goals
        self.result: PlanResult | None = None
        self.commands: Array = np.empty((0, 0))
        self._last: Array = np.empty(0)
        self._step = 0

    @property
    def planning_time(self) -> float:
        """Seconds from the problem to the path in the last episode: goals, search and simplification."""
        r = self.result
        return 0.0 if r is None else r.goal_time + r.planning_time + r.simplification_time

    def reset(self, problem: Problem) -> None:
        """Plan."""
        arm = problem.robot
        self.result = plan(
            problem.scene, problem.target, arm, self.planner, self.time_limit, self.max_checks, self.goals,
            seed=problem.seed, start=problem.start,
        )  # fmt: skip
        path = problem.start[None] if self.result.path is None else self.result.path
        speed = np.minimum(arm.velocity_limits, ACTION_STEP / INTERVAL)
        self.commands = follow_path(path, speed, arm.acceleration_limits, INTERVAL)
        self._last, self._step = problem.start, 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The step to the next command; zero at the end of the path."""
        if self._step >= len(self.commands):
            return np.zeros(len(self._last), dtype=np.float32)
        command = self.commands[self._step]
        action = (command - self._last) / ACTION_STEP
        self._last, self._step = command, self._step + 1
        return action.astype(np.float32)
