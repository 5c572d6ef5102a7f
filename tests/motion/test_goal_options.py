from __future__ import annotations

import mujoco
import numpy as np
import pytest

from greenhouse_gym.crops.parts import Tomato
from greenhouse_gym.geometry import Sphere
from greenhouse_gym.geometry.distances import distance_to_nearest
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.distance_field import MAX_DISTANCE
from greenhouse_gym.motion.goal_options import MAX_OPTIONS, goal_options
from greenhouse_gym.motion.inverse_kinematics import TOLERANCE
from greenhouse_gym.robots.kinematics import tool_chain, tool_state
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene


@pytest.mark.parametrize("target", [0, 4, 11])
def test_options_are_free_goals_with_the_room_around_the_arm(scene: Scene, target: int) -> None:
    compiled, tomato = compile_scene(scene), scene.tomatoes[target]
    start = compiled.robot.start
    goals, clearance = goal_options(compiled, target, start)
    assert 1 < len(goals) <= MAX_OPTIONS
    points = tool_state(tool_chain(compiled.model, compiled.tip_site), goals, tomato.radius).point
    assert np.linalg.norm(points - tomato.center, axis=-1).max() < TOLERANCE
    simulator = CollisionChecker(planning_model(compiled, target, margin=0.0))
    assert all(map(simulator.is_free, goals))
    far = np.linalg.norm(goals - start, axis=1)
    assert (np.diff(far) >= 0).all(), "those nearest to the start come first"
    fruit = [each.shape for k, each in enumerate(scene.tomatoes) if k != target]
    others = [*fruit, *scene.stems, *scene.clutter]
    data = mujoco.MjData(compiled.model)
    for goal, room in zip(goals, clearance, strict=True):
        data.qpos[:] = goal
        mujoco.mj_kinematics(compiled.model, data)
        probes = data.site_xpos[compiled.probe_sites]
        exact = np.min([distance_to_nearest(probes, [shape], np.inf) for shape in others], axis=0)
        np.testing.assert_allclose(room, np.minimum(exact, MAX_DISTANCE) - compiled.robot.probe_radii, atol=1e-6)
    again = goal_options(compiled, target, start)
    assert np.array_equal(goals, again.configurations)


def test_a_target_out_of_reach_has_no_options(scene: Scene) -> None:
    far = scene.model_copy(update={"tomatoes": (Tomato(Sphere([3.0, 0.0, 1.0], 0.03), truss=0),)})
    compiled = compile_scene(far)
    goals, clearance = goal_options(compiled, 0, compiled.robot.start)
    assert goals.shape == (0, 6)
    assert clearance.shape == (0, len(compiled.probe_sites))
