"""Short texts of what the package returns, and evaluations as tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from greenhouse_gym.agents import RandomAgent, make_agent
from greenhouse_gym.errors import UnknownNameError
from greenhouse_gym.evaluation import Evaluation, Evaluations, compare, evaluate
from greenhouse_gym.planning import PlanResult
from greenhouse_gym.scene import Scene, SceneBank


def test_agents_by_name_are_compared_and_shown(bank: SceneBank) -> None:
    found = compare(["random", RandomAgent(), "straight-line"], episodes=2, bank=bank, step_limit=2)
    assert [e.agent for e in found] == ["random", "random", "straight-line"]
    again = evaluate("random", episodes=2, bank=bank, step_limit=2)
    assert len({tuple(r.total_reward for r in e.records) for e in (found[0], found[1], again)}) == 1
    assert compare("random", episodes=1, bank=bank, step_limit=2)[0].agent == "random"
    assert repr(found[0]) == "Evaluation('random', 2 episodes, success 0.0%, collision 0.0%)"
    assert "| random" in repr(found)
    html = found._repr_html_()
    assert html.count("<tr>") == 4
    with pytest.raises(UnknownNameError, match="radnom"):
        compare(["radnom"], bank=bank)


def test_names_of_agents_are_escaped_in_notebooks() -> None:
    html = Evaluations([Evaluation("<b>", (), "<i>failed")])._repr_html_()
    assert "<b>" not in html
    assert "<i>" not in html


def test_records_become_a_data_frame(bank: SceneBank) -> None:
    pytest.importorskip("pandas")
    found = compare(["random"], episodes=3, bank=bank, step_limit=2)
    frame = found.to_pandas()
    assert list(frame["agent"]) == ["random"] * 3
    assert list(frame["seed"]) == [0, 1, 2]
    assert frame.equals(found[0].to_pandas())
    assert Evaluation("none", ()).to_pandas().empty


def test_texts_are_short_and_say_what_a_thing_is(bank: SceneBank, scene: Scene, tmp_path: Path) -> None:
    assert repr(scene) == str(scene) == (
        "Scene('made-up-0', 12 tomatoes, 8 stems, 8 pieces of clutter, 12 targets (12 easy))"
    )  # fmt: skip
    assert repr(bank).startswith("SceneBank('made-up', 7 scenes: 4 train, 1 validation, 2 test")
    assert repr(make_agent("random")) == "RandomAgent('random')"
    assert repr(PlanResult("timeout", None, "RRTConnect")) == "PlanResult('RRTConnect', timeout, 0 checks, 0.00 s)"
