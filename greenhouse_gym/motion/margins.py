"""Leaves reach farther than a scan shows: boxes of clutter with a margin, as obstacles for planning."""

from __future__ import annotations

import math
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Box
from greenhouse_gym.motion.collision import planning_model
from greenhouse_gym.motion.unknown_space import ByIdentity
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import compile_scene


def with_margin(scene: Scene, robot: Robot, start: npt.ArrayLike, margin: float) -> Scene:
    """A scene whose boxes are larger to every side, but for those that the arm would touch then where it starts.

    The rims of leaves are what a stereo camera measures least: in rows of organ meshes most leaves that planned paths
    hit at places that had been seen reach 1 to 2.5 cm beyond the boxes of the scan.

    Args:
        scene: The scene.
        robot: The arm.
        start: (joints,) where it stands, radians.
        margin: Metres; with 0 the scene is returned as it is.

    Raises:
        InvalidValueError: The margin is negative or not finite.
    """
    if not check_margin(margin):
        return scene
    return _with_margin(ByIdentity(scene), robot, tuple(np.asarray(start, dtype=np.float64).tolist()), float(margin))


def check_margin(margin: float) -> float:
    """A margin, metres.

    Raises:
        InvalidValueError: It is negative or not finite.
    """
    if not (margin >= 0 and math.isfinite(margin)):
        raise InvalidValueError(f"margin must be a finite number of metres from 0 on, got {margin!r}")
    return margin


@lru_cache(maxsize=4)
def _with_margin(kept: ByIdentity, robot: Robot, start: tuple[float, ...], margin: float) -> Scene:
    scene = kept.scene
    grown = [
        Box(shape.center, shape.half_extents + margin, shape.rotation) if isinstance(shape, Box) else shape
        for shape in scene.clutter
    ]
    compiled = compile_scene(scene.model_copy(update={"clutter": tuple(grown)}), robot)
    model = planning_model(compiled, 0)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    first = compiled.obstacle_geoms.start + len(scene.tomatoes) + len(scene.stems)
    for touched in {int(geom) - first for geom in data.contact.geom.flat}:
        if 0 <= touched < len(grown):
            grown[touched] = scene.clutter[touched]
    return scene.model_copy(update={"clutter": tuple(grown)})
