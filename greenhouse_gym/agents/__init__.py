"""Agents: the protocol, baselines, planners, policies, and active perception."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.baselines import RandomAgent, StraightLineAgent, WaypointAgent
from greenhouse_gym.agents.planner_agent import PlannerAgent

if TYPE_CHECKING:
    from greenhouse_gym.agents.goal_choice import GoalChoosingAgent, load_policy
    from greenhouse_gym.agents.hybrid import HybridAgent
    from greenhouse_gym.agents.looking import FixedViewsAgent, NextBestViewAgent, RandomViewsAgent
    from greenhouse_gym.agents.named import make_agent
    from greenhouse_gym.agents.policy_agent import PolicyAgent
    from greenhouse_gym.agents.shield import ShieldedAgent
    from greenhouse_gym.agents.watchful import WatchfulAgent

__all__ = [
    "Agent",
    "FixedViewsAgent",
    "GoalChoosingAgent",
    "HybridAgent",
    "NextBestViewAgent",
    "PlannerAgent",
    "PolicyAgent",
    "Problem",
    "RandomAgent",
    "RandomViewsAgent",
    "ShieldedAgent",
    "StraightLineAgent",
    "WatchfulAgent",
    "WaypointAgent",
    "load_policy",
    "make_agent",
]


# imported on first use, because their dependencies take long to import
_LAZY = {
    "FixedViewsAgent": "looking",
    "GoalChoosingAgent": "goal_choice",
    "HybridAgent": "hybrid",
    "NextBestViewAgent": "looking",
    "PolicyAgent": "policy_agent",
    "RandomViewsAgent": "looking",
    "ShieldedAgent": "shield",
    "WatchfulAgent": "watchful",
    "load_policy": "goal_choice",
    "make_agent": "named",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"{__name__}.{_LAZY[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
