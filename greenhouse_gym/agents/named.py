"""Agents by name, and own agents by file or module."""

from __future__ import annotations

import reprlib
from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

from greenhouse_gym.agents.agent import Agent, check_agent
from greenhouse_gym.agents.baselines import RandomAgent, StraightLineAgent, WaypointAgent
from greenhouse_gym.agents.goal_choice import load_policy
from greenhouse_gym.agents.harvest.harvester import OracleHarvester
from greenhouse_gym.agents.harvest.scan_harvester import ScanHarvester
from greenhouse_gym.agents.harvest.truss_cutter import TrussCutter
from greenhouse_gym.agents.hybrid import HybridAgent
from greenhouse_gym.agents.looking import FixedViewsAgent, NextBestViewAgent, RandomViewsAgent
from greenhouse_gym.agents.planner_agent import PlannerAgent
from greenhouse_gym.agents.policy import description_path
from greenhouse_gym.agents.policy_agent import shipped_policies
from greenhouse_gym.agents.shield import ShieldedAgent
from greenhouse_gym.agents.watchful import WatchfulAgent
from greenhouse_gym.common.own_code import load_own, make
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError, UnknownNameError
from greenhouse_gym.planning import PAPER_PLANNERS, PLANNERS

_NAMED: tuple[type[Agent], ...] = (
    RandomAgent, StraightLineAgent, WaypointAgent, HybridAgent, ShieldedAgent, WatchfulAgent,
    NextBestViewAgent, FixedViewsAgent, RandomViewsAgent,
)  # fmt: skip
SIMPLE: dict[str, Callable[[], Agent]] = {
    **{agent.name: agent for agent in _NAMED}, "harvest-oracle": OracleHarvester, "harvest-scan": ScanHarvester,
    "truss-cutter": TrussCutter,
}  # fmt: skip
"""Agents by name that are made without arguments."""

_SHIELDED, _WATCHFUL = "shielded-", f"{WatchfulAgent.name}-"
_CHECKPOINT = "checkpoint.safetensors"
_LONGEST_NAME = 1000  # characters; longer paths are errors of the system


def _training(path: Path) -> Path | None:
    """Return the folder of a training, given the folder or its checkpoint; None for anything else."""
    if path.name == _CHECKPOINT:
        return path.parent if path.is_file() else None
    files = (path / _CHECKPOINT, description_path(path / "policy"))  # trainings on Warp have no checkpoint
    return path if any(file.is_file() for file in files) else None


def agent_of(agent: Agent | str) -> Agent:
    """Return an agent, given itself or its name, see `make_agent`.

    Raises:
        InvalidValueError: It is not an agent.
    """
    if isinstance(agent, str):
        return make_agent(agent)
    check_agent(agent)
    return agent


def make_agent(name: str) -> Agent:
    """Make an agent by name: a baseline, a planner, a shipped policy, a policy's file, or your own.

    Args:
        name: Such as "random", "RRTConnect", "ppo-ur5e", "shielded-ppo-ur5e", "watchful-ppo-goals-ur5e",
            "runs/ppo/policy.json", "runs/ppo" (the folder of a training), "my_agent.py:MyAgent" or
            "my_package.agents:MyAgent": a class that is called without arguments, or an agent.

    Raises:
        UnknownNameError: No such agent; the message lists those of every kind.
        FileFormatError: The file of a policy or of your own agent is missing or fails to run.
        InvalidValueError: The name refers to something that is not an agent.
        MissingDependencyError: The name is a planner's, and OMPL is not installed.
    """
    if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_NAME:
        raise InvalidValueError(f"expected the name of an agent, got {reprlib.repr(name)}")
    if name in SIMPLE:
        return SIMPLE[name]()
    _, colon, attribute = name.rpartition(":")
    if (colon and attribute.isidentifier()) or name.endswith(".py"):
        agent: Any = load_own(name, "agent", lambda value: isinstance(value, type) and hasattr(value, "act"))
        agent = make(agent, name, {}) if isinstance(agent, type) else agent
        check_agent(agent)
        return agent  # type: ignore[no-any-return]
    shielded = name.removeprefix(_SHIELDED)
    if shielded != name and shielded in shipped_policies():
        return ShieldedAgent(load_policy(shielded), name)
    rehearsed = name.removeprefix(_WATCHFUL)
    if rehearsed != name and rehearsed in shipped_policies():
        return WatchfulAgent(policy=rehearsed)
    if name in shipped_policies() or description_path(name).is_file():
        return load_policy(name)
    if training := _training(Path(name)):
        if description_path(training / "policy").is_file():
            return load_policy(training)
        # by name, because that package imports this one
        load: Callable[[Path], Agent] = resolve_name("greenhouse_gym.learning:TrainedAgent")
        return load(training)
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
    own = f"({_SHIELDED}POLICY, {_WATCHFUL}POLICY, a policy's file, a training's folder, file.py:Class or module:Class)"
    raise UnknownNameError("agent", name, [*SIMPLE, *shipped_policies(), own, *planners])
