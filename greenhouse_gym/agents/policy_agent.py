"""Learned policies as agents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from greenhouse_gym.agents.agent import Agent, NamedAgent, Problem
from greenhouse_gym.agents.goal_features import GOAL_FEATURES, goal_vector
from greenhouse_gym.agents.policy import Float32, Policy, description_path
from greenhouse_gym.common.files import data_path
from greenhouse_gym.errors import InvalidValueError, UnknownNameError

__all__ = ["BEST", "Policy", "PolicyAgent", "shipped_policies"]

BEST = "ppo-roadmap-ur5e"
"""The shipped policy with the highest success rate, which other agents use by default."""

_WITH_PLAN = ("roadmap", "goal_roadmap")  # observations that hold the next waypoint of a plan


def shipped_policies() -> dict[str, Path]:
    """Return the JSON files of the shipped policies by name."""
    return {path.stem: path for path in sorted(data_path("policies").glob("*.json"))}


class PolicyAgent(NamedAgent):
    """A learned policy as an `Agent`.

    Attributes:
        name: Its name in tables.
        env_options: Keywords of `gymnasium.make` for the environment it needs.
        knows_scene: True if it observes a plan in the whole reconstruction.
        policy: The network.
    """

    def __init__(self, policy: Policy, name: str = "policy"):
        self.name = name
        if policy.value_weights:
            raise InvalidValueError(
                f"policy {name!r} chooses goals by its critic, so it is a GoalChoosingAgent; load it with `load_policy`"
            )
        self.policy = policy
        self.env_options: Mapping[str, Any] = policy.env_options
        self.knows_scene = self.env_options.get("observation") in _WITH_PLAN

    @classmethod
    def load(cls, policy: str | Path) -> PolicyAgent:
        """Load a shipped policy by name, or any policy by its path or the folder of its training.

        Raises:
            UnknownNameError: Neither the name of a shipped policy nor a file.
            FileFormatError: Its files are missing or damaged.
            InvalidValueError: The policy chooses goals, see `greenhouse_gym.agents.GoalChoosingAgent`.
        """
        return cls(*read_policy(policy))

    def reset(self, problem: Problem) -> None:
        """Check the arm; the network has no memory.

        Raises:
            InvalidValueError: The policy was trained for another arm.
        """
        check_arm(self, problem)

    def act(self, observation: Any) -> Float32:
        """Return the most likely action (joints,), or (n, joints) for observations (n, size)."""
        return self.policy(self.network_input(observation))

    act_many = act

    def network_input(self, observation: Any) -> npt.ArrayLike:
        """Return an observation as the network expects it: unchanged, or the `goal_vector` of a goal environment's.

        Raises:
            InvalidValueError: The policy needs a goal environment, and this is the observation of another one.
        """
        layout = self.policy.layout
        if layout and layout[-1][0] == GOAL_FEATURES:
            return goal_vector(observation, layout)
        vector: npt.ArrayLike = observation
        return vector


def read_policy(policy: str | Path) -> tuple[Policy, str]:
    """Return a policy and its name, given a shipped one's name, a path or the folder of a training.

    Raises:
        UnknownNameError: Neither the name of a shipped policy nor a file.
        FileFormatError: Its files are missing or damaged.
    """
    shipped = shipped_policies()
    path, training = shipped.get(str(policy)) or description_path(policy), Path(policy)
    if path.is_file():
        return Policy.load(path), path.stem
    if description_path(training / "policy").is_file():
        return Policy.load(training / "policy"), training.resolve().name
    choices = [*shipped, "(or the path of a policy's files, or a training's folder)"]
    raise UnknownNameError("policy", str(policy), choices)


def check_arm(agent: Agent, problem: Problem) -> None:
    """Check that an agent's policy was trained for the arm of a problem.

    Raises:
        InvalidValueError: It was trained for another arm.
    """
    trained_for = Path(agent.env_options.get("robot", problem.robot.name)).stem
    if problem.robot.name != trained_for:
        raise InvalidValueError(f"policy {agent.name!r} drives {trained_for!r}, got robot {problem.robot.name!r}")
