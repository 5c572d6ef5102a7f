"""Worlds: a scene made ready for simulation, once per process, and loaded into a private model at each reset."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np

from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, invert, pose, rotation_about, transform
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene, Scene, compile_scene
from greenhouse_gym.scene.field import FieldStore, distance_field
from greenhouse_gym.scene.mjcf import DEFAULT_CAPACITY, base_position

PHYSICS = ("reconstruction", "truth")
TRUTH_CAPACITY = 2 * DEFAULT_CAPACITY
"""Obstacles a model of a true row has room for: truth is finer than what was reconstructed of it."""

_SCENE_FIELDS = (
    # The bounding-volume tree goes with the geoms: with a stale tree MuJoCo misses contacts.
    "geom_type", "geom_contype", "geom_conaffinity", "geom_size", "geom_pos", "geom_quat", "geom_aabb", "geom_rbound",
    "geom_sameframe", "geom_rgba", "body_pos", "body_quat", "body_sameframe", "bvh_depth", "bvh_child", "bvh_nodeid",
    "bvh_aabb",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class World:
    """A scene, ready to be simulated and observed.

    Attributes:
        scene: The scene as agents know it.
        compiled: What the physics run on: the scene, or its truth.
        frame: (5,) position of the arm's base in the scene, metres, and cosine and sine of its heading.
        tomatoes: (t, 4) center in the base frame and radius of the scene's tomatoes, metres, float32.
        field: Slot of the scene's distance field in the store.
        bodies: (t,) index, for every tomato of the scene, of the tomato that stands for it in the physics.
    """

    scene: Scene
    compiled: CompiledScene
    frame: Array
    tomatoes: np.ndarray[tuple[int, int], np.dtype[np.float32]]
    field: int
    bodies: np.ndarray[tuple[int], np.dtype[np.int64]]

    def load(self, model: mujoco.MjModel, target: int) -> None:
        """Make ``model``, compiled with the same robot and capacity, this world with the cup allowed on the target."""
        source = self.compiled.model
        if (source.ngeom, source.nbvh) != (model.ngeom, model.nbvh):
            raise InvalidValueError(
                f"scene {self.scene.name!r} compiles to {source.ngeom} geoms, others to {model.ngeom}: "
                "all scenes need the same kind of stand"
            )
        for name in _SCENE_FIELDS:
            getattr(model, name)[:] = getattr(source, name)
        self.compiled.allow_cup_on(model, int(self.bodies[target]))

    def goal(self, target: int) -> tuple[Array, float]:
        """Center (3,) in the scene and radius of what has to be reached, metres."""
        tomato = self.compiled.scene.tomatoes[int(self.bodies[target])]
        return tomato.center, tomato.radius


class Worlds:
    """All worlds of one robot and kind of physics in this process: each scene is compiled at most once."""

    def __init__(self, robot: Robot, physics: str):
        self.robot = robot
        self.physics = require_choice("physics", physics, PHYSICS)
        self.fields = FieldStore()
        self._worlds: dict[int, World] = {}  # by the scene's identity; a world keeps its scene alive

    def world(self, scene: Scene) -> World:
        """The world of a scene.

        Raises:
            InvalidValueError: The scene has more obstacles than fit, or no truth where the physics are to run on it.
        """
        if id(scene) not in self._worlds:
            self._worlds[id(scene)] = self._make(scene)
        return self._worlds[id(scene)]

    def _make(self, scene: Scene) -> World:
        physical, capacity = scene, DEFAULT_CAPACITY
        bodies = np.arange(len(scene.tomatoes))
        centers = np.array([tomato.center for tomato in scene.tomatoes]).reshape(-1, 3)
        if self.physics == "truth":
            physical, capacity = _true_scene(scene), TRUTH_CAPACITY
            true = np.array([tomato.center for tomato in physical.tomatoes]).reshape(-1, 3)
            bodies = np.linalg.norm(centers[:, None] - true[None], axis=-1).argmin(axis=1)
        scene_from_base = pose(rotation_about([0, 0, 1], scene.stand.yaw), base_position(scene, self.robot))
        radii = np.array([[tomato.radius] for tomato in scene.tomatoes]).reshape(-1, 1)
        return World(
            scene=scene,
            compiled=compile_scene(physical, self.robot, capacity),
            frame=np.array([*scene_from_base[:3, 3], *scene_from_base[:2, 0]]),
            tomatoes=np.hstack([transform(invert(scene_from_base), centers), radii]).astype(np.float32),
            field=self.fields.add(distance_field([*scene.stems, *scene.clutter], scene_from_base)),
            bodies=bodies,
        )


@cache
def worlds_of(robot: Robot, physics: str) -> Worlds:
    """The process-wide worlds of a robot (robots are read once, so identity is enough) and kind of physics."""
    return Worlds(robot, physics)


def _true_scene(scene: Scene) -> Scene:
    if scene.truth is None or not scene.truth.tomatoes:
        raise InvalidValueError(f'scene {scene.name!r} carries no truth: physics="truth" needs a simulated row')
    return Scene(
        name=scene.name,
        tomatoes=scene.truth.tomatoes,
        stems=scene.truth.stems,
        clutter=scene.truth.clutter,
        stand=scene.stand,
        provenance=scene.provenance,
    )
