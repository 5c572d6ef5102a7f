"""An agent whose actions are replaced if they would collide in the known scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Agent, NamedAgent, Problem, check_agent, takes_other_actions
from greenhouse_gym.agents.policy_agent import BEST, PolicyAgent
from greenhouse_gym.envs.actions import CommandLimits, TipVelocity, ToolMotion
from greenhouse_gym.envs.state import control_timing
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import MARGIN, PROOF
from greenhouse_gym.planning import CollisionChecker, planning_model

CANDIDATES = 32
"""Number of random alternatives to an action that would collide."""

SPREAD, GROWTH = 0.3, 0.1
"""Standard deviation of the alternatives, and its growth with every replaced action of the episode."""


class ShieldedAgent(NamedAgent):
    """Take an agent's action if the commanded motion is free, else the nearest of some random alternatives that is.

    It looks one step ahead: it is a projection, not a planner. It checks the motions to the next command from the last
    one and from the estimated position of the arm, which lags behind and cuts corners. This makes contacts rare but
    proves nothing, because the arm's momentum is neglected.
    It takes all of the package's actions. Those of the tip depend on the position of the arm, which is then observed;
    this needs one of the package's observations.

    Args:
        agent: The agent to shield; the best shipped policy when left out.
        name: Name in tables.

    Attributes:
        changed: Number of actions replaced in this episode.
    """

    name = "shielded"

    def __init__(self, agent: Agent | None = None, name: str = "shielded"):
        self.name = name
        self._agent: Agent = PolicyAgent.load(BEST) if agent is None else agent
        check_agent(self._agent)
        self.env_options: Mapping[str, Any] = dict(self._agent.env_options)
        self.takes_other_actions = takes_other_actions(self._agent)
        self.changed = 0
        self._rng = np.random.default_rng(0)
        self._checker: CollisionChecker | None = None
        self._command = self._arm = np.zeros(0)
        self._fraction = 1.0  # of the distance to its command that the arm moves in a step

    def reset(self, problem: Problem) -> None:
        """Prepare the collision checks."""
        self._agent.reset(problem)
        robot, compiled = problem.robot, problem.compiled
        model = planning_model(compiled, problem.target, margin=MARGIN / 2)
        self._problem, self._checker = problem, CollisionChecker(model)
        self._observes = isinstance(problem.rule, TipVelocity)
        if self._observes and not isinstance(self.env_options.get("observation", "state"), str):
            raise InvalidValueError("to shield actions of the tip, choose one of the package's observations by name")
        self._limits = CommandLimits(robot, problem.rule, control_timing(1 / problem.interval))
        self._data, self._tip = mujoco.MjData(model), compiled.tip_site
        yaw = problem.scene.placement.yaw
        self._heading = np.array([[math.cos(yaw), math.sin(yaw)]])
        self._command, self._arm = problem.start, problem.start.copy()
        self._fraction = 1.0 - math.exp(-problem.interval / max(robot.lag, 1e-6))
        self._rng = np.random.default_rng(problem.seed)
        self.changed = 0

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the agent's action, or the nearest collision-free alternative; zero without one."""
        assert self._checker is not None
        if self._observes:
            self._arm, error = _joints_and_command_error(observation, len(self._arm))
            self._command = self._arm + error
        self._data.qpos[:] = self._arm
        mujoco.mj_kinematics(self._checker.model, self._data)
        wished = np.clip(np.asarray(self._agent.act(observation), dtype=np.float64), -1.0, 1.0)
        action = wished if self._is_free(wished) else self._alternative(wished)
        self._command = self._next(action)
        self._arm += (self._command - self._arm) * self._fraction
        return action.astype(np.float32)

    def _alternative(self, wished: Array) -> Array:
        self.changed += 1
        spread = SPREAD + GROWTH * self.changed
        samples = wished + spread * self._rng.normal(size=(CANDIDATES, len(wished)))
        others = np.clip(np.concatenate([wished[None] * [[0.5], [0.25]], samples]), -1.0, 1.0)
        for other in others[np.linalg.norm(others - wished, axis=1).argsort()]:
            if self._is_free(other):
                return other
        return np.zeros_like(wished)

    def _is_free(self, action: Array) -> bool:
        assert self._checker is not None
        end = self._next(action)
        return self._checker.path_is_free([self._arm, end, self._command], PROOF)

    def _next(self, action: Array) -> Array:
        """Return the command (joints,) after an action, radians."""
        data = self._data
        motion = ToolMotion(data.xanchor[None], data.xaxis[None], data.site_xpos[None, self._tip], self._heading)
        change = self._problem.command_change(action, motion)
        return self._limits(self._command[None], change[None], self._arm[None]).position[0]


def _joints_and_command_error(observation: Any, joints: int) -> tuple[Array, Array]:
    """Return joint positions and command errors (joints,), with which all observations of the package begin."""
    if isinstance(observation, Mapping):
        observation = observation["observation" if "observation" in observation else "state"]
    vector = np.asarray(observation, dtype=np.float64)
    return vector[:joints], vector[2 * joints : 3 * joints]
