"""An agent that follows a policy if a rehearsal succeeds, and plans otherwise."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import closing
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import Agent, NamedAgent, Problem, check_agent, takes_other_actions
from greenhouse_gym.agents.planner_agent import PlannerAgent
from greenhouse_gym.agents.policy_agent import BEST, PolicyAgent
from greenhouse_gym.envs import make_env
from greenhouse_gym.envs.world import capacity_for

MAX_CHECKS, ATTEMPTS = 300_000, 4
"""Collision checks of one plan, and number of attempts. Hard targets of the validation rows for which 100,000 checks
found no path in one attempt were reached with other seeds, or with more checks."""


class HybridAgent(NamedAgent):
    """Rehearse each episode with a policy in the known scene, and plan if the rehearsal fails.

    If the simulated world is the known scene, the episode repeats the rehearsal. A rehearsal takes about as long as
    RRTConnect on an easy target; the policy then reacts to its observations, which a path does not.

    Args:
        policy: Agent that rehearses; the best shipped policy when left out.
        planner: Agent that acts if the rehearsal fails. When left out, RRTConnect with several attempts, which treats
            unknown space as free and keeps no margin, as the rehearsal does.
        name: Name in tables.

    Attributes:
        status: "rehearsed" if the policy acts, else the planner's status.
    """

    name = "hybrid"

    def __init__(self, policy: Agent | None = None, planner: Agent | None = None, name: str = "hybrid"):
        self.name = name
        self._policy: Agent = PolicyAgent.load(BEST) if policy is None else policy
        self._planner: Agent = (
            PlannerAgent(unknown="free", margin=0.0, max_checks=MAX_CHECKS, attempts=ATTEMPTS)
            if planner is None
            else planner
        )
        for agent in (self._policy, self._planner):
            check_agent(agent)
        self.env_options: Mapping[str, Any] = {**self._planner.env_options, **self._policy.env_options}
        self.takes_other_actions = "action" not in self._policy.env_options or takes_other_actions(self._policy)
        self.status = ""
        self._acting: Agent = self._policy

    def reset(self, problem: Problem) -> None:
        """Rehearse, and plan if the rehearsal fails."""
        if self._rehearse(problem):
            self._acting, self.status = self._policy, "rehearsed"
            self._policy.reset(problem)
        else:
            self._acting = self._planner
            self._planner.reset(problem)
            self.status = str(getattr(self._planner, "status", "planned"))

    def act(self, observation: Any) -> npt.NDArray[np.floating[Any]]:
        """Return the next action of the agent that acts in this episode."""
        return self._acting.act(observation)

    def _rehearse(self, problem: Problem) -> bool:
        """Return whether the policy reaches the target in the known scene."""
        capacity = capacity_for(problem.scene.count)
        options = {**self.env_options, "robot": problem.robot, "rate": 1 / problem.interval, "capacity": capacity}
        if problem.action is not None:
            options["action"] = problem.action
        episode = {"scene": problem.scene, "target": problem.target, "start": problem.start}
        with closing(make_env(bank="mini", **options)) as env:
            observation, info = env.reset(options=episode)
            self._policy.reset(problem)
            over = False
            while not over:
                observation, _, terminated, truncated, info = env.step(self._policy.act(observation))
                over = terminated or truncated
        return bool(info["is_success"])
