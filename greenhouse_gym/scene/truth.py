"""Scenes made of the true row, scenes without it, and starts of an arm in front of it."""

from __future__ import annotations

import mujoco

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.mjcf import CompiledScene, compile_scene
from greenhouse_gym.scene.scene import Provenance, Scene


def true_scene(scene: Scene) -> Scene:
    """Return the scene with the shapes of its truth in place of the reconstructed ones, without targets.

    Raises:
        InvalidValueError: The scene carries no truth.
    """
    if scene.truth is None or not scene.truth.counts[0]:
        raise InvalidValueError(
            f'scene {scene.name!r} carries no truth, which physics="truth" needs: scenes built from simulated '
            "recordings carry it, those of a real row cannot"
        )
    bare = scene.model_copy(update={"targets": (), "truth": None, "occupancy": None})
    return bare.with_columns(scene.truth.columns)


def known_scene(scene: Scene) -> Scene:
    """Return the scene as an agent may know it: its shapes, placement, occupancy and capture protocol.

    Truth, targets (ratings and witnesses) and everything that names the row, from which its truth could be looked up or
    grown again, are left out.
    """
    provenance = scene.provenance
    known = Provenance(row="", protocol=provenance.protocol, settings=provenance.settings)
    return scene.model_copy(update={"name": "scene", "targets": (), "truth": None, "provenance": known})


def without_plants(scene: Scene) -> Scene:
    """Return a scene without obstacles, targets and occupancy; only the arm's placement stays."""
    return scene.model_copy(update={"tomatoes": (), "stems": (), "clutter": (), "targets": (), "occupancy": None})


def start_is_collision_free(scene: Scene, robot: str | Robot) -> bool:
    """Return whether an arm touches no plant of the true row at its own start, when ready and when upright.

    People who put up an arm see the plants and do not place it inside them, whatever the scan shows.

    Args:
        scene: A scene; the result is True if it carries no truth.
        robot: The arm.
    """
    if scene.truth is None or not scene.truth.counts[0]:
        return True
    compiled = compile_scene(true_scene(scene), robot)
    arm = compiled.robot
    return not any(is_in_plants(compiled, start) for start in (arm.start, arm.rating_start, arm.upright_start))


def own_start(compiled: CompiledScene) -> Array:
    """Return the start (joints,) of an arm in a true row, radians.

    It is `Robot.upright_start` where the arm's own start would touch plants: scenes are not chosen for every arm, and
    plants move.
    """
    robot = compiled.robot
    return robot.upright_start if is_in_plants(compiled, robot.start) else robot.start


def is_in_plants(compiled: CompiledScene, configuration: Array) -> bool:
    """Return whether an arm in a configuration (joints,) touches plants.

    Contacts with the floor, the cart and the arm itself do not count.
    """
    data = mujoco.MjData(compiled.model)
    data.qpos[:] = configuration
    mujoco.mj_kinematics(compiled.model, data)
    mujoco.mj_collision(compiled.model, data)
    plants = compiled.obstacle_geoms
    return bool(((data.contact.geom >= plants.start) & (data.contact.geom < plants.stop)).any())
