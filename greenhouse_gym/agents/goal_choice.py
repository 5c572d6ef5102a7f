"""Agents that choose one of several goal configurations by a critic, and move to it by a policy.

The goals come from inverse kinematics and collision checks of the known scene. No path is planned: the network
observes the offset to its goal, the room around the arm there, and what every policy observes around the arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.agent import NamedAgent, Problem
from greenhouse_gym.agents.goal_inputs import flaw_of, goal_input, goal_layout, observes_goal
from greenhouse_gym.agents.policy import Float32, Policy
from greenhouse_gym.agents.policy_agent import PolicyAgent, check_arm, read_policy
from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.motion.goal_options import GoalOptions, goal_options

MAX_STALL, PROGRESS = 20, 0.02
"""Number of actions after which another goal is chosen if the arm has come no nearer than by ``PROGRESS``, radians."""

_POSITION = "joint_position", "command_error"


class GoalChoosingAgent(NamedAgent):
    """A learned policy that moves to the goal configuration which its critic values most at the start.

    Where no goal is free, it moves to its start. An arm that is held up, by a shield for example, chooses another goal.

    Args:
        policy: A policy with a critic, whose last features are those of `goal_layout`.
        name: Name in tables.

    Raises:
        InvalidValueError: The policy has no critic, or does not observe a goal as it should.

    Attributes:
        env_options: Keywords of `gymnasium.make` for the environment it needs.
        knows_scene: True: goals are checked for collisions with all shapes of the scan.
        policy: The network.
    """

    knows_scene = True

    def __init__(self, policy: Policy, name: str = "policy"):
        if not observes_goal(policy.layout):
            raise InvalidValueError(f"policy {name!r} observes no goal configuration; load it with `load_policy`")
        if flaw := flaw_of(policy.layout, bool(policy.value_weights)):
            raise InvalidValueError(f"policy {name!r} cannot choose goals: {flaw}")
        self.name, self.policy = name, policy
        self.env_options: Mapping[str, Any] = policy.env_options
        self._at = feature_slices(policy.layout[: -len(goal_layout(0, 0))])
        self._found = self._options = GoalOptions(np.empty((0, 0)), np.empty((0, 0)))
        self._untried, self._nearest, self._since = np.empty(0, dtype=np.int64), np.inf, 0

    def reset(self, problem: Problem) -> None:
        """Find the goals of the episode.

        Raises:
            InvalidValueError: The policy was trained for another arm.
        """
        check_arm(self, problem)
        found = goal_options(problem.compiled, problem.target, problem.start)
        if not len(found.configurations):
            room = np.zeros((1, len(problem.robot.probes)))
            found = GoalOptions(problem.start[None], room)
        self._found = self._options = found
        self._untried, self._nearest, self._since = np.empty(0, dtype=np.int64), np.inf, MAX_STALL

    def act(self, observation: Any) -> Float32:
        """Return the next action (joints,); the first one of an episode chooses the goal."""
        joints, error = (np.asarray(observation[self._at[name]], dtype=np.float64) for name in _POSITION)
        distance = float(np.abs(self._options.configurations[0] - joints - error).max())
        if self._since == MAX_STALL:
            if not len(self._untried):
                self._untried = np.arange(len(self._found.configurations))
            self._options = self._of(self._untried)
            chosen = int(self.policy.value(self.network_input(observation)).argmax())
            self._options = self._of(self._untried[chosen : chosen + 1])
            self._untried = np.delete(self._untried, chosen)
            self._nearest, self._since = np.inf, 0
        elif distance < self._nearest - PROGRESS:
            self._nearest, self._since = distance, 0
        else:
            self._since += 1
        return np.asarray(self.policy(self.network_input(observation))[0])

    def _of(self, ids: npt.NDArray[np.int64]) -> GoalOptions:
        return GoalOptions(*(part[ids] for part in self._found))

    def network_input(self, observation: Any) -> Float32:
        """Return the inputs (k, size) of the network for each goal that is left: one after the first action."""
        goals, clearance = self._options
        return goal_input(np.broadcast_to(observation, (len(goals), len(observation))), self._at, goals, clearance)


def load_policy(policy: str | Path) -> PolicyAgent | GoalChoosingAgent:
    """Load a shipped policy by name, or any policy by its path or the folder of its training, as an agent.

    Raises:
        UnknownNameError: Neither the name of a shipped policy nor a file.
        FileFormatError: Its files are missing or damaged.
    """
    network, name = read_policy(policy)
    return GoalChoosingAgent(network, name) if observes_goal(network.layout) else PolicyAgent(network, name)
