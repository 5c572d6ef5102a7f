"""Agents: the protocol, planner and policy agents, simple baselines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.baselines import RandomAgent, StillAgent, StraightLineAgent
from greenhouse_gym.agents.planner_agent import PlannerAgent

if TYPE_CHECKING:
    from greenhouse_gym.agents.hybrid import HybridAgent
    from greenhouse_gym.agents.policy_agent import PolicyAgent

__all__ = [
    "Agent",
    "HybridAgent",
    "PlannerAgent",
    "PolicyAgent",
    "Problem",
    "RandomAgent",
    "StillAgent",
    "StraightLineAgent",
]


def __getattr__(name: str) -> Any:
    if name == "PolicyAgent":  # learned policies are loaded only where they are used
        from greenhouse_gym.agents.policy_agent import PolicyAgent

        return PolicyAgent
    if name == "HybridAgent":
        from greenhouse_gym.agents.hybrid import HybridAgent

        return HybridAgent
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
