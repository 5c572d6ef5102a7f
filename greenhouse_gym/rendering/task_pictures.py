"""Images of a task: the arm, the straight line to its target, and the path of the tip."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.rendering.renderer import Image, Line, Viewpoint, default_camera, render_scene
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.scene import Scene

RED, PINK = (0.9, 0.05, 0.05), (1.0, 0.3, 0.65)

_SAMPLES = 2  # rays per pixel in each direction


def task_lines(tip: npt.ArrayLike, target: npt.ArrayLike, trace: npt.ArrayLike = ()) -> list[Line]:
    """Return the straight line from ``tip`` to ``target`` (3,) in red and the ``trace`` (m, 3) in pink, metres."""
    lines = [Line(np.array([tip, target], dtype=np.float64), RED, 0.003)]
    path = np.asarray(trace, dtype=np.float64).reshape(-1, 3)
    if len(path) > 1:
        lines.append(Line(path, PINK, 0.006))
    return lines


def picture_of_path(
    scene: Scene,
    robot: str | Robot,
    target: int,
    joint_path: npt.ArrayLike,
    camera: Viewpoint | None = None,
    width: int = 640,
    height: int = 480,
) -> Image:
    """Render the arm at the end of a joint path, with the tip's path in pink and the line to the target in red.

    Args:
        scene: The scene.
        robot: The arm.
        target: Index of the tomato.
        joint_path: (k, joints) radians.
        camera: Viewpoint, as in `render_scene`.
        width: Pixels.
        height: Pixels.

    Raises:
        InvalidValueError: The path is empty or does not fit the arm, or the tomato does not exist.
    """
    arm = get_robot(robot)
    path = np.asarray(joint_path, dtype=np.float64)
    if path.ndim != 2 or path.shape[1] != len(arm.joints) or len(path) == 0:
        raise InvalidValueError(f"expected a path (k, {len(arm.joints)}) of {arm.name}, got shape {path.shape}")
    if not 0 <= target < len(scene.tomatoes):
        raise InvalidValueError(f"target must be 0 to {len(scene.tomatoes) - 1}, got {target}")
    compiled = compile_scene(scene, arm)
    data = mujoco.MjData(compiled.model)
    trace = np.empty((len(path), 3))
    for tip, configuration in zip(trace, path, strict=True):
        data.qpos[:] = configuration
        mujoco.mj_kinematics(compiled.model, data)
        tip[:] = data.site_xpos[compiled.tip_site]
    center = scene.tomatoes[target].center
    camera = camera or default_camera(scene.placement)
    lines = task_lines(trace[0], center, trace)
    return render_scene(compiled.model, data, camera, width, height, lines, _SAMPLES)
