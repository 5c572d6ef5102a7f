"""Layout of the slots for compliant organs, loose fruit and a crate: the bodies that all models of a kind share."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.robots.robot import CUP_GEOM, TIP_SITE, slides
from greenhouse_gym.scene.plants.mechanics import BALL_ARMATURE, HINGE_ARMATURE, HINGE_RANGE

ARM, CUP, LOOSE = 1, 2, 4
"""Bits of collision masks: links of the arm, its cup, and fruit that came off."""

ALL = ARM | CUP | LOOSE
"""Mask of everything that stops the arm and loose fruit."""

RACHIS, PEDICEL, ATTACHED, PETIOLE, PLATES = 8, 5, 16, 6, 12
"""Numbers of shapes in a slot: pieces of a rachis and of each pedicel, fruit that stay on their truss, pieces of a
petiole, and plates of a leaf. Each costs time, used or not; a leaf of more plates is merged into as many."""

SUCTION = "suction"
"""Name of the weld between the cup and a fruit."""

CRATE_BOXES = 6
"""Number of boxes of the crate: bottom, walls and shelf."""

ROW_REACH = 0.8
"""Distance from the shoulder of an arm on a rail within which fruit are picked, metres."""

ROW_CRATE = 120
"""Least number of fruit that can lie in the crate of an arm on a rail; it meets more fruit than there are slots."""

EMPTY_MASS, EMPTY_INERTIA, EMPTY_SIZE = 0.01, 1e-5, 0.001
"""Mass and moments of an empty body, kg and kg m^2, and the radius of its geoms, metres."""

SERVO_ERROR = 0.0375
"""Error at which servos without a limit of their own exert their largest force, radians: 150 and 38 N m for a UR5e; its
data sheet says 150 and 28. Without any limit an arm presses what does not move with kilonewtons."""

_PARKED_HEIGHT = 40.0
_CRATE_MASS = 2.0  # kg
_EXTENT = 4.0  # metres: size of a scene, which parked bodies do not belong to; cameras see from a hundredth of it on


@dataclass(frozen=True)
class Crate:
    """An open box on a shelf next to the arm, in the frame of the arm's stand on the floor.

    Attributes:
        position: Middle of its bottom, metres: x toward the plants, y left along the row, z up.
        half_extents: Half its length, width and height, metres.
    """

    position: tuple[float, float, float] = (-0.05, 0.45, 0.52)
    half_extents: tuple[float, float, float] = (0.2, 0.15, 0.1)

    @property
    def boxes(self) -> list[tuple[Array, Array]]:
        """Middles and half extents (3,) of bottom, walls and shelf, from the middle of the bottom, metres."""
        (x, y, z), thin = self.half_extents, 0.006
        shelf = (self.position[2] - thin) / 2
        parts = [
            ((0, 0, 0), (x, y, thin)), ((-x, 0, z), (thin, y, z)), ((x, 0, z), (thin, y, z)),
            ((0, -y, z), (x, thin, z)), ((0, y, z), (x, thin, z)), ((0, 0, -thin - shelf), (0.8 * x, 0.8 * y, shelf)),
        ]  # fmt: skip
        return [(np.array(middle, dtype=np.float64), np.array(half, dtype=np.float64)) for middle, half in parts]


@dataclass(frozen=True)
class Layout:
    """Numbers of slots; models of one layout and arm have equal sizes.

    Attributes:
        trusses: Trusses that give way.
        fruit: Fruit of each that can come off.
        leaves: Leaves that give way.
        loose: Fruit that can be on the move at the same time after coming off.
        crate: The crate.
        cutter: The tool cuts trusses, which become free bodies; otherwise it sucks fruit.
    """

    trusses: int = 1
    fruit: int = 8
    leaves: int = 8
    loose: int = 4
    crate: Crate = Crate()
    cutter: bool = False

    def add(self, spec: mujoco.MjSpec) -> None:
        """Add empty slots, the crate and the suction weld to a scene with an arm, and limit the force of its servos."""
        for servo in spec.actuators:
            if not np.any(servo.forcerange):
                force = SERVO_ERROR * float(servo.gainprm[0])
                servo.forcelimited, servo.forcerange = True, [-force, force]
        world = spec.worldbody
        spec.stat.extent = _EXTENT
        for i in range(self.trusses):
            truss = _hinged(world, f"truss_{i}", i, RACHIS + 2 * ATTACHED)
            _add_fruit(truss, f"fruit_{i}", self.fruit)
        for i in range(self.leaves):
            _hinged(world, f"leaf_{i}", self.trusses + i, PETIOLE + PLATES)
        for i in range(self.loose):
            _parked(world, f"loose_{i}", 2 * _PARKED_HEIGHT + i, 1)
        for i in range(self.trusses if self.cutter else 0):
            cut = _parked(world, f"cut_{i}", 3 * _PARKED_HEIGHT + i, RACHIS + 2 * ATTACHED)
            _add_fruit(cut, f"cut_{i}", self.fruit, gravcomp=1.0)
        on_rail = slides(spec)
        crate = (world.first_body() if on_rail else world).add_body(name="crate", pos=self.crate.position)
        crate.mass, crate.inertia, crate.explicitinertial = _CRATE_MASS, [0.05] * 3, True
        for k, (middle, half) in enumerate(self.crate.boxes):
            color = [0.2, 0.35, 0.7, 1] if k < 5 else [0.5, 0.5, 0.52, 1]
            crate.add_geom(
                name=f"crate_{k}", type=mujoco.mjtGeom.mjGEOM_BOX, pos=middle, size=half, rgba=color,
                contype=0, conaffinity=ALL,
            )  # fmt: skip
        for _ in range(max(self.trusses * self.fruit, ROW_CRATE if on_rail else 0)):  # fruit that lie in it
            _empty_geom(crate)
        cup = spec.site(TIP_SITE).parent
        spec.add_equality(
            name=SUCTION, type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1=cup.name,
            name2="loose_0", active=False,
        )  # fmt: skip


def _hinged(world: mujoco.MjsBody, name: str, number: int, geoms: int) -> mujoco.MjsBody:
    """Add an organ on two hinges: it droops about the first and swings about the second."""
    body = world.add_body(name=name, pos=[0, 0, _PARKED_HEIGHT + number])
    for axis in ([0, 1, 0], [0, 0, 1]):
        body.add_joint(
            type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, stiffness=[0.1, 0, 0], armature=HINGE_ARMATURE,
            range=[-HINGE_RANGE, HINGE_RANGE], limited=True,
        )  # fmt: skip
    _fill_empty(body, geoms)
    return body


def _parked(world: mujoco.MjsBody, name: str, height: float, geoms: int) -> mujoco.MjsBody:
    """Add a free body that waits without falling."""
    body = world.add_body(name=name, pos=[0, 0, height], gravcomp=1.0)
    body.add_freejoint()
    _fill_empty(body, geoms)
    return body


def _add_fruit(truss: mujoco.MjsBody, name: str, count: int, gravcomp: float = 0.0) -> None:
    for k in range(count):
        fruit = truss.add_body(name=f"{name}_{k}", gravcomp=gravcomp)
        fruit.add_joint(type=mujoco.mjtJoint.mjJNT_BALL, armature=BALL_ARMATURE, stiffness=[0.02, 0, 0])
        _fill_empty(fruit, 1 + PEDICEL)


def _fill_empty(body: mujoco.MjsBody, geoms: int) -> None:
    body.mass, body.inertia, body.ipos, body.explicitinertial = EMPTY_MASS, [EMPTY_INERTIA] * 3, [0, 0, 0], True
    for _ in range(geoms):
        _empty_geom(body)


def _empty_geom(body: mujoco.MjsBody) -> None:
    # with a mask: geoms without one have no node in the tree of bounding volumes
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[EMPTY_SIZE, 0, 0],
        mass=0,
        rgba=[0, 0, 0, 0],
        contype=0,
        conaffinity=ALL,
    )


class SlotIds:
    """Ids of the slots in a model of a layout.

    Attributes:
        truss: (trusses,) bodies.
        fruit: (trusses, fruit) bodies.
        leaf: (leaves,) bodies.
        loose: (loose,) bodies.
        cut: (trusses,) bodies of cut trusses; none without a cutter.
        cut_fruit: (trusses, fruit) bodies of their fruit.
        crate: Body of the crate.
        cup: Body of the suction cup.
        cup_geom: Its geom in the compiled order, or -1.
        tip: Site at the tip.
        weld: The equality constraint.
    """

    def __init__(self, model: mujoco.MjModel, layout: Layout):
        def body(name: str) -> int:
            return int(model.body(name).id)

        self.truss = np.array([body(f"truss_{i}") for i in range(layout.trusses)])
        self.fruit = np.array([[body(f"fruit_{i}_{k}") for k in range(layout.fruit)] for i in range(layout.trusses)])
        self.leaf = np.array([body(f"leaf_{i}") for i in range(layout.leaves)], dtype=np.int64)
        self.loose = np.array([body(f"loose_{i}") for i in range(layout.loose)])
        cut = layout.trusses if layout.cutter else 0
        self.cut = np.array([body(f"cut_{i}") for i in range(cut)], dtype=np.int64)
        fruit = [[body(f"cut_{i}_{k}") for k in range(layout.fruit)] for i in range(cut)]
        self.cut_fruit = np.array(fruit, dtype=np.int64).reshape(cut, layout.fruit)
        self.crate = body("crate")
        self.tip = int(model.site(TIP_SITE).id)
        self.cup = int(model.site_bodyid[self.tip])
        self.cup_geom = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, CUP_GEOM))
        self.weld = int(model.equality(SUCTION).id)
