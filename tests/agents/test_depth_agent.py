from __future__ import annotations

import mujoco
import numpy as np
import pytest

from greenhouse_gym.agents.depth_agent import DepthAgent, Ways
from greenhouse_gym.agents.judging import FEATURES, guessed
from greenhouse_gym.agents.sight_map import FAR, SightMap
from greenhouse_gym.envs import GreenhouseEnv
from greenhouse_gym.evaluation import evaluate
from greenhouse_gym.geometry import distance_to_shapes
from greenhouse_gym.motion.approaches import approaches, glance, looks_at
from greenhouse_gym.motion.arm_spheres import ArmBalls, arm_balls
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera
from greenhouse_gym.robots import get_robot
from greenhouse_gym.robots.kinematics import tool_state
from greenhouse_gym.scene import Scene, SceneBank, compile_scene
from greenhouse_gym.scene.mjcf import base_position


@pytest.fixture(scope="module")
def arm() -> ArmBalls:
    return arm_balls(get_robot("ur5e"))


def test_the_balls_are_where_the_links_are(arm: ArmBalls, scene: Scene) -> None:
    robot = get_robot("ur5e")
    compiled = compile_scene(scene, robot)
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = np.random.default_rng(0).uniform(robot.lower, robot.upper)
    mujoco.mj_kinematics(compiled.model, data)
    centers = arm.centers(data.qpos[None])[0] + base_position(scene, robot)
    for name, radius in (("upper_arm", 0.05), ("wrist_2", 0.04), ("rod", 0.012), ("cup", 0.012)):
        geom = compiled.model.geom(name).id
        half = compiled.model.geom_size[geom, 1] * data.geom_xmat[geom].reshape(3, 3)[:, 2]
        for end in (data.geom_xpos[geom] - half, data.geom_xpos[geom] + half):
            nearest = ((centers - end) ** 2).sum(axis=1).argmin()
            np.testing.assert_allclose(centers[nearest], end, atol=1e-9, err_msg=name)
            assert arm.radius[nearest] == pytest.approx(radius)


def test_goals_reach_the_target_and_looks_point_at_it(arm: ArmBalls) -> None:
    robot, target = get_robot("ur5e"), np.array([0.5, 0.2, 0.3])
    found = approaches(arm, robot, robot.start, target, 0.03)
    assert len(found.goals) > 20
    np.testing.assert_allclose(
        tool_state(arm.chain, found.goals, 0.03).point, np.tile(target, (len(found.goals), 1)), atol=1e-3
    )
    back = tool_state(arm.chain, found.before[found.possible[:, 0], 0])
    away = np.linalg.norm(target - back.point, axis=1)
    np.testing.assert_allclose(away, 0.13, atol=5e-3)
    glancing = glance(arm, robot, robot.start, target)
    assert (glancing != robot.start).nonzero()[0].tolist() in ([3], [4], [3, 4]), "only the wrist moves"
    looks = looks_at(arm, robot, robot.start, target)
    assert len(looks) > 10
    for looking, within in ((tool_state(arm.chain, glancing[None]), 0.7), (tool_state(arm.chain, looks), 0.99)):
        towards = (target - looking.point) / np.linalg.norm(target - looking.point, axis=1)[:, None]
        assert ((looking.axis * towards).sum(axis=1) > within).all()
    again = approaches(arm, robot, robot.start, target, 0.03)
    assert all(np.array_equal(a, b) for a, b in zip(found, again, strict=True))


def test_what_is_seen_lies_on_the_surfaces_of_others(arm: ArmBalls, bank: SceneBank) -> None:
    scene, target = bank.scene("made-up-0"), 1
    tomato, robot = scene.tomatoes[target], get_robot("ur5e")
    base = base_position(scene, robot)
    center = tomato.center - base
    look = looks_at(arm, robot, robot.start, center)[0]
    env = GreenhouseEnv(bank=bank, observation="depth")
    seen, _ = env.reset(seed=0, options={"scene": scene, "target": target, "start": look})
    known = SightMap(arm, DepthCamera(), center, tomato.radius)
    nothing = known.around(look[None]).clearance
    known.add(seen["depth"][0] * MAX_RANGE, look)
    points = known.points + base
    assert len(points) > 50
    others = [shape for shape in scene.obstacles if shape is not tomato]
    assert np.abs(distance_to_shapes(points, others).min(axis=1)).max() < 1e-3
    assert (np.linalg.norm(points - tomato.center, axis=1) > tomato.radius + 0.005).all()

    neighbor = scene.tomatoes[0].center - base
    towards = approaches(arm, robot, robot.start, neighbor, scene.tomatoes[0].radius).goals
    room, dark, _ = known.around(towards)
    assert np.median(room[:, arm.part == 0].min(axis=1)) < 0.01, (
        "a cup at another tomato is mostly near to what is seen"
    )
    assert nothing[:, ~arm.cup].min() == FAR
    assert 0.0 < dark.mean() < 1.0


def test_it_reaches_tomatoes_by_what_it_sees(bank: SceneBank) -> None:
    heard: list[Ways] = []
    agent = DepthAgent(guessed, heard.append)
    result = evaluate(agent, "train", bank=bank, problems=[("made-up-0", k) for k in (1,)])
    assert result.success_rate == 1.0
    width = sum(size for _, size in FEATURES)
    assert all(ways.features.shape == (len(ways.points), width) for ways in heard)
    assert max(ways.chances.max() for ways in heard) > 0.8


def test_without_images_it_has_no_ways_that_keep_away_from_anything(bank: SceneBank) -> None:
    heard: list[Ways] = []
    agent = DepthAgent(lambda features: np.full(len(features), 0.9), heard.append, images=False)
    evaluate(agent, "train", bank=bank, problems=[("made-up-0", 1)])
    names = np.repeat([name for name, _ in FEATURES], [size for _, size in FEATURES])
    told = np.concatenate([ways.features for ways in heard])
    assert (told[:, names == "looks"] == 1).all()
    assert told[:, np.char.startswith(names, "unseen")].sum(axis=1).min() > 0.0


def test_it_says_what_is_missing(bank: SceneBank) -> None:
    agent = DepthAgent(guessed)
    env = GreenhouseEnv(bank=bank, observation="depth")
    seen, _ = env.reset(seed=0)
    with pytest.raises(RuntimeError, match="reset the agent"):
        agent.act(seen)
