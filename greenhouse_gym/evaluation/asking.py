"""Answers of an agent to the questions of an evaluation, which asks each once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from greenhouse_gym.agents.agent import Agent, knows_truth, own_options
from greenhouse_gym.agents.named import agent_of
from greenhouse_gym.common.own_code import describe, printable
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.evaluation.deadline import Deadline


class AgentError(GreenhouseError, RuntimeError):
    """Raised for an agent that fails before its first valid action."""


def never_acted(name: str, seed: int, failure: str) -> AgentError:
    """Return the error for an agent that failed before its first action."""
    return AgentError(f"agent {name!r} failed before its first action (seed {seed}): {failure}")


@dataclass(frozen=True)
class AskedAgent:
    """An agent, and its answers to the questions of an evaluation.

    Attributes:
        agent: The agent.
        name: Its name.
        env_options: Keywords that it chooses for the environment.
        knows_truth: True if it declares that it knows the truth.
        acts_on_many: True if it has a method ``act_many``.
    """

    agent: Agent
    name: str
    env_options: Mapping[str, Any]
    knows_truth: bool
    acts_on_many: bool

    @classmethod
    def of(cls, agent: Agent | str, options: Mapping[str, Any] = MappingProxyType({})) -> AskedAgent:
        """Ask an agent, or an agent by name.

        Args:
            agent: The agent.
            options: Keywords of the environment that the user chooses.

        Raises:
            InvalidValueError: It is not an agent.
            AgentError: It fails to answer.
        """
        agent = agent_of(agent)

        def asked() -> AskedAgent:
            name, own = printable(str.__str__(agent.name)), own_options(agent, options)  # of subclasses, too
            return cls(agent, name, own, knows_truth(agent), hasattr(agent, "act_many"))

        try:
            return Deadline().call(asked)
        except Exception as error:
            kind = type(agent).__name__
            raise AgentError(
                f"agent {kind} failed to say its name, env_options or knows_truth: {describe(error)}"
            ) from error
