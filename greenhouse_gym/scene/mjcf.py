"""Compile a scene and a robot to the MuJoCo model that both the simulator and the planners check collisions with.

Obstacles are geoms of the world body (separate static bodies cost about twelve times the collision time). Collision
masks: bit 1 is the arm, bit 2 is the cup. Obstacles carry both bits; clearing bit 2 of the target lets the cup, and
no other part of the arm, touch it.
"""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import mujoco
import numpy as np

from greenhouse_gym.crops.parts import STEM_KINDS
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, pose, rotation_about
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.robots.robot import CUP_GEOM, TIP_SITE, slides
from greenhouse_gym.robots.start import CART_HALF_WIDTH, cart_drop
from greenhouse_gym.scene.obstacle_slots import TYPES, fill_slots, geoms_of
from greenhouse_gym.scene.obstacles import ArmPlacement, Shapes, Surroundings

DEFAULT_CAPACITY = 600
"""Number of obstacle slots of a padded model."""

MAX_CAPACITY = 30_000
"""Maximum number of obstacle slots; every padded geom costs memory and time in every simulation."""

ARM_AND_CUP, ARM_ONLY = 3, 1
"""Collision masks of an obstacle, and of the target (which the cup may touch)."""

YIELDING = 1.0
"""Depth up to which a geom that gives way exerts no force, metres: more than an arm can enter a leaf."""

TIMESTEP = 0.01
_PARKED = (0.0, 0.0, -50.0)
_CHUNK = 200  # slots added at a time
_STEM_COLORS = {
    "main": (0.33, 0.48, 0.2, 1.0),
    "peduncle": (0.4, 0.6, 0.25, 1.0),
    "pedicel": (0.45, 0.65, 0.3, 1.0),
    "string": (0.85, 0.85, 0.8, 1.0),
    "pipe": (0.8, 0.8, 0.82, 1.0),
}
_CLUTTER_COLOR = (0.25, 0.5, 0.22, 1.0)


@dataclass(frozen=True, eq=False)
class CompiledScene:
    """A scene with an arm as a MuJoCo model, and the ids of its parts.

    Attributes:
        scene: The scene.
        robot: The arm.
        model: The compiled model; shared, so treat it as read-only.
        tip_site: Id of the site ``tip``.
        probe_sites: (k,) ids of the sites at which clearance is observed.
        obstacle_geoms: Slice of the geom ids of all obstacle slots: tomatoes, stems, clutter, then parked ones.
        cup_geom: Id of the geom that may touch the target, or -1 without one.
    """

    scene: Surroundings
    robot: Robot
    model: mujoco.MjModel
    tip_site: int
    probe_sites: np.ndarray[tuple[int], np.dtype[np.int64]]
    obstacle_geoms: slice
    cup_geom: int

    @property
    def leaf_geoms(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """(k,) ids of the geoms of leaves."""
        return np.asarray(self.obstacle_geoms.start + self.scene.leaves)

    def tomato_geom(self, tomato: int) -> int:
        """Return the geom id of a tomato, by its index in the scene."""
        return int(self.obstacle_geoms.start) + tomato

    def geom_name(self, geom: int) -> str:
        """Return the name of a geom; slots of obstacles have the names of the obstacles in them."""
        slot = geom - self.obstacle_geoms.start
        if not 0 <= slot < self.scene.count:
            return name_of(self.model, geom)
        columns = self.scene.columns
        tomatoes, stems, _ = columns.counts
        if slot < tomatoes:
            return f"tomato_{slot}"
        slot -= tomatoes
        return f"stem_{slot}_{columns.stem_kinds[slot]}" if slot < stems else f"clutter_{slot - stems}"

    def allow_cup_on(self, model: mujoco.MjModel, tomato: int, allowed: bool = True) -> None:
        """Let the cup touch a tomato in ``model``, a copy of this one with its geoms in either order, or forbid it."""
        mask = ARM_ONLY if allowed else ARM_AND_CUP
        geom = int(model.body_geomadr[0]) + self.tomato_geom(tomato)
        model.geom_contype[geom] = mask
        model.geom_conaffinity[geom] = mask


def make_yielding(model: mujoco.MjModel, geoms: np.ndarray[tuple[int], np.dtype[np.int64]]) -> None:
    """Let geoms of the world body give way: MuJoCo finds contacts with them, which exert no force.

    MuJoCo finds the contacts of two geoms that are nearer than the sums of their margins and gaps, and lets those
    push that are nearer than the sum of their margins.
    """
    model.geom_margin[geoms], model.geom_gap[geoms] = -YIELDING, YIELDING


def scene_spec(
    scene: Surroundings, robot: str | Robot | None = None, capacity: int | None = None, target: int | None = None
) -> mujoco.MjSpec:
    """Return the scene, with an arm if one is named, as an editable MuJoCo specification.

    Args:
        scene: The scene.
        robot: Name, file or `Robot`; None leaves the arm out.
        capacity: Number of obstacle slots; unused ones are parked geoms, so models of several scenes have equal sizes.
        target: Index of the tomato that the cup may touch.

    Raises:
        InvalidValueError: ``capacity`` is out of range or too small for the scene, or there is no tomato ``target``.
    """
    columns = scene.columns
    tomatoes, _, clutter = columns.counts
    if target is not None and not 0 <= target < tomatoes:
        raise InvalidValueError(f"scene {scene.name!r} has tomatoes 0 to {tomatoes - 1}, there is no {target}")
    if capacity is not None and not (isinstance(capacity, int | np.integer) and 1 <= capacity <= MAX_CAPACITY):
        raise InvalidValueError(f"capacity must be a whole number from 1 to {MAX_CAPACITY}, got {capacity!r}")
    arm = None if robot is None else get_robot(robot)
    spec = mujoco.MjSpec() if arm is None else arm.spec()
    spec.modelname = scene.name
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    world = spec.worldbody
    world.add_light(pos=[-1.0, 0.0, 3.0], dir=[0.5, 0.0, -1.0], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    world.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], rgba=[0.72, 0.71, 0.68, 1],
        contype=ARM_AND_CUP, conaffinity=ARM_AND_CUP,
    )  # fmt: skip
    if arm is not None:
        _place_arm(spec, scene, arm)
    names = [f"tomato_{i}" for i in range(tomatoes)]
    names += [f"stem_{i}_{kind}" for i, kind in enumerate(columns.stem_kinds)]
    names += [f"clutter_{i}" for i in range(clutter)]
    for name, kind, pos, size, quat, color in zip(names, *geoms_of(scene.arrays), colors_of(scene), strict=True):
        world.add_geom(
            name=name, type=TYPES[kind], pos=pos, size=size, quat=quat, rgba=color,
            contype=ARM_AND_CUP, conaffinity=ARM_AND_CUP,
        )  # fmt: skip
    if target is not None:
        reached = spec.geom(names[target])
        reached.contype = reached.conaffinity = ARM_ONLY
    if capacity is not None:
        _add_slots(spec, capacity - len(names))
    return spec


