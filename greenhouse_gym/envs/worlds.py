"""Caches of worlds, so that a process compiles each scene once."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache, partial

import mujoco
import numpy as np

from greenhouse_gym.crops.crop import PlantMotion
from greenhouse_gym.envs.episodes import LARGEST_WHOLE
from greenhouse_gym.envs.state import SUBSTEPS
from greenhouse_gym.envs.stepping import drive_and_record
from greenhouse_gym.envs.world import World
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.motion.collision import LEAVES
from greenhouse_gym.motion.distance_field import FieldStore
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene, Scene, Shapes, compile_scene
from greenhouse_gym.scene.mjcf import MAX_CAPACITY, arm_pose, make_yielding
from greenhouse_gym.scene.obstacles import Surroundings
from greenhouse_gym.scene.plant_motion import move_plants
from greenhouse_gym.scene.plants.layout import Layout, SlotIds
from greenhouse_gym.scene.plants.slots import empty_slots
from greenhouse_gym.scene.truth import true_scene

CACHED = LARGEST_WHOLE
"""Number of cached worlds of one kind: each takes about 1 MB with its scene, a true row up to 26 MB, and its
distance field up to 4 MB, as far as it has been looked up."""

STOP = 0.25
"""Distance between two stops of a cart around which distance fields are computed, metres."""

CACHED_KINDS = 8
"""Number of cached kinds of worlds (arm, physics, capacity, rate)."""


class Worlds:
    """Cache of the worlds of one robot and kind of physics in this process.

    The most recent worlds are kept; older ones are freed when no simulation uses them any longer.

    Args:
        robot: The arm.
        physics: "reconstruction" or "truth".
        capacity: Number of obstacle slots of the models.
        substeps: Physics steps per action; the models record the contacts of as many.
        leaves: "rigid", or "brush" for leaves that give way: they exert no force, and distances ignore them.
        layout: Layout of the slots for organs that give way and push back; None for none.
    """

    def __init__(
        self,
        robot: Robot,
        physics: str,
        capacity: int,
        substeps: int = SUBSTEPS,
        leaves: str = LEAVES[0],
        layout: Layout | None = None,
    ):
        self.robot = robot
        self.physics = physics
        self.capacity = capacity
        self.leaves = leaves
        self.layout = layout
        record = partial(drive_and_record, substeps=substeps, forces=leaves != "rigid")
        self._edit = record if layout is None else partial(_with_slots, layout=layout, record=record)
        self.fields = FieldStore()
        self._along: dict[tuple[int, int], int] = {}
        # keys are ids of scenes: scenes are immutable, and a rewritten bank is read as new scenes; a world keeps its
        # scene alive, so an id is not reused before its world is freed
        self._alive: weakref.WeakValueDictionary[int, World] = weakref.WeakValueDictionary()
        self._kept: OrderedDict[int, World] = OrderedDict()

    def world(self, scene: Scene, keep: int | None = None) -> World:
        """Return the world of a scene.

        Args:
            scene: The scene.
            keep: Number of recent worlds to keep; `CACHED` by default.

        Raises:
            InvalidValueError: The scene has more obstacles than fit, or no truth although the physics need it.
        """
        key = id(scene)
        world = self._kept.get(key) or self._alive.get(key)
        if world is None:
            world = self._alive[key] = self._make(scene)
            weakref.finalize(world, _remove_fields, self.fields, self._along, world.field)
        self._kept[key] = world
        self._kept.move_to_end(key)
        while len(self._kept) > (CACHED if keep is None else keep):
            self._kept.popitem(last=False)
        return world

    def moved(self, world: World, motion: PlantMotion, seed: int) -> World:
        """Return the world after its true plants moved; the scene that agents know stays the same."""
        true = world.compiled.scene
        plants = move_plants(true, motion, np.random.default_rng(seed))
        parts = {name: getattr(plants, name) for name in ("tomatoes", "stems", "clutter")}
        moved = true.model_copy(update=parts)
        scene_from_base = arm_pose(world.scene, self.robot)
        return replace(
            world,
            compiled=self._compile(moved),
            goals=spheres_in_base(moved, scene_from_base)[world.bodies],
            before=world,
        )

    def field(self, world: World, stop: int) -> int:
        """Return the slot of the distance field of a world around a stop of a cart, `STOP` metres apart."""
        if not stop:
            return world.field
        key = world.field, stop
        if key not in self._along:
            self._along[key] = self._add_field(world.scene, STOP * stop)
        return self._along[key]

    def _add_field(self, scene: Scene, along: float = 0.0) -> int:
        """Compute the distance field of a scene around its arm, or that many metres farther along the row."""
        solid = scene.arrays
        if self.leaves == "brush":
            solid = solid.select(np.delete(np.arange(scene.count), scene.leaves))
        return self.fields.add(
            solid, scene.counts[0], arm_pose(scene, self.robot) @ pose(translation=[0.0, along, 0.0])
        )

    def _compile(self, scene: Surroundings) -> CompiledScene:
        compiled = compile_scene(scene, self.robot, self.capacity, self._edit)
        if self.leaves == "brush":
            make_yielding(compiled.model, compiled.leaf_geoms)
        if self.layout is not None:
            empty_slots(compiled.model, SlotIds(compiled.model, self.layout))
        return compiled

    def _make(self, scene: Scene) -> World:
        physical = true_scene(scene) if self.physics == "truth" else scene
        self._check_size(physical)
        scene_from_base = arm_pose(scene, self.robot)
        tomatoes, bodies_there = (spheres_in_base(s, scene_from_base) for s in (scene, physical))
        if physical is scene:
            bodies = np.arange(len(tomatoes))
        else:
            bodies = np.linalg.norm(tomatoes[:, None, :3] - bodies_there[None, :, :3], axis=-1).argmin(axis=1)
        known: np.ndarray[tuple[int, int], np.dtype[np.float32]] = tomatoes.astype(np.float32)
        return World(
            scene=scene,
            compiled=self._compile(physical),
            frame=np.array([*scene_from_base[:3, 3], *scene_from_base[:2, 0]]),
            tomatoes=known,
            field=self._add_field(scene),
            # the same numbers as observed if the scene itself is simulated
            goals=known.astype(np.float64) if physical is scene else bodies_there[bodies],
            bodies=bodies,
            leaves=self.leaves,
            layout=self.layout,
        )

    def _check_size(self, scene: Scene) -> None:
        """Reject a scene that does not fit before any memory is allocated."""
        count = scene.count
        if count > self.capacity:
            problem = f"scene {scene.name!r} has {count} obstacles, more than the {self.capacity} allowed"
            if self.physics == "truth" and self.capacity == MAX_CAPACITY:
                problem += "; a bank built with a larger BuildSettings.leaf_tolerance has fewer boxes for its leaves"
            raise InvalidValueError(problem)


def _remove_fields(store: FieldStore, along: dict[tuple[int, int], int], field: int) -> None:
    """Release the distance fields of a world around its arm and along its rail."""
    store.remove(field)
    for key in [key for key in along if key[0] == field]:
        store.remove(along.pop(key))


def _with_slots(spec: mujoco.MjSpec, layout: Layout, record: Callable[[mujoco.MjSpec], None]) -> None:
    record(spec)
    layout.add(spec)


def spheres_in_base(scene: Shapes, scene_from_base: Array) -> Array:
    """Return the tomatoes (t, 4), their centers in the base frame and radii, metres."""
    radii = scene.columns.radii
    centers = scene.arrays.starts[: len(radii)]
    return np.hstack([transform(invert(scene_from_base), centers), radii[:, None]])


@lru_cache(maxsize=CACHED_KINDS)
def shared_worlds(
    robot: Robot,
    physics: str,
    capacity: int,
    substeps: int = SUBSTEPS,
    leaves: str = LEAVES[0],
    layout: Layout | None = None,
) -> Worlds:
    """Return the cache that all environments of one kind share in this process.

    Robots are compared by identity: `get_robot` reads a shipped arm once, whereas every `load_robot` returns a new arm
    with its own worlds. A cache beyond the last `CACHED_KINDS` lives as long as an environment uses it.
    """
    return Worlds(robot, physics, capacity, substeps, leaves, layout)
