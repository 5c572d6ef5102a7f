"""Agents: the protocol, planner and policy agents, simple baselines."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.baselines import RandomAgent, StillAgent, StraightLineAgent, WaypointAgent
from greenhouse_gym.agents.careful import CarefulAgent
from greenhouse_gym.agents.guide import GuidedAgent
from greenhouse_gym.agents.planner_agent import PlannerAgent
from greenhouse_gym.agents.resolved_rate import ResolvedRateAgent

if TYPE_CHECKING:
    from greenhouse_gym.agents.depth_agent import DepthAgent
    from greenhouse_gym.agents.exploring import ExploringAgent
    from greenhouse_gym.agents.hybrid import HybridAgent
    from greenhouse_gym.agents.policy_agent import PolicyAgent
    from greenhouse_gym.agents.shield import ShieldedAgent
    from greenhouse_gym.agents.watchful import WatchfulAgent

__all__ = [
    "Agent",
    "CarefulAgent",
    "DepthAgent",
    "ExploringAgent",
    "GuidedAgent",
    "HybridAgent",
    "PlannerAgent",
    "PolicyAgent",
    "Problem",
    "RandomAgent",
    "ResolvedRateAgent",
    "ShieldedAgent",
    "StillAgent",
    "StraightLineAgent",
    "WatchfulAgent",
    "WaypointAgent",
]


# What takes long to import is loaded only where it is used.
_LATER = {
    "DepthAgent": "depth_agent",
    "ExploringAgent": "exploring",
    "HybridAgent": "hybrid",
    "PolicyAgent": "policy_agent",
    "ShieldedAgent": "shield",
    "WatchfulAgent": "watchful",
}


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(import_module(f"{__name__}.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
