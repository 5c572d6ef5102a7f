"""Roadmaps by caution level: the most cautious one that connects start and target."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from occupancy_helpers import known_where

from greenhouse_gym.geometry import Box
from greenhouse_gym.motion import caution
from greenhouse_gym.motion.caution import CautionLevel, apply_caution, cautious_roadmap
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, compile_scene

ARM = get_robot("ur5e")
TARGET = 4


def goals_in(scene: Scene) -> GoalSampler:
    return GoalSampler(compile_scene(scene, ARM), TARGET, ARM.start)


def test_a_cautious_path_stays_in_observed_space(scene: Scene) -> None:
    partly = known_where(scene, 1.7, aisle=0.3)
    levels = [CautionLevel(0.0, 0.0), CautionLevel(0.0, 0.1)]
    roadmap, level = cautious_roadmap(partly, ARM, goals_in(partly), levels)
    assert level == levels[0]
    checker = CollisionChecker(planning_model(apply_caution(partly, ARM, ARM.start, level), TARGET, margin=0.0))
    assert checker.path_is_free([ARM.start, *roadmap.path(ARM.start)], 0.04)


@pytest.mark.parametrize(
    ("free_from", "found", "searched"),
    [
        (0.0, 0.1, [0.1]),
        (0.2, 0.2, [0.1, np.inf, 0.15, 0.2]),
        (np.inf, np.inf, [0.1, np.inf, 0.15, 0.2]),
        (None, np.inf, [0.1, np.inf]),
    ],
    ids=["at once", "deeper", "at the last alone", "nowhere"],
)
def test_levels_in_between_are_not_searched_if_the_last_one_has_no_path(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, free_from: float | None, found: float, searched: list[float]
) -> None:
    tried: list[float] = []

    def roadmaps(depth: float) -> SimpleNamespace:
        tried.append(depth)
        nodes = SimpleNamespace(connected=free_from is not None and depth >= free_from)
        return SimpleNamespace(roadmap=lambda goals: SimpleNamespace(nodes=nodes, depth=depth))

    monkeypatch.setattr(caution, "guarded", lambda scene, robot, start, depth: depth)
    monkeypatch.setattr(caution, "SceneRoadmaps", roadmaps)
    partly = known_where(scene, 1.7)
    levels = [CautionLevel(0.0, depth) for depth in (0.1, 0.15, 0.2, np.inf)]
    best, level = cautious_roadmap(partly, ARM, goals_in(partly), levels)
    assert (best.depth, level, tried) == (found, CautionLevel(0.0, found), searched)  # type: ignore[attr-defined]


@pytest.mark.parametrize("margin", [0.02, 0.3], ids=["there is room", "there is none"])
def test_paths_keep_a_margin_from_boxes_if_possible(scene: Scene, margin: float) -> None:
    near = Box(scene.tomatoes[TARGET].center - [0.1, 0.15, 0.0], [0.02, 0.02, 0.02], np.eye(3))
    leafy = scene.model_copy(update={"clutter": (*scene.clutter, near)})
    levels = [CautionLevel(margin, 0.1), CautionLevel(0.0, 0.1), CautionLevel(0.0, np.inf)]
    roadmap, level = cautious_roadmap(leafy, ARM, goals_in(leafy), levels)
    assert level == CautionLevel(0.02 if margin == 0.02 else 0.0, np.inf), "the scene has no occupancy"
    checker = CollisionChecker(planning_model(apply_caution(leafy, ARM, ARM.start, level), TARGET, margin=0.0))
    path = roadmap.path(ARM.start)
    assert path
    assert checker.path_is_free([ARM.start, *path], 0.005)
