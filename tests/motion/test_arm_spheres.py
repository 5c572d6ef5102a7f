"""An arm as balls covers the arm, whatever its links are made of."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from foreign_arms import write_arm

from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.robots import get_robot, load_robot
from greenhouse_gym.robots.tool import mount_tool
from greenhouse_gym.scene.mjcf import base_position, compile_scene
from greenhouse_gym.scene.obstacles import Surroundings


@pytest.mark.parametrize("kind", ["capsule", "box", "cylinder"])
def test_the_balls_cover_the_links_and_little_more(kind: str, tmp_path: Path) -> None:
    file = write_arm("ur10e", tmp_path)
    file.write_text(file.read_text().replace('type="capsule"', f'type="{kind}"'))
    robot = load_robot(mount_tool(file, tmp_path / "with-tool.xml"), start="upright")
    alone = Surroundings(name="alone")
    model = compile_scene(alone, robot).model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    balls = arm_spheres(robot)
    centers = balls.centers(data.qpos[None])[0] + base_position(alone, robot)
    links = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] > 0 and model.geom(geom).name == ""]
    random = np.random.default_rng(0)
    for geom in links:
        points = on_the_surface(kind, model.geom_size[geom], random)
        points = data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T
        gap = np.linalg.norm(points[:, None] - centers, axis=-1) - balls.radius
        assert gap.min(axis=1).max() < 1e-9
    assert balls.radius.max() < 2.0 * 0.078, "no ball around a whole link"


def on_the_surface(kind: str, size: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """(n, 3) places on a geom, its edges and corners among them."""
    if kind == "capsule":
        away = random.normal(size=(200, 3))
        ends = random.choice([-size[1], size[1]], 200)[:, None] * [0.0, 0.0, 1.0]
        return ends + size[0] * away / np.linalg.norm(away, axis=1, keepdims=True)
    if kind == "cylinder":
        turn = random.uniform(0, 2 * np.pi, 200)
        return np.stack(
            [size[0] * np.cos(turn), size[0] * np.sin(turn), random.uniform(-1, 1, 200).round(1) * size[1]], 1
        )
    places = random.uniform(-1.2, 1.2, (400, 3)).clip(-1, 1) * size
    return places[(np.abs(places) == size).any(axis=1)]


def test_points_near_the_arm_in_any_of_some_configurations() -> None:
    robot = get_robot("ur5e")
    arm, random = arm_spheres(robot), np.random.default_rng(0)
    points = random.uniform([-0.6, -1.0, -0.8], [1.0, 1.0, 0.9], (3_000, 3))
    configurations = robot.start + random.normal(0, 0.6, (5, 6))
    centers = arm.centers(configurations)
    gaps = np.linalg.norm(points[:, None, None] - centers, axis=-1) - arm.radius  # (n, m, b)
    for limit in (0.0, 0.05, -0.01):
        expected = gaps.min(axis=(1, 2)) <= limit
        assert 0 < expected.sum() < len(points)
        assert np.array_equal(arm.near(points, configurations, limit), expected)
        moving = gaps[..., arm.moving].min(axis=(1, 2)) <= limit
        assert moving.sum() <= expected.sum()
        assert np.array_equal(arm.near(points, configurations, limit, moving=True), moving)
    assert not arm.near(points, configurations[:0], 0.1).any()
    assert arm.near(points[:0], configurations, 0.1).shape == (0,)
