"""Agents by name, and own agents by file or module."""

from __future__ import annotations

import importlib
import importlib.util
from pathlib import Path
from types import ModuleType

from greenhouse_gym.agents.agent import Agent, check_agent
from greenhouse_gym.agents.baselines import RandomAgent, StraightLineAgent, WaypointAgent
from greenhouse_gym.agents.hybrid import HybridAgent
from greenhouse_gym.agents.planner_agent import PlannerAgent
from greenhouse_gym.agents.policy import description_path
from greenhouse_gym.agents.policy_agent import PolicyAgent, shipped_policies
from greenhouse_gym.agents.shield import ShieldedAgent
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError, UnknownNameError
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS

_NAMED: tuple[type[Agent], ...] = (
    RandomAgent, StraightLineAgent, WaypointAgent, HybridAgent, ShieldedAgent, WatchfulAgent,
)  # fmt: skip
SIMPLE = {agent.name: agent for agent in _NAMED}
"""Agents by name that are made without arguments."""


def make_agent(name: str) -> Agent:
    """Make an agent by name: a baseline, a planner, a shipped policy, a policy's file, or your own.

    Args:
        name: Such as "random", "RRTConnect", "ppo-ur5e", "runs/ppo/policy.json", "my_agent.py:MyAgent" or
            "my_package.agents:MyAgent": a class that is called without arguments, or an agent.

    Raises:
        UnknownNameError: No such agent; the message lists those of every kind.
        FileFormatError: The file of a policy or of your own agent is missing or fails to run.
        InvalidValueError: The name refers to something that is not an agent.
        MissingDependencyError: The name is a planner's, and OMPL is not installed.
    """
    if name in SIMPLE:
        return SIMPLE[name]()
    module, colon, attribute = name.rpartition(":")
    if colon and attribute.isidentifier():
        return _own_agent(module, attribute)
    if name in shipped_policies() or description_path(name).is_file():
        return PolicyAgent.load(name)
    if name.endswith(".json"):
        raise FileFormatError(name, "there is no such file; expected a policy's description")
    try:
        planners = tuple(PLANNERS)  # starts the planning process, so not before it is needed
    except MissingDependencyError:
        if name in PAPER_PLANNERS:
            raise
        planners = ()
    if name in planners or name in PAPER_PLANNERS:
        return PlannerAgent(name)  # raises if OMPL is missing
    own = "(a policy's file, file.py:Class or module:Class)"
    raise UnknownNameError("agent", name, [*SIMPLE, *shipped_policies(), own, *planners])


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
