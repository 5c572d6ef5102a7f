"""Fill the slots of a model with the organs of a scene, at rest in the pose in which they were scanned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, ShapeArrays
from greenhouse_gym.robots.robot import CUP_GEOM
from greenhouse_gym.scene import CompiledScene
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.mjcf import base_position
from greenhouse_gym.scene.obstacles import Surroundings
from greenhouse_gym.scene.plants.filled import FilledBodies
from greenhouse_gym.scene.plants.filling import Filler, empty_bodies
from greenhouse_gym.scene.plants.layout import ALL, ARM, ATTACHED, CUP, PETIOLE, RACHIS, Layout, SlotIds
from greenhouse_gym.scene.plants.mechanics import PlantMechanics
from greenhouse_gym.scene.plants.topology import Fruit, Leaf, Topology, Truss


@dataclass(frozen=True, eq=False)
class Planted:
    """Organs for the slots of a model.

    Attributes:
        compiled: The scene, compiled with the slots.
        ids: Ids of the slots.
        trusses: Trusses with fruit to be picked, the first ones in slots. On a rail there may be more of them than
            slots.
        leaves: Leaves in slots.
        fruit: (trusses, fruit) indices of the fruit that can come off, among the scene's tomatoes; -1 if none.
        wanted: (trusses, fruit) whether they are to be picked.
        mechanics: Mechanical parameters.
        topology: Organs of the whole scene.
        filled: Bodies of the scene that were filled before.
    """

    compiled: CompiledScene
    ids: SlotIds
    trusses: tuple[Truss, ...]
    leaves: tuple[Leaf, ...]
    fruit: npt.NDArray[np.int64]
    wanted: npt.NDArray[np.bool_]
    mechanics: PlantMechanics
    topology: Topology
    filled: FilledBodies

    def split(self, truss: int) -> tuple[list[Fruit], list[Fruit]]:
        """Return the fruit of a truss that can come off, in the order of their bodies, and the others."""
        of_row = {fruit.row: fruit for fruit in self.trusses[truss].fruit}
        live = [of_row.pop(row) for row in self.fruit[truss].tolist() if row >= 0]
        return live, list(of_row.values())


def check_fits(topology: Topology, wanted: Sequence[int], layout: Layout, name: str, moves_on: bool) -> list[Truss]:
    """Return the trusses of the fruit to be picked.

    Args:
        topology: Organs of the scene.
        wanted: Indices of the fruit to be picked.
        layout: The layout.
        name: Name of the scene.
        moves_on: Slots move on to other trusses with the cart.

    Raises:
        InvalidValueError: They need more slots than the layout has.
    """
    trusses = list(dict.fromkeys(topology.truss_of(fruit) for fruit in wanted))
    largest = max((sum(f.row in wanted for f in truss.fruit) for truss in trusses), default=0)
    crowded = any(len(truss.fruit) > layout.fruit + ATTACHED or len(truss.rows) > RACHIS for truss in trusses)
    if (len(trusses) > layout.trusses and not moves_on) or largest > layout.fruit or crowded:
        raise InvalidValueError(
            f"scene {name!r}: {len(wanted)} fruit on {len(trusses)} trusses, up to {largest} on one, do not fit into "
            f"{layout.trusses} slots of {layout.fruit} fruit to pick and {ATTACHED} others; pick fewer fruit, or give "
            "the task a larger Layout"
        )
    return trusses


def choose_organs(
    compiled: CompiledScene,
    ids: SlotIds,
    topology: Topology,
    wanted: Sequence[int],
    layout: Layout,
    mechanics: PlantMechanics,
    filled: FilledBodies,
) -> Planted:
    """Choose the organs that get the slots of a model: the trusses of some fruit and the leaves around them.

    With an arm on a rail, the trusses nearest to it get the slots if there are not enough for all.

    Args:
        compiled: The scene, compiled with the slots of the layout.
        ids: Ids of the slots.
        topology: Organs of the scene.
        wanted: Indices of the fruit to be picked, among the scene's tomatoes.
        layout: The layout.
        mechanics: Mechanical parameters.
        filled: Bodies of the scene that were filled before.

    Raises:
        InvalidValueError: The fruit do not fit into the slots, or the arm has no cup.
    """
    scene, robot = compiled.scene, compiled.robot
    trusses = check_fits(topology, wanted, layout, scene.name, robot.on_rail and not layout.cutter)
    if len(trusses) > layout.trusses:
        shoulder = base_position(scene, robot) + [0.0, 0.0, robot.shoulder_height]
        trusses.sort(key=lambda truss: _distance(scene.arrays, truss, wanted, shoulder))
    if ids.cup_geom < 0:
        raise InvalidValueError(
            f"robot {robot.name!r} has no gripper that can hold: its file needs a geom {CUP_GEOM!r} at the "
            "tip, such as greenhouse_gym.robots.tool.mount_tool adds"
        )
    fruit = np.full((max(layout.trusses, len(trusses)), layout.fruit), -1)
    for i, truss in enumerate(trusses):
        center = scene.arrays.starts[[f.row for f in truss.fruit if f.row in wanted]].mean(axis=0)
        order = sorted(
            (f.row for f in truss.fruit),
            key=lambda row: (row not in wanted, float(np.linalg.norm(scene.arrays.starts[row] - center))),
        )[: layout.fruit]
        fruit[i, : len(order)] = order
    seated = [row for row in fruit[: layout.trusses].ravel().tolist() if row in wanted]
    leaves = nearest_leaves(topology, scene.arrays, scene.arrays.starts[seated], layout.leaves)
    return Planted(
        compiled, ids, tuple(trusses), tuple(leaves), fruit, np.isin(fruit, list(wanted)), mechanics, topology, filled
    )


def empty_slots(model: mujoco.MjModel, ids: SlotIds) -> None:
    """Prepare the slots of a compiled model, which `plant` fills in its copies."""
    empty_bodies(
        model, [*ids.truss, *ids.fruit.ravel(), *ids.leaf, *ids.loose, *ids.cut, *ids.cut_fruit.ravel()]
    )  # fmt: skip


def plant(model: mujoco.MjModel, planted: Planted, layout: Layout, scratch: mujoco.MjData) -> None:
    """Fill the empty slots of a model; other organs become static, and static leaves let the arm pass.

    Args:
        model: A copy of the compiled model, its geoms in either order; it is changed.
        planted: Organs for its slots.
        layout: The layout.
        scratch: Any data of the model, to compute its constants with.
    """
    ids = planted.ids
    filler = Filler(model, planted.compiled, planted.mechanics, filled=planted.filled)
    _make_static(model, planted)
    for i in range(min(len(planted.trusses), layout.trusses)):
        seat(filler, planted, i, i)
    for body, leaf in zip(ids.leaf, planted.leaves, strict=False):
        filler.leaf(int(body), leaf)
    _place_crate(model, ids, planted.compiled.scene, layout)
    filler.finish([*ids.truss, *ids.fruit.ravel(), *ids.leaf], ids, scratch)


def seat(filler: Filler, planted: Planted, slot: int, truss: int) -> None:
    """Fill an empty slot with a truss and its fruit."""
    live, attached = planted.split(truss)
    filler.truss(int(planted.ids.truss[slot]), planted.trusses[truss], attached)
    for body, fruit in zip(planted.ids.fruit[slot], live, strict=False):
        filler.fruit(int(body), fruit, planted.trusses[truss].root)


def nearest_leaves(topology: Topology, arrays: ShapeArrays, centers: Array, count: int) -> list[Leaf]:
    """Return the leaves that are nearest to the fruit to be picked (n, 3) and fit into slots."""
    rows, first = topology.plates
    if not len(rows):
        return []
    gaps = np.linalg.norm(arrays.starts[rows][:, None] - centers, axis=-1).min(axis=1)
    leaves = [leaf for leaf in topology.leaves if leaf.plates]
    order = np.minimum.reduceat(gaps, first).argsort(kind="stable").tolist()
    return list(islice((leaves[k] for k in order if len(leaves[k].rows) <= PETIOLE), count))


def _distance(arrays: ShapeArrays, truss: Truss, wanted: Sequence[int], point: Array) -> float:
    """Return the distance of a point from the nearest fruit of a truss that is to be picked, metres."""
    rows = [fruit.row for fruit in truss.fruit if fruit.row in wanted]
    return float(np.linalg.norm(arrays.starts[rows] - point, axis=1).min())


def _make_static(model: mujoco.MjModel, planted: Planted) -> None:
    """Let the arm and loose fruit collide with the static scene; loose fruit passes through its leaves."""
    first = first_world_geom(model)
    world = slice(first, first + int(model.body_geomnum[0]))
    model.geom_contype[world], model.geom_conaffinity[world] = 0, ALL
    model.geom_conaffinity[first + planted.compiled.obstacle_geoms.start + planted.topology.soft] = ARM | CUP


def _place_crate(model: mujoco.MjModel, ids: SlotIds, scene: Surroundings, layout: Layout) -> None:
    """Place the crate next to the arm's stand, on its cart if that slides."""
    placement = scene.placement
    turn = placement.yaw
    cosine, sine = np.cos(turn), np.sin(turn)
    x, y, z = layout.crate.position
    model.body_pos[ids.crate] = placement.position + [cosine * x - sine * y, sine * x + cosine * y, z]
    model.body_quat[ids.crate] = [np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)]
    if model.body_parentid[ids.crate]:  # on a cart that slides
        base, back = int(model.body_parentid[ids.crate]), np.empty(4)
        mujoco.mju_negQuat(back, model.body_quat[base])
        mujoco.mju_rotVecQuat(model.body_pos[ids.crate], model.body_pos[ids.crate] - model.body_pos[base], back)
        mujoco.mju_mulQuat(model.body_quat[ids.crate], back, model.body_quat[ids.crate].copy())
