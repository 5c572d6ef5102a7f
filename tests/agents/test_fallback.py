"""Fallback of planner agents where the careful plan does not exist or takes too long."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents import PlannerAgent, Problem, planner_agent
from greenhouse_gym.agents.planner_agent import MAX_DEPTH, Level, fallback_levels
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.planning import PLANNERS, PlanResult, plan
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import FREE, OccupancyGrid

ARM = get_robot("ur5e")
LEVELS: list[Level] = [(0.01, MAX_DEPTH), (0.01, "free"), (0.005, "free"), (0.0, "free")]


@pytest.fixture
def scanned(scene: Scene) -> Scene:
    """The scene as a current build makes it: leaves have thin boxes, and some space is unknown."""
    provenance = scene.provenance.model_copy(update={"settings": asdict(BuildSettings())})
    free = OccupancyGrid.from_states(np.full((60, 60, 50), FREE, dtype=np.uint8), [-1.5, -1.5, 0.0], 0.05)
    return scene.model_copy(update={"provenance": provenance, "occupancy": free})


class Asked:
    """Stands in for `plan`: notes the level and the seed, and finds a path only at some of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, finds: Any):
        self.calls: list[tuple[Level, int]] = []
        self._finds = finds
        monkeypatch.setattr(planner_agent, "plan", self)

    def __call__(self, *given: Any, seed: int, margin: float, unknown: str | float, **named: Any) -> PlanResult:
        self.calls.append(((margin, unknown), seed))
        if not self._finds((margin, unknown), seed):
            return PlanResult("no_solution", None, "RRTConnect")
        return plan(*given, seed=seed, margin=margin, unknown=unknown, **named)


def test_caution_is_given_up_step_by_step(scanned: Scene) -> None:
    assert fallback_levels(scanned) == LEVELS
    covered = scanned.provenance.model_copy(update={"protocol": "upright-back"})
    for same in ({"provenance": covered}, {"occupancy": None}):
        assert fallback_levels(scanned.model_copy(update=same)) == LEVELS[1:], "no unknown space is avoided"


@pytest.mark.parametrize("first", range(4))
def test_the_most_cautious_path_is_followed(scanned: Scene, monkeypatch: pytest.MonkeyPatch, first: int) -> None:
    asked = Asked(monkeypatch, lambda level, seed: level == LEVELS[first])
    agent = PlannerAgent()
    agent.reset(Problem(scanned, 0, ARM, ARM.start, 5))
    assert asked.calls == [(level, 5) for level in LEVELS[: first + 1]]
    assert agent.level == LEVELS[first]
    assert agent.status.startswith("solved")
    assert (agent.status == "solved") == (first == 0), "a fallback shows in the records"
    assert agent.act(None).any()


def test_the_last_level_is_tried_from_several_seeds(scanned: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(monkeypatch, lambda level, seed: level == LEVELS[-1] and seed == 8)
    agent = PlannerAgent()
    agent.reset(Problem(scanned, 0, ARM, ARM.start, 5))
    assert asked.calls == [*((level, 5) for level in LEVELS), *((LEVELS[-1], seed) for seed in (6, 7, 8))]
    assert agent.act(None).any()


def test_without_any_path_it_holds_still(scanned: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = Asked(monkeypatch, lambda level, seed: False)
    agent = PlannerAgent(attempts=2)
    agent.reset(Problem(scanned, 0, ARM, ARM.start))
    assert len(asked.calls) == len(LEVELS) + 1
    assert agent.status == "no_solution"
    assert not agent.act(None).any()


@pytest.mark.parametrize(
    ("options", "levels"),
    [
        ({"fallback": False}, LEVELS[:1]),
        ({"margin": 0.02}, [(0.02, MAX_DEPTH), (0.02, "free")]),
        ({"unknown": "forbid"}, [(0.01, "forbid"), (0.005, "forbid"), (0.0, "forbid")]),
        ({"margin": 0.0, "unknown": "free"}, LEVELS[-1:]),
    ],
)
def test_choices_are_kept(
    scanned: Scene, monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], levels: list[Level]
) -> None:
    asked = Asked(monkeypatch, lambda level, seed: False)
    PlannerAgent(attempts=1, **options).reset(Problem(scanned, 0, ARM, ARM.start))
    assert [level for level, _ in asked.calls] == levels


def test_a_path_that_takes_too_long_is_the_last_resort(scanned: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """A detour of the careful plan does not fit into the episode, the direct path of a bolder one does."""

    def detour(*given: Any, margin: float, **named: Any) -> PlanResult:
        result = plan(*given, margin=margin, **named)
        assert result.path is not None
        if named["unknown"] == MAX_DEPTH or margin < 0.01:
            there = np.repeat(result.path[:1], 41, axis=0)
            there[1::2, 5] += 1.0 if margin < 0.01 else 3.0  # turns its tool to and fro
            result = PlanResult("solved", np.concatenate([there, result.path]), "RRTConnect")
        return result

    monkeypatch.setattr(planner_agent, "plan", detour)
    agent = PlannerAgent()
    for step_limit, level in ((10_000, LEVELS[0]), (150, LEVELS[1]), (3, LEVELS[1])):
        agent.reset(Problem(scanned, 0, ARM, ARM.start, step_limit=step_limit))
        assert agent.level == level, "the fastest, if none fits"
        assert agent.act(None).any()


def test_every_planner_falls_back(scanned: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    for planner in ("ShortcutConnect", "RRT"):
        if planner in PLANNERS:
            asked = Asked(monkeypatch, lambda level, seed: level == LEVELS[-1])
            agent = PlannerAgent(planner)
            agent.reset(Problem(scanned, 0, ARM, ARM.start))
            assert [level for level, _ in asked.calls] == LEVELS
            assert agent.status.startswith("solved")