def _add_slots(spec: mujoco.MjSpec, count: int) -> None:
    """Add parked geoms to the world; one by one, each would take MuJoCo longer than the one before."""
    spec.copy_during_attach = True
    for size, copies in ((_CHUNK, count // _CHUNK), (count % _CHUNK, 1)):
        chunk = mujoco.MjSpec().worldbody
        frame = chunk.add_frame()
        for _ in range(size):
            chunk.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.001, 0, 0], pos=_PARKED, rgba=[0, 0, 0, 0],
                contype=ARM_AND_CUP, conaffinity=ARM_AND_CUP,
            ).set_frame(frame)  # fmt: skip
        for copied in range(copies if size else 0):
            spec.worldbody.attach_frame(frame, f"slots_{size}_{copied}_", "")


def compile_scene(
    scene: Surroundings,
    robot: str | Robot = "ur5e",
    capacity: int | None = None,
    edit: Callable[[mujoco.MjSpec], None] | None = None,
) -> CompiledScene:
    """Compile a scene with an arm (about 5 ms; 2 ms with a capacity, after the first of its kind).

    Args:
        scene: The scene.
        robot: As `scene_spec`.
        capacity: Number of obstacle slots; unused ones are parked geoms, so models of several scenes have equal sizes.
            The geoms of slots have no names; see `CompiledScene.geom_name`.
        edit: Callback that changes the specification before it is compiled.

    Raises:
        InvalidValueError: ``capacity`` is out of range or too small for the scene.
    """
    arm = get_robot(robot)
    if capacity is None:
        spec = scene_spec(scene, arm)
        if edit is not None:
            edit(spec)
        return _compiled(spec, scene, arm, scene.count)
    placement = scene.placement
    place = (*placement.position.tolist(), placement.yaw, placement.shoulder_height)
    empty = _without_obstacles(arm, capacity, edit, place)
    if scene.count > capacity:
        raise InvalidValueError(f"scene {scene.name!r} has {scene.count} obstacles, more than the {capacity} allowed")
    model = copy.copy(empty.model)
    fill_slots(model, empty.obstacle_geoms.start, scene.arrays, colors_of(scene))
    return replace(empty, scene=scene, model=model)


@lru_cache(maxsize=16)
def _without_obstacles(
    robot: Robot,
    capacity: int,
    edit: Callable[[mujoco.MjSpec], None] | None,
    place: tuple[float, float, float, float, float],
) -> CompiledScene:
    """Compile an arm at a position (x, y, z, yaw, shoulder height) with empty obstacle slots."""
    *position, yaw, height = place
    placement = ArmPlacement(position=np.array(position), yaw=yaw, shoulder_height=height)
    scene = Surroundings(name="empty", placement=placement)
    with _editing:
        spec = _spec_with_slots(robot, capacity, edit, _has_column(scene, robot))
        _place_arm(spec, scene, robot)
        return _compiled(spec, scene, robot, capacity)


_RAIL, _OVER_RAIL = 0.004, 0.02  # metres: height of the rail that a cart slides on, and gap that no plan's margin fills
_editing = threading.Lock()  # of the shared specifications


