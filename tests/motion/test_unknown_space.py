from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import with_ellipsoids
from occupancy_helpers import known_where

from greenhouse_gym.errors import InvalidValueError, UnknownNameError
from greenhouse_gym.geometry import distance_to_shapes, shapes_from
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.unknown_space import DEPTHS, depths_of, guarded, unknown_boxes, unknown_length
from greenhouse_gym.planning import PlanResult, goal_configurations, plan, query
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.occupancy import REACH

ARM = get_robot("ur5e")
TARGET = 4


def test_where_all_was_seen_nothing_changes(scene: Scene) -> None:
    whole = known_where(scene, None)
    usual = plan(scene, TARGET, time_limit=30.0, max_checks=20_000)
    assert len(unknown_boxes(whole, ARM, ARM.start).kinds) == 0
    for rule in ("avoid", "forbid"):
        result = plan(whole, TARGET, time_limit=30.0, max_checks=20_000, unknown=rule)
        assert result.unknown_length == 0.0
        assert result.message == ""
        np.testing.assert_array_equal(result.path, usual.path)
        assert result.clearance == usual.clearance
    assert np.isnan(usual.unknown_length)


def test_the_arms_own_place_and_what_no_arm_reaches_do_not_count(scene: Scene) -> None:
    nothing = known_where(scene, 0.0)
    compiled = guarded(nothing, ARM, ARM.start)
    assert CollisionChecker(planning_model(compiled, TARGET)).is_free(ARM.start)
    boxes = shapes_from(unknown_boxes(nothing, ARM, ARM.start))
    shoulder = np.array([0.0, 0.0, 1.1])
    assert distance_to_shapes(shoulder[None], boxes).max() < REACH
    deep = unknown_boxes(known_where(scene, 1.2), ARM, ARM.start, depth=0.2)
    assert (deep.starts - deep.sizes)[:, 2].min() > 1.35


def test_the_inside_of_tomatoes_is_known(scene: Scene) -> None:
    for known in (scene, with_ellipsoids(scene, 1)):
        nothing = known_where(known, 0.0)
        boxes = shapes_from(unknown_boxes(nothing, ARM, ARM.start))
        cells = nothing.occupancy.centers.reshape(-1, 3)  # type: ignore[union-attr]
        inside = cells[distance_to_shapes(cells, [tomato.shape for tomato in known.tomatoes]).min(axis=1) < 0]
        assert len(inside) > 2
        assert (distance_to_shapes(inside, boxes).min(axis=1) > 0).all()


def test_forbidden_space_is_not_entered(scene: Scene) -> None:
    partly = known_where(scene, 1.7, aisle=0.3)
    result = plan(partly, TARGET, time_limit=60.0, max_checks=60_000, unknown="forbid")
    assert result.status == "solved"
    assert result.path is not None
    assert result.unknown_length == 0.0
    assert plan(partly, TARGET, goals=result.path[-1:], time_limit=30.0, max_checks=60_000).status == "solved"
    goals = goal_configurations(partly, TARGET, count=10, unknown="forbid").configurations
    checker = CollisionChecker(planning_model(guarded(partly, ARM, ARM.start), TARGET))
    assert len(goals) > 0
    assert all(checker.is_free(goal) for goal in goals)


def test_what_cannot_be_avoided_is_entered_and_said(scene: Scene) -> None:
    nothing = known_where(scene, 0.0)
    assert plan(nothing, TARGET, time_limit=5.0, unknown="forbid").status == "no_goal"
    assert len(goal_configurations(nothing, TARGET, count=3, unknown="forbid").configurations) == 0
    assert len(goal_configurations(nothing, TARGET, count=3, unknown="avoid").configurations) == 3
    result = plan(nothing, TARGET, time_limit=30.0, max_checks=8_000, goals=10, unknown="avoid")
    assert result.path is not None
    assert result.unknown_length > 0.3
    assert "through unknown space" in result.message
    assert unknown_length(nothing, ARM, result.path[:1]) == 0.0


def test_a_number_bounds_the_depth(scene: Scene) -> None:
    assert depths_of(0.12) == (0.12,)
    assert depths_of("avoid")[:2] == (0.0, 0.1)
    assert depths_of(0.0) == depths_of("forbid") == (0.0,)
    with pytest.raises(InvalidValueError, match="depth"):
        depths_of(-0.1)
    slab = known_where(scene, 1.7, aisle=0.3)
    result = plan(slab, TARGET, time_limit=60.0, max_checks=60_000, unknown=0.15)
    assert result.status == "solved"
    assert result.goals is not None


def test_a_start_may_be_named(scene: Scene) -> None:
    partly = known_where(scene, 1.7, aisle=0.3)
    named = plan(partly, TARGET, time_limit=60.0, max_checks=20_000, start="folded", unknown="avoid")
    assert named.path is not None
    np.testing.assert_array_equal(named.path[0], ARM.starts["folded"])


def test_tries_but_the_last_get_an_eighth(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []

    def fail(*arguments: Any, **named: Any) -> PlanResult:
        given.append(arguments[4:6])
        return PlanResult("no_solution", None, "RRTConnect", planning_time=arguments[4], checks=arguments[5])

    monkeypatch.setattr(query, "plan_with", fail)
    goals = [ARM.start]
    assert (
        plan(known_where(scene, 0.0), TARGET, time_limit=8.0, max_checks=800, goals=goals, unknown="avoid").path is None
    )
    assert given[:2] == [(1.0, 100), (0.875, 87)]
    assert len(given) == len(DEPTHS)
    assert given[-1] == pytest.approx((8.0 * (7 / 8) ** 4, 800 * (7 / 8) ** 4), abs=3)
    given.clear()
    plan(known_where(scene, 0.0), TARGET, time_limit=8.0, max_checks=800, goals=goals, unknown="forbid")
    assert given == [(8.0, 800)]


def test_a_scene_is_made_ready_once(scene: Scene) -> None:
    partly = known_where(scene, 1.7)
    assert guarded(partly, ARM, ARM.start, 0.1) is guarded(partly, ARM, list(ARM.start), 0.1)
    assert guarded(partly, ARM, ARM.start, 0.1) is not guarded(partly.model_copy(), ARM, ARM.start, 0.1)
    assert guarded(partly, ARM, ARM.start, 0.1) is not guarded(partly, ARM, ARM.starts["folded"], 0.1)


def test_scenes_that_do_not_know_are_refused(scene: Scene) -> None:
    for rule in ("avoid", "forbid"):
        with pytest.raises(InvalidValueError, match=rf"{scene.name}.*unknown=\"free\""):
            plan(scene, TARGET, unknown=rule)
    with pytest.raises(UnknownNameError, match=r"'shun'.*avoid"):
        plan(scene, TARGET, unknown="shun")
    with pytest.raises(UnknownNameError, match="avoid"):
        goal_configurations(scene, TARGET, unknown="shun")
