from __future__ import annotations

import time

import numpy as np
import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.motion.goals import SAMPLE_BUDGET
from greenhouse_gym.motion.inverse_kinematics import TOLERANCE
from greenhouse_gym.planning import Approach, CollisionChecker, goal_configurations, planning_model
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene


@pytest.mark.parametrize("target", [0, 4, 11])
def test_goals_put_the_grasp_point_on_the_target_and_touch_nothing(scene: Scene, target: int) -> None:
    goals = goal_configurations(scene, target)
    compiled, tomato = compile_scene(scene), scene.tomatoes[target]
    q = goals.configurations
    assert q.shape == (60, 6)
    points = tool_state(tool_chain(compiled.model, compiled.tip_site), q, tomato.radius).point
    assert np.linalg.norm(points - tomato.center, axis=-1).max() < TOLERANCE
    assert (q >= compiled.robot.lower).all()
    assert (q <= compiled.robot.upper).all()
    simulator = CollisionChecker(planning_model(compiled, target, margin=0.0))
    assert all(map(simulator.is_free, q))
    apart = np.abs(q[:, None] - q[None]).max(-1) + np.eye(len(q))
    assert apart.min() >= 0.01


def test_same_seed_same_goals(scene: Scene) -> None:
    first, again, other = (goal_configurations(scene, 3, seed=seed).configurations for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_near_duplicates_are_dropped(scene: Scene) -> None:
    goals = goal_configurations(scene, 0, count=15, min_difference=1.5)
    q = goals.configurations
    assert goals.statistics.duplicate > 0
    assert (np.abs(q[:, None] - q[None]).max(-1) + 9 * np.eye(len(q))).min() >= 1.5


def test_threshold_limits_what_is_tried(scene: Scene) -> None:
    wide, narrow = (goal_configurations(scene, 0, threshold=t).statistics for t in (0.65, 0.3))
    assert narrow.within_threshold / narrow.samples < wide.within_threshold / wide.samples


def test_a_target_out_of_reach_has_no_goals_soon(scene: Scene) -> None:
    far = scene.model_copy(update={"tomatoes": (Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=0),)})
    began = time.perf_counter()
    goals = goal_configurations(far, 0)
    assert goals.configurations.shape == (0, 6)
    assert goals.statistics.samples == SAMPLE_BUDGET
    assert goals.statistics.converged == 0
    assert time.perf_counter() - began < 5.0


def test_a_buried_target_has_only_colliding_goals(scene: Scene) -> None:
    center = scene.tomatoes[0].center

    shell = scene.model_copy(update={"tomatoes": (scene.tomatoes[0], *_shell(center))})
    goals = goal_configurations(shell, 0)
    assert len(goals.configurations) == 0
    assert goals.statistics.colliding > 0


def _shell(center: np.ndarray) -> list[Tomato]:
    directions = np.random.default_rng(0).normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return [Tomato(Sphere(center + 0.08 * d, 0.02), truss=8) for d in directions]


@pytest.mark.parametrize(
    "wrong", [{"target": 12}, {"target": -1}, {"count": 0}, {"threshold": 0.0}, {"min_difference": -0.1}]
)
def test_bad_values_are_named(scene: Scene, wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidValueError, match=str(next(iter(wrong.values())))):
        goal_configurations(scene, **{"target": 0, **wrong})  # type: ignore[arg-type]


def test_the_tool_comes_from_within_the_cone(scene: Scene) -> None:
    """All goals point into the cone, and reach the target all the same; fewer configurations do without it."""
    compiled = compile_scene(scene)
    chain, tomato = tool_chain(compiled.model, compiled.tip_site), scene.tomatoes[2]
    approach = Approach(np.array([2.0, 0.0, 0.0]), np.radians(30))
    goals = goal_configurations(scene, 2, count=20, approach=approach)
    state = tool_state(chain, goals.configurations, tomato.radius)
    assert len(goals.configurations) == 20
    assert (state.axis[:, 0] >= np.cos(np.radians(30)) - 1e-9).all()
    assert np.linalg.norm(state.point - tomato.center, axis=-1).max() < 1e-3
    free = tool_state(chain, goal_configurations(scene, 2, count=20).configurations, tomato.radius)
    assert (free.axis[:, 0] < np.cos(np.radians(30))).any()
    checker = CollisionChecker(planning_model(compiled, 2))
    assert all(map(checker.is_free, goals.configurations))


def test_a_cone_of_all_directions_changes_nothing(scene: Scene) -> None:
    anyhow = goal_configurations(scene, 2, count=5)
    everywhere = goal_configurations(scene, 2, count=5, approach=Approach(np.array([0.0, 0.0, 1.0]), np.pi))
    assert np.allclose(anyhow.configurations, everywhere.configurations)
    assert anyhow.statistics == everywhere.statistics


def test_a_cone_that_makes_no_sense_is_named() -> None:
    with pytest.raises(InvalidValueError, match="direction"):
        Approach(np.zeros(3), 0.5)
    with pytest.raises(InvalidValueError, match="half angle"):
        Approach(np.array([1.0, 0.0, 0.0]), 0.0)
