"""World: a compiled scene that is copied into the private model of a simulation at each reset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from greenhouse_gym.envs.contacts import Groups, geom_groups
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.roadmap import SceneRoadmaps
from greenhouse_gym.scene import CompiledScene, Scene, SceneBank, compile_scene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.mjcf import DEFAULT_CAPACITY, MAX_CAPACITY
from greenhouse_gym.scene.plants.filled import FilledBodies
from greenhouse_gym.scene.plants.layout import Layout, SlotIds
from greenhouse_gym.scene.plants.topology import Topology, topology_of
from greenhouse_gym.scene.truth import known_scene, own_start
from greenhouse_gym.scene.world_tree import WorldTree, world_tree

_ROUND = 100

_GEOM_FIELDS = (
    "geom_type", "geom_contype", "geom_conaffinity", "geom_size", "geom_pos", "geom_quat", "geom_aabb", "geom_rbound",
    "geom_sameframe", "geom_rgba", "geom_margin", "geom_gap",
)  # fmt: skip
_SCENE_FIELDS = ("body_pos", "body_quat", "body_sameframe")


def capacity_of(bank: SceneBank, physics: str) -> int:
    """Return the number of obstacle slots a model must reserve so that every scene of a bank fits.

    True rows need more than reconstructed scenes. Numbers are rounded up so that banks of similar size share models. A
    bank that does not list the sizes of its scenes gets the default; loading a larger scene then raises an error.
    """
    largest = bank.largest_truth() if physics == "truth" else bank.largest_scene()
    return capacity_for(largest or 0)


def capacity_for(count: int) -> int:
    """Return the number of obstacle slots for a scene with ``count`` shapes, as in `capacity_of`.

    It never exceeds the maximum; loading a larger scene raises an error.
    """
    return min(max(DEFAULT_CAPACITY, -_ROUND * (-count // _ROUND)), MAX_CAPACITY)


@dataclass(frozen=True, eq=False)
class World:
    """Scene that is ready to be simulated and observed.

    Attributes:
        scene: The scene of the bank.
        compiled: The simulated scene: the same, or the true row behind it.
        frame: (5,) position of the arm's base in the scene, metres, and cosine and sine of its heading.
        tomatoes: (t, 4) centers in the base frame and radii of the scene's tomatoes, metres, float32.
        field: Slot of the scene's distance field in the store.
        goals: (t, 4) centers in the base frame and radii of the simulated counterparts of these tomatoes.
        bodies: (t,) indices of these counterparts in the simulated scene.
        leaves: "rigid" or "brush", see `Worlds`.
        before: World before the plants moved, which shares its distance field; None if they did not move.
        layout: Layout of the model's slots for organs that give way and push back; None if there are none.
    """

    scene: Scene
    compiled: CompiledScene
    frame: Array
    tomatoes: np.ndarray[tuple[int, int], np.dtype[np.float32]]
    field: int
    goals: Array
    bodies: np.ndarray[tuple[int], np.dtype[np.int64]]
    leaves: str = "rigid"
    before: World | None = None
    layout: Layout | None = None

    def check_fits(self, model: mujoco.MjModel) -> None:
        """Check that a model has the same layout.

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
    def known(self) -> Scene:
        """Scene as agents know it."""
        return known_scene(self.scene) if self.before is None else self.before.known

    @cached_property
    def roadmaps(self) -> SceneRoadmaps:
        """Roadmaps of the scene as agents know it; a world with moved plants shares those of the world before."""
        if self.before is not None:
            return self.before.roadmaps
        compiled = compile_scene(self.scene, self.compiled.robot, capacity_for(self.scene.count))
        return SceneRoadmaps(compiled, self.leaves)

    @cached_property
    def leaf_contacts(self) -> LeafContacts:
        """Finder of the leaves of the simulated scene that the arm touches."""
        return LeafContacts(self.compiled)

    @cached_property
    def start(self) -> Array:
        """(joints,) start of the arm if no other is asked for; not in plants of the true row that stop it."""
        simulates_scan = self.compiled.scene is self.scene
        return self.compiled.robot.start if simulates_scan or self.leaves != "rigid" else own_start(self.compiled)

    @cached_property
    def rigid(self) -> CompiledScene:
        """The simulated scene without slots, all its organs where they were at the start."""
        if self.layout is None:
            return self.compiled
        scene = self.compiled.scene
        return compile_scene(scene, self.compiled.robot, capacity_for(scene.count))

    @cached_property
    def topology(self) -> Topology:
        """Organs of the simulated scene."""
        return topology_of(self.compiled.scene, self.scene.name)

    @cached_property
    def slots(self) -> SlotIds:
        """Ids of the slots of the layout."""
        assert self.layout is not None
        return SlotIds(self.compiled.model, self.layout)

    @cached_property
    def filled(self) -> FilledBodies:
        """Bodies of the simulated scene that were filled with organs before."""
        return FilledBodies()

    @cached_property
    def used(self) -> int:
        """Number of world geoms before the parked ones, which are the same in all worlds."""
        return int(self.compiled.obstacle_geoms.start) + self.compiled.scene.count

    @cached_property
    def tree(self) -> WorldTree:
        """Tree over all geoms of the world that are not parked."""
        return world_tree(self.compiled.model, self.used)

    @cached_property
    def groups(self) -> Groups:
        """(geoms,) contact groups of the compiled geoms, see `geom_groups`."""
        return geom_groups(self.compiled, None if self.layout is None else self.slots)

    def load(self, model: mujoco.MjModel, last: World) -> None:
        """Copy this world into a model.

        Args:
            model: Compiled with the same robot and capacity; its geoms in either order (`put_arm_first`).
            last: World that the model holds; geoms that are parked in both are not copied.
        """
        source = self.compiled.model
        first, count = first_world_geom(model), max(self.used, last.used)
        for name in _GEOM_FIELDS:
            getattr(model, name)[first : first + count] = getattr(source, name)[:count]
        for name in _SCENE_FIELDS:
            getattr(model, name)[:] = getattr(source, name)
        self.tree.load(model)  # it belongs to the geoms: with a stale tree MuJoCo misses contacts

    def allow_cup_on(self, model: mujoco.MjModel, targets: Sequence[int]) -> None:
        """Let the cup touch some tomatoes of the scene in a model that holds this world."""
        for target in targets:
            self.compiled.allow_cup_on(model, int(self.bodies[target]))

    def goal(self, target: int) -> tuple[Array, float]:
        """Return the center (3,) in the base frame and the radius of the simulated target, metres."""
        return self.goals[target, :3], float(self.goals[target, 3])

    def goal_in_scene(self, target: int) -> Array:
        """Return the center (3,) of the simulated target in the scene, metres."""
        return self.compiled.scene.arrays.starts[int(self.bodies[target])]
