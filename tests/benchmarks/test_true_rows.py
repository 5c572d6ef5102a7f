"""The benchmark of agents in true rows: start, rates by what is possible, and what the scan knew of contact points."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_state
from greenhouse_gym.scene import Scene, Shapes
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

ARM = get_robot("ur5e")


@pytest.fixture(autouse=True)
def repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2]))


@pytest.fixture
def rows() -> Any:
    from benchmarks.agents import true_rows

    return true_rows


@pytest.fixture
def figures() -> Any:
    from benchmarks.agents import true_row_figures

    return true_row_figures


def leaf_at_the_start(scene: Scene) -> Box:
    """A leaf inside the arm's wrist at its start."""
    tip = tool_state(arm_spheres(ARM).chain, ARM.starts["upright"][None]).point[0]
    return Box(tip + base_position(scene, ARM), np.array([0.05, 0.05, 0.05]), np.eye(3))


def bare(scene: Scene, clutter: tuple[Box, ...], states: int = FREE) -> Scene:
    """A scene of boxes alone in space with one state."""
    space = OccupancyGrid.from_states(np.full((60, 60, 60), states, dtype=np.uint8), [-1.5, -1.5, 0.0], 0.05)
    return scene.model_copy(update={"tomatoes": (), "stems": (), "targets": (), "clutter": clutter, "occupancy": space})


def record(scene: str, success: bool, collision: bool, status: str = "", contact: tuple[str, ...] = ()) -> Any:
    return SimpleNamespace(scene=scene, success=success, collision=collision, status=status, contact=contact)


def test_a_scene_counts_only_if_the_scan_leaves_the_start_free(rows: Any, scene: Scene) -> None:
    grown = scene.model_copy(update={"clutter": (*scene.clutter, leaf_at_the_start(scene))})
    assert rows.start_is_free(scene, None)
    assert rows.start_is_free(scene, "ready")
    assert not rows.start_is_free(grown, None)


def test_some_of_the_tomatoes_within_reach_are_drawn(rows: Any, scene: Scene) -> None:
    drawn = rows.within_reach(scene, 2, 0)
    assert len(set(drawn)) == 2
    assert set(drawn) < set(rows.within_reach(scene, 100, 1))


def test_options_make_planners_and_watchful_agents(rows: Any) -> None:
    options = rows.options_from(["margin=0.02", "image=[64, 48]", "unknown=avoid", "surfaces=true"])
    assert options == {"margin": 0.02, "image": [64, 48], "unknown": "avoid", "surfaces": True}
    assert rows.agent_from("watchful", {"margin": 0.02})._levels[0].margin == 0.02
    planner = rows.agent_from("RRTConnect", {"margin": 0.01, "unknown": 0.1})
    assert (planner.margin, planner.unknown) == (0.01, 0.1)
    assert rows.agent_from("straight-line", {}).name == "straight-line"


def test_rates_of_planners_are_also_over_the_episodes_with_a_plan(figures: Any) -> None:
    records = [
        record("a", True, False, "solved"),
        record("b", False, True, "solved", ("forearm", "clutter_3")),
        record("b", False, False, "no_goal"),
    ]
    found = figures.summary(records, {"a": "own, paper", "b": "helios, paper"})
    assert (found["episodes"], found["planned"]["count"], found["of_planned"]["success"]) == (3, 2, 0.5)
    assert found["by_rows"]["helios, paper"]["statuses"] == {"solved": 1, "no_goal": 1}
    assert (found["touched"], found["touched_by"]) == ({"leaf": 1}, {"forearm": 1})


def test_the_search_reports_a_leaf_that_only_the_truth_has(figures: Any, scene: Scene) -> None:
    truth = Shapes(tomatoes=scene.tomatoes, clutter=(leaf_at_the_start(scene),))
    true = scene.model_copy(update={"truth": truth})
    assert figures.path_in_truth(true, 0, seed=0, checks=100, attempts=1, start="upright") == "start_in_collision"


def test_rates_are_grouped_by_what_the_search_found(figures: Any) -> None:
    records = [record("a", True, False), record("b", False, True), record("b", False, True)]
    found = figures.by_search(records, ["solved", "solved", "start_in_collision"])
    assert list(found) == ["solved", "start_in_collision"]
    assert (found["solved"]["success"], found["solved"]["collision"], found["solved"]["scenes"]) == (0.5, 0.5, 2)
    assert (found["start_in_collision"]["collision"], found["start_in_collision"]["scenes"]) == (1.0, 1)


@pytest.mark.parametrize(("states", "name"), [(UNKNOWN, "unknown"), (FREE, "free"), (OCCUPIED, "occupied")])
def test_a_contact_point_is_named_by_the_grid_and_the_nearest_shape(
    figures: Any, scene: Scene, states: int, name: str
) -> None:
    known = bare(scene, (Box([0.5, 0.0, 1.0], [0.1, 0.1, 0.1], np.eye(3)),), states)
    assert figures.state_at(known, np.array([0.5, 0.0, 1.115])) == f"{name}, shape within 2 cm"
    assert figures.state_at(known, np.array([0.5, 0.0, 1.16])) == f"{name}, no shape within 5 cm"
    assert figures.state_at(bare(scene, (), states), np.zeros(3)).endswith("no shape within 5 cm")
    without = known.model_copy(update={"occupancy": None})
    assert figures.state_at(without, np.array([0.5, 0.0, 1.105])).startswith("no occupancy grid")


def test_a_contact_point_lies_between_the_parts_that_touched(figures: Any, scene: Scene) -> None:
    """A leaf of the true row lies on top of the shoulder, which the scan does not show."""
    shoulder = base_position(scene, ARM) + [0.0, 0.0, 0.3]
    truth = Shapes(tomatoes=scene.tomatoes[:1], clutter=(Box(shoulder, [0.3, 0.3, 0.005], np.eye(3)),))
    true = scene.model_copy(update={"truth": truth})
    trace = SimpleNamespace(
        robot=ARM, joints=ARM.starts["upright"][None], record=SimpleNamespace(contact=("upper_arm", "clutter_0"))
    )
    point = figures.contact_point(true, trace)
    assert abs(point[2] - shoulder[2]) < 0.1
    assert np.abs(point[:2] - shoulder[:2]).max() < 0.3
    trace.record.contact = ("upper_arm", "wrist_1")
    assert figures.contact_point(true, trace) is None, "the arm touched itself"
    assert figures.scan_state(true, trace) == "no plant"
