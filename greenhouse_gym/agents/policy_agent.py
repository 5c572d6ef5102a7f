"""Learned policies as agents."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy.typing as npt

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.goal_features import GOAL_FEATURES, goal_vector
from greenhouse_gym.agents.policy import Float32, Policy, described_at
from greenhouse_gym.common.files import data_path
from greenhouse_gym.errors import InvalidValueError, UnknownNameError

__all__ = ["BEST", "Policy", "PolicyAgent", "shipped_policies"]

BEST = "ppo-waypoint-ur5e"
"""The shipped policy that reaches most: what other agents are made of unless they are given one."""


def shipped_policies() -> dict[str, Path]:
    """The JSON files of the policies that come with the package, by name."""
    return {path.stem: path for path in sorted(data_path("policies").glob("*.json"))}


class PolicyAgent:
    """A learned policy as an `Agent`.

    Attributes:
        name: How it is called in tables.
        env_options: Keywords for `gymnasium.make` that give the environment it needs.
        policy: The network.
    """

    def __init__(self, policy: Policy, name: str = "policy"):
        self.name = name
        self.policy = policy
        self.env_options: Mapping[str, Any] = policy.env_options

    @classmethod
    def load(cls, policy: str | Path) -> PolicyAgent:
        """A shipped policy by name, or any by its path.

        Raises:
            UnknownNameError: Neither a shipped name nor a file.
            FileFormatError: Its files are missing or damaged.
        """
        shipped = shipped_policies()
        path = shipped.get(str(policy)) or described_at(policy)
        if not path.is_file():
            raise UnknownNameError("policy", str(policy), [*shipped, "(or the path of a policy's files)"])
        return cls(Policy.load(path), name=path.stem)

    def reset(self, problem: Problem) -> None:
        """Nothing to prepare: the network has no memory.

        Raises:
            InvalidValueError: The policy was trained for another arm.
        """
        trained_for = Path(self.env_options.get("robot", problem.robot.name)).stem
        if problem.robot.name != trained_for:
            raise InvalidValueError(f"policy {self.name!r} drives {trained_for!r}, got robot {problem.robot.name!r}")

    def act(self, observation: Any) -> Float32:
        """The most likely action, (joints,), or (n, joints) for observations (n, size)."""
        return self.policy(self.fed(observation))

    act_many = act

    def fed(self, observation: Any) -> npt.ArrayLike:
        """What the network is fed of an observation: that itself, or the `goal_vector` of a goal environment's.

        Raises:
            InvalidValueError: The policy reaches for goals, and this is not the observation of a goal environment.
        """
        layout = self.policy.layout
        if layout and layout[-1][0] == GOAL_FEATURES:
            return goal_vector(observation, layout)
        vector: npt.ArrayLike = observation
        return vector
