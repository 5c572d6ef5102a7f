"""Default caution of planner agents: depth in unknown space, and distance from leaves."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.agents import Problem, planner_agent
from greenhouse_gym.agents.planner_agent import LEAF_MARGIN, MAX_DEPTH, PlannerAgent, default_margin, default_unknown
from greenhouse_gym.build.scenes import BuildSettings
from greenhouse_gym.planning import PlanResult, plan
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.occupancy import FREE, OccupancyGrid


@pytest.mark.parametrize(("protocol", "care"), [(None, MAX_DEPTH), ("paper", MAX_DEPTH), ("upright-back", "free")])
def test_care_is_for_scans_that_do_not_see_the_leaves_in_the_aisle(
    protocol: str | None, care: str | float, bank: SceneBank
) -> None:
    blind: Scene = bank.scene("made-up-0")
    provenance = blind.provenance.model_copy(update={"protocol": protocol})
    seen = OccupancyGrid.from_states(np.full((2, 2, 2), FREE, dtype=np.uint8), [0.0, 0.0, 0.0], 0.05)
    assert default_unknown(blind.model_copy(update={"provenance": provenance, "occupancy": seen})) == care
    assert default_unknown(blind.model_copy(update={"provenance": provenance})) == "free"


@pytest.mark.parametrize(
    ("settings", "margin"),
    [
        (asdict(BuildSettings()), LEAF_MARGIN),
        ({"shapes": {"clutter_per_metre": 85}}, 0.0),
        ({"shapes": ["clutter_per_area"]}, 0.0),
        ({"shapes": None}, 0.0),
        ({}, 0.0),
    ],
)
def test_boxes_that_go_by_the_foliage_are_kept_off(
    settings: dict[str, Any], margin: float, bank: SceneBank, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene: Scene = bank.scene("made-up-0")
    built = scene.model_copy(update={"provenance": scene.provenance.model_copy(update={"settings": settings})})
    assert default_margin(built) == margin
    robot, asked = get_robot("ur5e"), []

    def noting(*arguments: Any, **options: Any) -> PlanResult:
        asked.append(options["margin"])
        return plan(*arguments, **options)

    monkeypatch.setattr(planner_agent, "plan", noting)
    for agent in (PlannerAgent(), PlannerAgent(margin=0.0), PlannerAgent(margin=0.03)):
        agent.reset(Problem(built, 4, robot, robot.start))
    assert asked == [margin, 0.0, 0.03]
