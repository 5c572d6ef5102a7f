"""Warp simulates what MuJoCo simulates."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("warp")

from backends import compare

SETTINGS: list[dict[str, Any]] = [
    {"count": 48, "steps": 120},
    {"count": 24, "steps": 60, "robot": "iiwa14", "observation": "goal", "action": "joint_velocity", "seed": 1},
    {"count": 24, "steps": 60, "action": "tip_velocity", "reward": "sparse", "physics": "truth", "seed": 2},
]


@pytest.mark.parametrize("settings", SETTINGS, ids=["joint", "iiwa14-goal-velocity", "tip-truth"])
def test_episodes_end_alike(settings):
    result = compare(**settings)
    assert not result.different
    assert sum(result.outcomes.values()) >= settings["count"] // 4  # of those that ended
    assert result.deviation["joint_position"] < 1e-3
    assert result.deviation["clearance"] < 2e-4
    assert all(result.deviation.get(name, 0.0) < 1e-3 for name in ("grasp_offset", "tip_position", "turn_to_target"))
    assert result.reward < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["ur5e", "iiwa14"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_many_episodes_end_alike(robot, precision):
    result = compare(512, 200, robot=robot, precision=precision, bank="default", split="test")
    assert sum(result.outcomes.values()) - len(result.different) >= (1.0 if precision == "float64" else 0.99) * 400
    assert result.deviation["joint_position"] < 1e-3
