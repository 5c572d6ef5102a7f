from __future__ import annotations

from collections.abc import Iterator, Mapping
from inspect import signature
from pathlib import Path

import pytest

from greenhouse_gym.agents import PlannerAgent, PolicyAgent, RandomAgent, StraightLineAgent, named
from greenhouse_gym.agents.named import make_agent
from greenhouse_gym.agents.policy_agent import BEST
from greenhouse_gym.cli.agent_commands import watch
from greenhouse_gym.errors import FileFormatError, InvalidValueError, MissingDependencyError, UnknownNameError


def test_names_of_every_kind() -> None:
    assert isinstance(make_agent("random"), RandomAgent)
    assert isinstance(make_agent("straight-line"), StraightLineAgent)
    assert isinstance(make_agent("RRTConnect"), PlannerAgent)
    assert isinstance(make_agent("ppo-ur5e"), PolicyAgent)
    assert isinstance(make_agent("greenhouse_gym.agents:RandomAgent"), RandomAgent)


def test_the_folder_of_a_training_without_a_checkpoint(tmp_path: Path) -> None:
    """Trainings on Warp write a policy alone."""
    PolicyAgent.load("ppo-ur5e").policy.save(tmp_path / "first" / "policy")
    agent = make_agent(str(tmp_path / "first"))
    assert (type(agent), agent.name) == (PolicyAgent, "first")
    assert PolicyAgent.load(tmp_path / "first").name == "first"
    with pytest.raises(UnknownNameError):
        make_agent(str(tmp_path / "first" / "checkpoint.safetensors"))


class WithoutOmpl(Mapping[str, object]):
    def __getitem__(self, name: str) -> object:
        raise MissingDependencyError("ompl", "plan")

    def __iter__(self) -> Iterator[str]:
        raise MissingDependencyError("ompl", "plan")

    def __len__(self) -> int:
        raise MissingDependencyError("ompl", "plan")


def test_policies_need_no_planners(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(named, "PLANNERS", WithoutOmpl())
    assert make_agent("ppo-ur5e").name == "ppo-ur5e"
    assert make_agent("random").name == "random"
    with pytest.raises(UnknownNameError, match="ppo-ur5e"):
        make_agent("ppo-ur5")
    with pytest.raises(MissingDependencyError, match="ompl"):
        make_agent("RRTConnect")


def test_mistakes_in_own_agents_are_told(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text(
        "class Mine:\n    def act(self, observation): ...\nclass Picky(Mine):\n    def __init__(self, x): ...\n"
    )
    with pytest.raises(UnknownNameError, match=r"unknown agent in .*own\.py 'Mein'\. Did you mean 'Mine'\?"):
        make_agent(f"{file}:Mein")
    with pytest.raises(InvalidValueError, match="'Mine' is no agent: its 'name' is missing"):
        make_agent(f"{file}:Mine")
    with pytest.raises(InvalidValueError, match="cannot be made without arguments"):
        make_agent(f"{file}:Picky")
    with pytest.raises(InvalidValueError, match="module 'nowhere' cannot be imported"):
        make_agent("nowhere:Mine")
    file.write_text("1 / 0")
    with pytest.raises(FileFormatError, match=r"own\.py: cannot be run: ZeroDivisionError"):
        make_agent(f"{file}:Mine")
    with pytest.raises(FileFormatError, match="there is no such file"):
        make_agent(f"{tmp_path}/none.py:Mine")


def test_the_policy_that_is_watched_by_default_is_the_best_one() -> None:
    assert signature(watch).parameters["agent"].default == BEST
