"""The benchmark of agents before held-out rows: where the arm may stand, and rates by what is possible."""

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


@pytest.fixture
def benchmark_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "benchmarks"))
    import protocol_agents

    return protocol_agents


def leaf_at_the_start(scene: Scene) -> Box:
    """A leaf that hangs in the arm's wrist where it starts."""
    arm = get_robot("ur5e")
    tip = tool_state(arm_spheres(arm).chain, arm.start[None]).point[0]
    return Box(tip + base_position(scene, arm), np.array([0.05, 0.05, 0.05]), np.eye(3))


def test_stands_where_the_scan_has_a_shape_in_the_arm_are_left_out(benchmark_module: Any, scene: Scene) -> None:
    grown = scene.model_copy(update={"clutter": (*scene.clutter, leaf_at_the_start(scene))})
    assert benchmark_module.start_is_collision_free(scene, "ur5e", "start")
    assert not benchmark_module.start_is_collision_free(grown, "ur5e", "start")


def test_a_leaf_that_only_the_truth_has_is_told_by_the_search(benchmark_module: Any, scene: Scene) -> None:
    truth = Shapes(tomatoes=scene.tomatoes, clutter=(leaf_at_the_start(scene),))
    told = scene.model_copy(update={"truth": truth})
    assert benchmark_module.path_in_truth(told, 0, seed=0, checks=100, attempts=1) == "start_in_collision"


def test_rates_are_told_by_what_the_search_found(benchmark_module: Any) -> None:
    def record(scene: str, success: bool, collision: bool) -> Any:
        return SimpleNamespace(scene=scene, success=success, collision=collision)

    ended = [
        (record("a", True, False), "solved"),
        (record("b", False, True), "solved"),
        (record("b", False, True), "start_in_collision"),
    ]
    found = benchmark_module.by_search(ended)
    assert list(found) == ["solved", "start_in_collision"]
    assert (found["solved"]["success"], found["solved"]["collision"], found["solved"]["stands"]) == (0.5, 0.5, 2)
    assert (found["start_in_collision"]["collision"], found["start_in_collision"]["stands"]) == (1.0, 1)
