"""Worlds: a scene made ready for simulation, once per process, and loaded into a private model at each reset."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial

import mujoco
import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.reach_task import SUBSTEPS
from greenhouse_gym.envs.scene_window import LARGEST_WHOLE
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, Ellipsoid, invert, pose, rotation_about, transform
from greenhouse_gym.motion.distance_field import FieldStore, obstacle_field
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene, Scene, SceneBank, Shapes, compile_scene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.mjcf import DEFAULT_CAPACITY, MAX_CAPACITY, base_position
from greenhouse_gym.scene.moved_obstacles import move_obstacles
from greenhouse_gym.scene.plant_motion import move_plants
from greenhouse_gym.scene.truth import true_scene

_ROUND = 100

KEPT = LARGEST_WHOLE
"""How many worlds of one kind are kept ready: each takes about 4 MB with its scene, one of a truth up to 26 MB."""

KINDS_KEPT = 8
"""How many kinds of worlds (arm, physics, capacity, rate) are kept ready for the next environment."""

_GEOM_FIELDS = (
    "geom_type", "geom_contype", "geom_conaffinity", "geom_size", "geom_pos", "geom_quat", "geom_aabb", "geom_rbound",
    "geom_sameframe", "geom_rgba",
)  # fmt: skip
_SCENE_FIELDS = (
    # The bounding-volume tree goes with the geoms: with a stale tree MuJoCo misses contacts.
    "body_pos", "body_quat", "body_sameframe", "bvh_depth", "bvh_child", "bvh_aabb",
)  # fmt: skip


def room_for(bank: SceneBank, physics: str) -> int:
    """Obstacles that a model needs room for to be any scene of a bank: truth is finer than what was made of it.

    Banks whose scenes are about as large get the same number, and so share their models. A bank that does not say how
    large they are gets the usual number, as one without truth does; its scenes say what they lack when they are loaded.
    """
    largest = bank.largest_truth() if physics == "truth" else bank.largest_scene()
    return room_for_shapes(largest or 0)


def room_for_shapes(count: int) -> int:
    """Obstacles that a model needs room for to be a scene with so many shapes, as `room_for` has it for a bank.

    No more than are allowed: scenes with more of them say so when they are loaded.
    """
    return min(max(DEFAULT_CAPACITY, -_ROUND * (-count // _ROUND)), MAX_CAPACITY)


@dataclass(frozen=True, eq=False)
class World:
    """A scene, ready to be simulated and observed.

    Attributes:
        scene: The scene as agents know it.
        compiled: What the physics run on: the scene, or its truth.
        frame: (5,) position of the arm's base in the scene, metres, and cosine and sine of its heading.
        tomatoes: (t, 4) center in the base frame and radius of the scene's tomatoes, metres, float32.
        field: Slot of the scene's distance field in the store.
        goals: (t, 4) center in the base frame and radius of what stands for each of them in the physics.
        bodies: (t,) index, for every tomato of the scene, of the tomato that stands for it in the physics.
        before: The world before its plants moved, whose field it shares; None for one that did not.
    """

    scene: Scene
    compiled: CompiledScene
    frame: Array
    tomatoes: np.ndarray[tuple[int, int], np.dtype[np.float32]]
    field: int
    goals: Array
    bodies: np.ndarray[tuple[int], np.dtype[np.int64]]
    before: World | None = None

    def check_fits(self, model: mujoco.MjModel) -> None:
        """Raise an error unless ``model`` has room for this world's geoms.

        Raises:
            InvalidValueError: It was compiled with another kind of stand.
        """
        source = self.compiled.model
        if (source.ngeom, source.nbvh) != (model.ngeom, model.nbvh):
            raise InvalidValueError(
                f"scene {self.scene.name!r} compiles to {source.ngeom} geoms, others to {model.ngeom}: "
                "all scenes need the same kind of stand"
            )

    @cached_property
    def used(self) -> int:
        """How many geoms of the world come before those that are parked, which are alike in all worlds."""
        return int(self.compiled.obstacle_geoms.start) + len(self.compiled.scene.obstacles)

    def load(self, model: mujoco.MjModel, target: int, last: World | None = None) -> None:
        """Make ``model`` this world with the cup allowed on the target.

        Args:
            model: Compiled with the same robot and capacity; its geoms in either order (`put_arm_first`).
            target: Index of the tomato.
            last: The world that the model is, where that is known: what is parked in both is not copied.
        """
        source = self.compiled.model
        first, count = first_world_geom(model), int(source.body_geomnum[0])
        if last is not None:
            count = max(self.used, last.used)
        for name in _GEOM_FIELDS:
            getattr(model, name)[first : first + count] = getattr(source, name)[:count]
        for name in _SCENE_FIELDS:
            getattr(model, name)[:] = getattr(source, name)
        nodes = slice(source.body_bvhadr[0], source.body_bvhadr[0] + source.body_bvhnum[0])
        ids = source.bvh_nodeid[nodes]
        model.bvh_nodeid[nodes] = np.where(ids >= 0, ids + first, ids)
        self.compiled.allow_cup_on(model, int(self.bodies[target]))

    def goal(self, target: int) -> tuple[Array, float]:
        """Center (3,) in the base frame and radius of what has to be reached, metres."""
        return self.goals[target, :3], float(self.goals[target, 3])

    def goal_in_scene(self, target: int) -> Array:
        """Center (3,) in the scene of what has to be reached, metres."""
        return self.compiled.scene.tomatoes[int(self.bodies[target])].center


class Worlds:
    """The worlds of one robot and kind of physics in this process, each scene compiled once while it is in use.

    The last `KEPT` worlds are kept, or as many as are asked for; older ones live on only as long as a simulation runs
    in them.

    Args:
        robot: The arm.
        physics: "reconstruction" or "truth".
        capacity: Obstacles a model has room for.
        substeps: Physics steps per action, whose contacts the models keep.
    """

    def __init__(self, robot: Robot, physics: str, capacity: int, substeps: int = SUBSTEPS):
        self.robot = robot
        self.physics = physics
        self.capacity = capacity
        self._record = partial(drive_and_record, substeps=substeps)
        self.fields = FieldStore()
        # By the scene's identity: scenes are never changed, and a bank that is written anew is read as other scenes. A
        # world keeps its scene alive, so an identity is not used again before its world is gone.
        self._alive: weakref.WeakValueDictionary[int, World] = weakref.WeakValueDictionary()
        self._kept: OrderedDict[int, World] = OrderedDict()

    def world(self, scene: Scene, keep: int | None = None) -> World:
        """The world of a scene.

        Args:
            scene: The scene.
            keep: How many worlds are to be kept, those asked for last; `KEPT` by default.

        Raises:
            InvalidValueError: The scene has more obstacles than fit, or no truth where the physics are to run on it.
        """
        key = id(scene)
        world = self._kept.get(key) or self._alive.get(key)
        if world is None:
            world = self._alive[key] = self._make(scene)
            weakref.finalize(world, self.fields.remove, world.field)
        self._kept[key] = world
        self._kept.move_to_end(key)
        while len(self._kept) > (KEPT if keep is None else keep):
            self._kept.popitem(last=False)
        return world

    def moved(self, world: World, motion: PlantMotion, seed: int) -> World:
        """The world after its true plants moved: what is told stays, what is touched and reached is elsewhere."""
        true = world.compiled.scene
        plants = move_plants(true, motion, np.random.default_rng(seed))
        parts = {name: getattr(plants, name) for name in ("tomatoes", "stems", "clutter")}
        moved = true.model_copy(update=parts)
        scene = world.scene
        scene_from_base = pose(rotation_about([0, 0, 1], scene.placement.yaw), base_position(scene, self.robot))
        return replace(
            world,
            compiled=move_obstacles(world.compiled, moved),
            goals=_spheres(moved, scene_from_base)[world.bodies],
            before=world,
        )

    def _make(self, scene: Scene) -> World:
        physical = true_scene(scene) if self.physics == "truth" else scene
        self._check_size(physical)
        scene_from_base = pose(rotation_about([0, 0, 1], scene.placement.yaw), base_position(scene, self.robot))
        tomatoes, bodies_there = (_spheres(s, scene_from_base) for s in (scene, physical))
        if physical is scene:
            bodies = np.arange(len(tomatoes))
        else:
            bodies = np.linalg.norm(tomatoes[:, None, :3] - bodies_there[None, :, :3], axis=-1).argmin(axis=1)
        ellipsoids = {k: t.shape for k, t in enumerate(scene.tomatoes) if isinstance(t.shape, Ellipsoid)}
        others = [*scene.stems, *scene.clutter]
        told: np.ndarray[tuple[int, int], np.dtype[np.float32]] = tomatoes.astype(np.float32)
        return World(
            scene=scene,
            compiled=compile_scene(physical, self.robot, self.capacity, self._record),
            frame=np.array([*scene_from_base[:3, 3], *scene_from_base[:2, 0]]),
            tomatoes=told,
            field=self.fields.add(obstacle_field(tomatoes, others, scene_from_base, ellipsoids)),
            # what is told and what counts are one and the same number where the physics are those of the scene
            goals=told.astype(np.float64) if physical is scene else bodies_there[bodies],
            bodies=bodies,
        )

    def _check_size(self, scene: Scene) -> None:
        """Refuse what would take more room than there is before any of it is taken."""
        count = len(scene.obstacles)
        if count > self.capacity:
            problem = f"scene {scene.name!r} has {count} obstacles, more than the {self.capacity} allowed"
            if self.physics == "truth" and self.capacity == MAX_CAPACITY:
                problem += "; a bank built with a larger BuildSettings.leaf_tolerance has fewer boxes for its leaves"
            raise InvalidValueError(problem)


def _spheres(scene: Shapes, scene_from_base: Array) -> Array:
    """(t, 4) centers in the base frame and radii of the tomatoes, metres."""
    centers = np.array([tomato.center for tomato in scene.tomatoes]).reshape(-1, 3)
    radii = np.array([[tomato.radius] for tomato in scene.tomatoes]).reshape(-1, 1)
    return np.hstack([transform(invert(scene_from_base), centers), radii])


@lru_cache(maxsize=KINDS_KEPT)
def worlds_of(robot: Robot, physics: str, capacity: int, substeps: int = SUBSTEPS) -> Worlds:
    """The worlds that the environments of a kind share in this process.

    By the robot's identity: arms that `get_robot` finds are read once, while every `load_robot` gives another arm with
    worlds of its own. Kinds beyond the last `KINDS_KEPT` live on as long as an environment uses them.
    """
    return Worlds(robot, physics, capacity, substeps)