@lru_cache(maxsize=8)
def _spec_with_slots(
    robot: Robot, capacity: int, edit: Callable[[mujoco.MjSpec], None] | None, column: bool
) -> mujoco.MjSpec:
    """Return an arm with empty slots and, perhaps, a column; MuJoCo takes seconds to add 20,000 geoms to it."""
    height = robot.shoulder_height + column
    empty = Surroundings(name="empty", placement=ArmPlacement(shoulder_height=height))
    spec = scene_spec(empty, robot, capacity)
    if edit is not None:
        edit(spec)
    return spec


def _compiled(spec: mujoco.MjSpec, scene: Surroundings, arm: Robot, count: int) -> CompiledScene:
    model = spec.compile()
    first = model.geom("floor").id + (2 if _has_column(scene, arm) else 1)
    return CompiledScene(
        scene=scene,
        robot=arm,
        model=model,
        tip_site=model.site(TIP_SITE).id,
        probe_sites=np.array([model.site(name).id for name in arm.probes], dtype=np.int64),
        obstacle_geoms=slice(first, first + count),
        cup_geom=int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, CUP_GEOM)),
    )


def base_position(scene: Surroundings, robot: Robot) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the position (3,) of the arm's base in the scene, metres: below the shoulder of its placement."""
    return np.asarray(scene.placement.position + [0.0, 0.0, scene.placement.shoulder_height - robot.shoulder_height])


def arm_pose(scene: Surroundings, robot: Robot) -> Array:
    """Return the pose (4, 4) of the arm's base in the scene, without the rotation in the arm's own file."""
    return pose(rotation_about([0.0, 0.0, 1.0], scene.placement.yaw), base_position(scene, robot))


def _has_column(scene: Surroundings, robot: Robot) -> bool:
    return bool(base_position(scene, robot)[2] - scene.placement.position[2] > 0.1)


def _place_arm(spec: mujoco.MjSpec, scene: Surroundings, robot: Robot) -> None:
    position = base_position(scene, robot)
    base = spec.worldbody.first_body()
    heading = np.array([np.cos(scene.placement.yaw / 2), 0.0, 0.0, np.sin(scene.placement.yaw / 2)])
    rotation = np.empty(4)
    mujoco.mju_mulQuat(rotation, heading, _base_rotation(robot))
    base.pos, base.quat = position, rotation
    if _has_column(scene, robot):
        floor = scene.placement.position[2]
        half = (position[2] - floor - cart_drop(robot.foot)) / 2
        cart = spec.geom("cart") or spec.worldbody.add_geom(
            name="cart", type=mujoco.mjtGeom.mjGEOM_BOX, rgba=[0.45, 0.45, 0.48, 1],
            contype=ARM_AND_CUP, conaffinity=ARM_AND_CUP,
        )  # fmt: skip
        cart.size, cart.quat = [CART_HALF_WIDTH, CART_HALF_WIDTH, half], heading
        cart.pos = [position[0], position[1], floor + half]
        if slides(spec):  # what stands on the floor is the rail, and the base carries the column
            column = spec.geom("column") or base.add_geom(
                name="column", type=mujoco.mjtGeom.mjGEOM_BOX, rgba=cart.rgba, mass=0, contype=1, conaffinity=3
            )
            back = np.empty(4)
            mujoco.mju_negQuat(back, _base_rotation(robot))
            raised = (_RAIL + _OVER_RAIL) / 2
            column.size, column.quat = [CART_HALF_WIDTH, CART_HALF_WIDTH, half - raised], back
            mujoco.mju_rotVecQuat(column.pos, np.array([0.0, 0.0, floor + half + raised - position[2]]), back)
            cart.size = [CART_HALF_WIDTH, CART_HALF_WIDTH + float(robot.upper[0] - robot.lower[0]) / 2, _RAIL / 2]
            cart.pos = [position[0], position[1], floor + _RAIL / 2]


@lru_cache(maxsize=64)
def _base_rotation(robot: Robot) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the quaternion (4,) of the base in a robot's file, which may rotate it so that it faces ahead."""
    return np.array(robot.spec().worldbody.first_body().quat)


def colors_of(scene: Shapes) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the colors (n, 4) of all shapes of a scene, in their order."""
    columns = scene.columns
    r = np.where(np.isnan(columns.ripeness), 1.0, columns.ripeness)
    fruit = np.column_stack([0.45 + 0.4 * r, 0.6 - 0.47 * r, 0.2 - 0.1 * r, np.ones(len(r))])
    stems = np.array([_STEM_COLORS[kind] for kind in STEM_KINDS])[columns.kinds]
    return np.concatenate([fruit, stems, np.tile(_CLUTTER_COLOR, (len(columns.space), 1))])


def name_of(model: mujoco.MjModel, geom: int) -> str:
    """Return the name of a geom, or of its body if it has none, as in MJCF files from elsewhere."""
    # `MjModel.geom` would first build a table of thousands of names
    own = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    return str(own or model.body(model.geom_bodyid[geom]).name or f"geom {geom}")
