"""Scenes around a known configuration of the arm, and a plain MuJoCo loop to compare with."""

from __future__ import annotations

import mujoco
import numpy as np

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.robots import get_robot
from greenhouse_gym.scene import Provenance, Scene, Target, compile_scene

REACH = np.array([0.3, -1.2, 1.6, -1.9, -0.4, 0.2])
"""A configuration with the tool in front of the arm."""


def tool_at(configuration: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tip (3,) and tool frame (3, 3) in a scene with the default stand."""
    compiled = compile_scene(scene_of([]), "ur5e")
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = configuration
    mujoco.mj_forward(compiled.model, data)
    assert data.ncon == 0
    return data.site_xpos[compiled.tip_site].copy(), data.site_xmat[compiled.tip_site].reshape(3, 3).copy()


def scene_of(tomatoes: list[Tomato], stems: list[Stem] | None = None, name: str = "placed") -> Scene:
    return Scene(
        name=name,
        tomatoes=tuple(tomatoes),
        stems=tuple(stems or ()),
        targets=tuple(Target(tomato=i, difficulty="medium") for i in range(len(tomatoes))),
        provenance=Provenance(row="placed"),
    )


def touched_in_plain_mujoco(scene: Scene, target: int, start: np.ndarray, commands: list[np.ndarray]) -> list[bool]:
    """For every action, whether plain MuJoCo (unpadded model, one state at a time) reports a contact."""
    robot = get_robot("ur5e")
    compiled = compile_scene(scene, robot)
    compiled.allow_cup_on(compiled.model, target)
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = data.ctrl[:] = start
    mujoco.mj_forward(compiled.model, data)
    last, result = start, []
    for command in commands:
        collided = False
        for k in range(5):
            data.ctrl[:] = last + (command - last) * ((k + 1) / 5)
            mujoco.mj_step(compiled.model, data)
            mujoco.mj_forward(compiled.model, data)
            collided |= data.ncon > 0
        last = command
        result.append(collided)
    return result
