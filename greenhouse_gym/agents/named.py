"""Agents by name, and anyone's own agent by its file or module."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

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
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError, UnknownNameError
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
    module, colon, attribute = name.rpartition(":")
    if colon and attribute.isidentifier():
        return _own_agent(module, attribute)
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


def _own_agent(module: str, attribute: str) -> Agent:
    loaded = _from_file(module) if module.endswith(".py") else _from_path(module)
    if not hasattr(loaded, attribute):
        classes = [key for key, value in vars(loaded).items() if isinstance(value, type) and hasattr(value, "act")]
        raise UnknownNameError(f"agent in {module}", attribute, classes)
    found = getattr(loaded, attribute)
    try:
        agent: Agent = found() if isinstance(found, type) else found
    except TypeError as error:
        raise InvalidValueError(f"{module}:{attribute} cannot be made without arguments: {error}") from error
    check_agent(agent)
    return agent


def _from_path(module: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except (ImportError, ValueError) as error:
        raise InvalidValueError(f"module {module!r} cannot be imported: {error}") from error


def _from_file(file: str) -> ModuleType:
    if not Path(file).is_file():
        raise FileFormatError(file, "there is no such file; expected Python code with an agent")
    spec = importlib.util.spec_from_file_location("own_agent", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever stands in it
        raise FileFormatError(file, f"cannot be run: {type(error).__name__}: {error}") from error
    return module
