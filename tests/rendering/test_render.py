from __future__ import annotations

import mujoco
import numpy as np
import pytest

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.rendering.renderer import Line, Viewpoint, render_scene
from greenhouse_gym.rendering.task_pictures import picture_of_path
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Scene, compile_scene

SMALL = {"width": 96, "height": 72, "samples": 1}


@pytest.fixture(scope="module")
def ball() -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="ball" size="0.2" rgba="0.1 0.8 0.1 1"/>'
        '<geom name="glass" size="0.1" pos="-0.6 0 0" rgba="1 0 0 0"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def is_red(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 120) & (image[..., 1] < 60)


def test_things_are_where_the_camera_model_says(ball: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    camera = Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0), field_of_view=40.0)
    image = render_scene(*ball, camera, 80, 60, samples=1).astype(int)
    green = (image[..., 1] > image[..., 0] + 20) & (image[..., 1] > image[..., 2] + 20)
    rows, columns = np.nonzero(green)
    assert image.shape == (60, 80, 3)
    assert abs(rows.mean() - 29.5) < 0.6
    assert abs(columns.mean() - 39.5) < 0.6
    radius = 30 / np.tan(np.radians(20)) * np.tan(np.arcsin(0.1))
    assert green.sum() == pytest.approx(np.pi * radius**2, rel=0.1)


def test_lines_are_hidden_by_what_stands_before_them(ball: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    camera = Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    behind, before = ([[x, -0.5, 0.0], [x, 0.5, 0.0]] for x in (0.5, -0.5))
    pictures = [is_red(render_scene(*ball, camera, lines=[Line(p, (0.9, 0, 0))], **SMALL)) for p in (behind, before)]
    assert not pictures[0][30:42, 44:52].any()
    assert pictures[0].any()
    assert pictures[1][30:42, 44:52].any()


def test_lines_beside_and_behind_the_camera_do_no_harm(ball: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    camera = Viewpoint((-2.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    plain = render_scene(*ball, camera, **SMALL)
    for points in ([[-3, 0, 0], [-4, 1, 0]], [[0, 50, 0], [0, 60, 0]], [[-2, 0, 0], [-2, 0, 0]]):
        np.testing.assert_array_equal(render_scene(*ball, camera, lines=[Line(points, (1, 0, 0))], **SMALL), plain)
    crossing = render_scene(*ball, camera, lines=[Line([[-3, 0.1, 0], [-1, 0.1, 0]], (0.9, 0, 0))], **SMALL)
    assert is_red(crossing).any()


def test_the_same_picture_twice_and_smoother_with_samples(scene: Scene) -> None:
    compiled = compile_scene(scene)
    data = mujoco.MjData(compiled.model)
    mujoco.mj_resetDataKeyframe(compiled.model, data, 0)
    mujoco.mj_forward(compiled.model, data)
    first, again = (render_scene(compiled.model, data, **SMALL) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    fine = render_scene(compiled.model, data, width=96, height=72, samples=2)
    assert fine.shape == first.shape
    assert 0 < np.abs(fine.astype(int) - first).mean() < 10


def test_picture_of_path_shows_line_and_trace(scene: Scene) -> None:
    robot = get_robot("ur5e")
    path = robot.start + np.linspace(0, 1, 20)[:, None] * [0.4, 0.5, 0.8, 0, 0, 0]
    image = picture_of_path(scene, "ur5e", 4, path, width=320, height=240).astype(int)
    pink = (image[..., 0] > 190) & (image[..., 1] < 140) & (image[..., 2] > 110)
    assert image.shape == (240, 320, 3)
    assert pink.sum() > 20
    assert is_red(image).sum() > 20


@pytest.mark.parametrize("path", [np.zeros((0, 6)), np.zeros((3, 5)), np.zeros(6)])
def test_a_path_must_fit_the_arm(scene: Scene, path: np.ndarray) -> None:
    with pytest.raises(InvalidValueError, match="path"):
        picture_of_path(scene, "ur5e", 0, path)


def test_sizes_and_targets_are_checked(scene: Scene, ball: tuple[mujoco.MjModel, mujoco.MjData]) -> None:
    with pytest.raises(InvalidValueError, match="width"):
        render_scene(*ball, width=0)
    with pytest.raises(InvalidValueError, match="target"):
        picture_of_path(scene, "ur5e", 99, np.zeros((1, 6)))
