"""An agent whose actions are changed where they would touch something in the scene as it is known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.policy_agent import BEST, PolicyAgent
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import MARGIN, PROOF
from greenhouse_gym.planning import CollisionChecker, planning_model
from greenhouse_gym.scene import compile_scene

CANDIDATES = 32
"""Other actions that are tried where the agent's own would touch something."""

SPREAD, GROWTH = 0.3, 0.1
"""How far they are strewn around it, and how much farther with every step that the agent is held up."""


class ShieldedAgent:
    """Takes an agent's action where the commanded motion is free, else the nearest of some others whose motion is.

    It looks one step ahead and no farther: a projection, not a planner. Checked are the motions to the next command
    from the last one and from where the arm, which lags behind and cuts corners, is reckoned to be. That makes contacts
    rare, and proves nothing: the arm's momentum is not reckoned with.
    It needs actions that move the joints.

    Args:
        agent: Whose actions; the best of the shipped policies when left out.
        name: Shown in tables.

    Attributes:
        changed: Number of actions of this episode that were changed.
    """

    name = "shielded"

    def __init__(self, agent: Agent | None = None, name: str = "shielded"):
        self.name = name
        self._agent: Agent = agent or PolicyAgent.load(BEST)
        self.env_options: Mapping[str, Any] = dict(self._agent.env_options)
        self.changed = self._held_up = 0
        self._random = np.random.default_rng(0)
        self._checker: CollisionChecker | None = None
        self._command = self._arm = self._steps = self._lower = self._upper = np.zeros(0)
        self._share = 1.0  # of the way to its command that the arm makes in a step

    def reset(self, problem: Problem) -> None:
        """Make the scene ready for checks."""
        self._agent.reset(problem)
        robot, self._steps = problem.robot, problem.joint_steps
        self._checker = CollisionChecker(
            planning_model(compile_scene(problem.scene, robot), problem.target, margin=MARGIN / 2)
        )
        self._command, self._lower, self._upper = problem.start, robot.lower, robot.upper
        self._arm = problem.start.copy()
        self._share = 1.0 - math.exp(-problem.interval / max(robot.lag, 1e-6))
        self._random = np.random.default_rng(problem.seed)
        self.changed = self._held_up = 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The agent's action, or the nearest one found that is free; zero if none is."""
        wished = np.clip(np.asarray(self._agent.act(observation), dtype=np.float64), -1.0, 1.0)
        action = wished if self._is_free(wished) else self._other(wished)
        self._command = self._next(action)
        self._arm += (self._command - self._arm) * self._share
        return action.astype(np.float32)

    def _other(self, wished: Array) -> Array:
        self.changed += 1
        self._held_up += 1
        spread = SPREAD + GROWTH * self._held_up
        strewn = wished + spread * self._random.normal(size=(CANDIDATES, len(wished)))
        others = np.clip(np.concatenate([wished[None] * [[0.5], [0.25]], strewn]), -1.0, 1.0)
        for other in others[np.linalg.norm(others - wished, axis=1).argsort()]:
            if self._is_free(other):
                return other
        return np.zeros_like(wished)

    def _is_free(self, action: Array) -> bool:
        assert self._checker is not None
        end = self._next(action)
        return self._checker.path_is_free([self._arm, end, self._command], PROOF)

    def _next(self, action: Array) -> Array:
        return np.clip(self._command + self._steps * action, self._lower, self._upper)
