"""The true row of a scene: what an arm touches in it, and whether one can be put up there at all."""

from __future__ import annotations

import mujoco

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.mjcf import compile_scene
from greenhouse_gym.scene.scene import Scene


def true_scene(scene: Scene) -> Scene:
    """The scene with the shapes of its truth in place of those of its reconstruction, without targets.

    Raises:
        InvalidValueError: The scene carries no truth.
    """
    if scene.truth is None or not scene.truth.tomatoes:
        raise InvalidValueError(
            f'scene {scene.name!r} carries no truth, which physics="truth" needs: scenes built from simulated '
            "recordings carry it, those of a real row cannot"
        )
    return Scene(
        name=scene.name,
        tomatoes=scene.truth.tomatoes,
        stems=scene.truth.stems,
        clutter=scene.truth.clutter,
        stand=scene.stand,
        provenance=scene.provenance,
    )


def stands_free(scene: Scene, robot: str | Robot) -> bool:
    """Whether an arm in its start touches nothing of the true row, whatever the scan shows of it.

    Whoever puts up an arm sees the plants, and puts it up elsewhere where it would stand in them. The floor, the cart
    and the arm itself do not count.

    Args:
        scene: A scene; True for one that carries no truth.
        robot: The arm.
    """
    if scene.truth is None or not scene.truth.tomatoes:
        return True
    compiled = compile_scene(true_scene(scene), robot)
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = compiled.robot.start
    mujoco.mj_kinematics(compiled.model, data)
    mujoco.mj_collision(compiled.model, data)
    plants = compiled.obstacle_geoms
    return not ((data.contact.geom >= plants.start) & (data.contact.geom < plants.stop)).any()
