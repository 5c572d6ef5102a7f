from __future__ import annotations

import numpy as np
import pytest
from seen_helpers import seen_where, with_surface_at

from greenhouse_gym.geometry import Array, distance_to_shapes
from greenhouse_gym.planning.surfaces import shapeless, with_surfaces
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.collision import CollisionChecker, planning_model
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.seen import REACH

ARM = get_robot("ur5e")


def far_from_shapes(scene: Scene) -> Array:
    """(3,) the middle of a voxel before the arm, as far from all shapes as any between it and them."""
    space = seen_where(scene, None).seen
    assert space is not None
    centers = space.centers.reshape(-1, 3)
    shoulder = scene.stand.position + [0.0, 0.0, scene.stand.shoulder_height]
    away = np.linalg.norm(centers - shoulder, axis=1)
    centers = centers[(away > 0.7) & (away < REACH - 0.2) & (centers[:, 2] > 0.5)]
    return np.asarray(centers[distance_to_shapes(centers, scene.obstacles).min(axis=1).argmax()])


def test_a_surface_without_a_shape_becomes_clutter(scene: Scene) -> None:
    bare, tomato = far_from_shapes(scene), scene.tomatoes[0].center
    seen = with_surface_at(scene, np.array([bare, tomato]))
    assert shapeless(seen).sum() == 1
    after = with_surfaces(seen, ARM, ARM.start)
    assert len(after.clutter) == len(scene.clutter) + 1
    assert distance_to_shapes(bare[None], [after.clutter[-1]])[0, 0] < 0
    assert after.tomatoes is seen.tomatoes


@pytest.mark.parametrize("seen", [None, 0.0])
def test_where_no_surface_lacks_a_shape_the_scene_stays_as_it_is(scene: Scene, seen: float | None) -> None:
    assert with_surfaces(scene, ARM, ARM.start) is scene
    other = seen_where(scene, seen)
    assert with_surfaces(other, ARM, ARM.start) is other


def test_the_arm_may_start_beside_a_surface(scene: Scene) -> None:
    space = seen_where(scene, None).seen
    assert space is not None
    everywhere = with_surface_at(scene, space.centers.reshape(-1, 3))
    after = with_surfaces(everywhere, ARM, ARM.start)
    assert len(after.clutter) > len(scene.clutter)
    assert CollisionChecker(planning_model(compile_scene(after, ARM), 0)).is_free(ARM.start)
    shoulder = scene.stand.position + [0.0, 0.0, scene.stand.shoulder_height]
    middles = space.centers[shapeless(everywhere)]
    assert np.linalg.norm(middles - shoulder, axis=1).max() < REACH
    assert distance_to_shapes(middles, scene.obstacles).min() > 0.03
