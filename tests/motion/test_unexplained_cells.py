from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from occupancy_helpers import known_where, with_surface_at

from greenhouse_gym.agents import PlannerAgent, Problem
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, distance_to_shapes
from greenhouse_gym.motion.caution import unexplained_cells, with_unexplained_cells
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.planning import plan
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.occupancy import REACH

ARM = get_robot("ur5e")


def far_from_shapes(scene: Scene) -> Array:
    """(3,) the middle of a voxel before the arm, as far from all shapes as any between it and them."""
    space = known_where(scene, None).occupancy
    assert space is not None
    centers = space.centers.reshape(-1, 3)
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    away = np.linalg.norm(centers - shoulder, axis=1)
    centers = centers[(away > 0.7) & (away < REACH - 0.2) & (centers[:, 2] > 0.5)]
    return np.asarray(centers[distance_to_shapes(centers, scene.obstacles).min(axis=1).argmax()])


def test_a_surface_without_a_shape_becomes_clutter(scene: Scene) -> None:
    bare, tomato = far_from_shapes(scene), scene.tomatoes[0].center
    seen = with_surface_at(scene, np.array([bare, tomato]))
    assert unexplained_cells(seen).sum() == 1
    after = with_unexplained_cells(seen, ARM, ARM.start)
    assert len(after.clutter) == len(scene.clutter) + 1
    assert distance_to_shapes(bare[None], [after.clutter[-1]])[0, 0] < 0
    assert after.tomatoes is seen.tomatoes


@pytest.mark.parametrize("seen", [None, 0.0])
def test_where_no_surface_lacks_a_shape_the_scene_stays_as_it_is(scene: Scene, seen: float | None) -> None:
    assert with_unexplained_cells(scene, ARM, ARM.start) is scene
    other = known_where(scene, seen)
    assert with_unexplained_cells(other, ARM, ARM.start) is other


def test_the_arm_may_start_beside_a_surface(scene: Scene) -> None:
    space = known_where(scene, None).occupancy
    assert space is not None
    everywhere = with_surface_at(scene, space.centers.reshape(-1, 3))
    after = with_unexplained_cells(everywhere, ARM, ARM.start)
    assert len(after.clutter) > len(scene.clutter)
    assert CollisionChecker(planning_model(compile_scene(after, ARM), 0)).is_free(ARM.start)
    shoulder = scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height]
    middles = space.centers[unexplained_cells(everywhere)]
    assert np.linalg.norm(middles - shoulder, axis=1).max() < REACH
    assert distance_to_shapes(middles, scene.obstacles).min() > 0.03


def tip_places(scene: Scene, path: Array) -> Array:
    """(n, 3) where the tip is along a path, without the target's surroundings and those of the start."""
    chain = tool_chain(compile_scene(scene, ARM).model, compile_scene(scene, ARM).tip_site)
    fine = np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(path)])
    return np.asarray(tool_state(chain, fine, 0.0).point)


def test_plans_keep_out_of_surfaces_where_they_are_asked_to(scene: Scene) -> None:
    options: dict[str, Any] = {"time_limit": None, "max_checks": 30_000, "goals": 20, "seed": 1}
    free = plan(scene, 0, ARM, **options)
    assert free.path is not None
    places = tip_places(scene, free.path)
    far = np.linalg.norm(places - scene.tomatoes[0].center, axis=1) > 0.2
    far &= distance_to_shapes(places, scene.obstacles).min(axis=1) > 0.06
    far &= np.linalg.norm(places - places[0], axis=1) > 0.3
    seen = with_surface_at(scene, places[far])
    around = CollisionChecker(planning_model(compile_scene(with_unexplained_cells(seen, ARM, ARM.start), ARM), 0))
    heedless, heeding = plan(seen, 0, ARM, **options), plan(seen, 0, ARM, unexplained=True, **options)
    assert heedless.path is not None
    assert heeding.path is not None
    assert not around.path_is_free(heedless.path, 0.01)
    assert around.path_is_free(heeding.path, 0.01)
    agent = PlannerAgent(max_checks=30_000, goals=20, unknown="free", margin=0.0, unexplained=True)
    agent.reset(Problem(seen, 0, ARM, ARM.start, 1))
    assert agent.result is not None
    np.testing.assert_array_equal(agent.result.path, heeding.path)


def test_surfaces_of_a_scene_that_says_nothing_of_them_are_refused(scene: Scene) -> None:
    with pytest.raises(InvalidValueError, match="unexplained=True"):
        plan(scene, 0, ARM, unexplained=True)
