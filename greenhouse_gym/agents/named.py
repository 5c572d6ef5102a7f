"""Agents by name, and anyone's own agent by its file or module."""

from __future__ import annotations

from greenhouse_gym.agents.agent import Agent, check_agent
from greenhouse_gym.agents.baselines import RandomAgent, StillAgent, StraightLineAgent, WaypointAgent
from greenhouse_gym.agents.careful import CarefulAgent
from greenhouse_gym.agents.depth_agent import DepthAgent
from greenhouse_gym.agents.exploring import ExploringAgent
from greenhouse_gym.agents.guide import GuidedAgent
from greenhouse_gym.agents.hybrid import HybridAgent
from greenhouse_gym.agents.judging import FEATURES
from greenhouse_gym.agents.planner_agent import PlannerAgent
from greenhouse_gym.agents.policy import described_at
from greenhouse_gym.agents.policy_agent import PolicyAgent, shipped_policies
from greenhouse_gym.agents.resolved_rate import ResolvedRateAgent
from greenhouse_gym.agents.shield import ShieldedAgent
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.common.own_code import load_object
from greenhouse_gym.errors import FileFormatError, MissingDependencyError, UnknownNameError
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS

_NAMED: tuple[type[Agent], ...] = (
    RandomAgent, StillAgent, StraightLineAgent, ResolvedRateAgent, WaypointAgent, CarefulAgent, GuidedAgent,
    HybridAgent, ShieldedAgent, DepthAgent, WatchfulAgent, ExploringAgent,
)  # fmt: skip
SIMPLE = {agent.name: agent for agent in _NAMED}
"""Agents that need nothing but a name."""


def make_agent(name: str) -> Agent:
    """An agent by name: a simple one, a planner, a shipped policy, a policy's file, or one's own.

    Args:
        name: Such as "random", "RRTConnect", "ppo-ur5e", "runs/ppo/policy.json", "my_agent.py:MyAgent" or
            "my_package.agents:MyAgent": a class that is called without arguments, or an agent.

    Raises:
        UnknownNameError: There is no such agent; the message lists those of every kind.
        FileFormatError: The file of a policy or of one's own agent is missing, or cannot be run.
        InvalidValueError: What it names is no agent.
        MissingDependencyError: It is a planner, and OMPL is not installed.
    """
    if name in SIMPLE:
        return SIMPLE[name]()
    _, colon, attribute = name.rpartition(":")
    if colon and attribute.isidentifier():
        agent: Agent = load_object(name, "agent", lambda value: isinstance(value, type) and hasattr(value, "act"))
        check_agent(agent)
        return agent
    if name in shipped_policies() or described_at(name).is_file():
        return _learned(name)
    if name.endswith(".json"):
        raise FileFormatError(name, "there is no such file; expected a policy's description")
    try:
        planners = tuple(PLANNERS)  # starts the planning process: only now
    except MissingDependencyError:
        if name in PAPER_PLANNERS:
            raise
        planners = ()
    if name in planners or name in PAPER_PLANNERS:
        return PlannerAgent(name)  # where OMPL is missing, this says so
    own = "(a policy's file, file.py:Class or module:Class)"
    raise UnknownNameError("agent", name, [*SIMPLE, *shipped_policies(), own, *planners])


def _learned(name: str) -> Agent:
    agent = PolicyAgent.load(name)
    return DepthAgent.of(agent.policy, agent.name) if agent.policy.layout == FEATURES else agent
