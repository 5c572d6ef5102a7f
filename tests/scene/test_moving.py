from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, SceneBank
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.moved_obstacles import move_obstacles
from greenhouse_gym.scene.plant_motion import move_plants
from greenhouse_gym.scene.truth import true_scene

ARM = get_robot("ur5e")
FIELDS = ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_aabb", "geom_rbound", "geom_sameframe")


@pytest.fixture(scope="module")
def true() -> Scene:
    return true_scene(SceneBank.open("mini")[0])


def after(scene: Scene, motion: PlantMotion, seed: int = 5) -> Scene:
    plants = move_plants(scene, motion, np.random.default_rng(seed))
    return scene.model_copy(update={name: getattr(plants, name) for name in ("tomatoes", "stems", "clutter")})


def contacts(model: mujoco.MjModel, configurations: Any) -> list[set[tuple[int, int]]]:
    """Which geoms touch in each of configurations (k, j)."""
    data, found = mujoco.MjData(model), []
    for q in configurations:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        found.append({(min(pair), max(pair)) for pair in data.contact.geom.tolist()})
    return found


@pytest.mark.parametrize("capacity", [None, 5000])
def test_it_is_what_compiling_the_moved_scene_makes(true: Scene, capacity: int | None) -> None:
    far = PlantMotion(truss_turn=0.5, truss_swing=0.3, stem_shift=0.2, leaf_shift=0.3)
    before, scene = compile_scene(true, ARM, capacity), after(true, far)
    kept = {name: getattr(before.model, name).copy() for name in (*FIELDS, "bvh_aabb")}
    moved, expected = move_obstacles(before, scene), compile_scene(scene, ARM, capacity)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(moved.model, name), getattr(expected.model, name), atol=1e-12, err_msg=name)
    configurations = np.random.default_rng(0).uniform(ARM.lower, ARM.upper, (300, len(ARM.joints)))
    touching = contacts(moved.model, configurations)
    assert touching == contacts(expected.model, configurations)
    assert touching != contacts(before.model, configurations)
    assert moved.scene is scene
    assert moved.obstacle_geoms == expected.obstacle_geoms
    for name, value in kept.items():
        np.testing.assert_array_equal(getattr(before.model, name), value, err_msg=name)


def test_what_did_not_move_has_the_same_tree(true: Scene) -> None:
    before = compile_scene(true, ARM)
    np.testing.assert_allclose(move_obstacles(before, true).model.bvh_aabb, before.model.bvh_aabb, atol=1e-12)


def test_other_obstacles_are_refused(true: Scene) -> None:
    before = compile_scene(true, ARM)
    fewer = true.model_copy(update={"clutter": true.clutter[1:]})
    swapped = true.model_copy(update={"stems": true.stems[1:], "clutter": (true.tomatoes[0], *true.clutter)})
    for other in (fewer, swapped):
        with pytest.raises(InvalidValueError, match="other obstacles than it had before they moved"):
            move_obstacles(before, other)
