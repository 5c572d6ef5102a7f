"""Fill the slots of a model with the organs of a scene, at rest in the pose in which they were scanned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, ShapeArrays
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE
from greenhouse_gym.robots.robot import CUP_GEOM
from greenhouse_gym.scene import CompiledScene
from greenhouse_gym.scene.mjcf import colors_of
from greenhouse_gym.scene.obstacle_slots import build_tree, write_geoms
from greenhouse_gym.scene.plants.layout import (
    ALL,
    ARM,
    ATTACHED,
    CUP,
    LOOSE,
    PEDICEL,
    PETIOLE,
    PLATES,
    RACHIS,
    Layout,
    SlotIds,
)
from greenhouse_gym.scene.plants.mechanics import PlantMechanics, mass_properties
from greenhouse_gym.scene.plants.topology import Branch, Fruit, Leaf, Topology, Truss

_UP = np.array([0.0, 0.0, 1.0])
_UPRIGHT_MARGIN = 1.5  # stiffness of an organ above its root over that at which gravity would tip it
_THICKEST = 0.004  # metres: half thickness of merged leaflets, which curve
_MIN_DAMPING = 1e-4  # N m s/rad


@dataclass(frozen=True, eq=False)
class Planted:
    """Organs in the slots of a model.

    Attributes:
        ids: Ids of the slots.
        trusses: Trusses in their slots.
        leaves: Leaves in theirs.
        fruit: (trusses, fruit) indices of the fruit that can come off, among the scene's tomatoes; -1 if empty.
        wanted: (trusses, fruit) whether they are to be picked.
        mechanics: Mechanical parameters.
        topology: Organs of the whole scene.
    """

    ids: SlotIds
    trusses: tuple[Truss, ...]
    leaves: tuple[Leaf, ...]
    fruit: npt.NDArray[np.int64]
    wanted: npt.NDArray[np.bool_]
    mechanics: PlantMechanics
    topology: Topology


def check_fits(topology: Topology, wanted: Sequence[int], layout: Layout, name: str) -> list[Truss]:
    """Return the trusses of the fruit to be picked.

    Raises:
        InvalidValueError: They need more slots than the layout has.
    """
    trusses = list(dict.fromkeys(topology.truss_of(fruit) for fruit in wanted))
    largest = max((sum(f.row in wanted for f in truss.fruit) for truss in trusses), default=0)
    crowded = any(len(truss.fruit) > layout.fruit + ATTACHED or len(truss.rows) > RACHIS for truss in trusses)
    if len(trusses) > layout.trusses or largest > layout.fruit or crowded:
        raise InvalidValueError(
            f"scene {name!r}: {len(wanted)} fruit on {len(trusses)} trusses, up to {largest} on one, do not fit into "
            f"{layout.trusses} slots of {layout.fruit} fruit to pick and {ATTACHED} others; pick fewer fruit, or give "
            "the task a larger Layout"
        )
    return trusses


def plant(
    compiled: CompiledScene, topology: Topology, wanted: Sequence[int], layout: Layout, mechanics: PlantMechanics
) -> Planted:
    """Fill the slots of a model; other organs become static, and static leaves let the arm pass.

    Args:
        compiled: The scene, compiled with the slots of the layout. Its model is changed.
        topology: Organs of the scene.
        wanted: Indices of the fruit to be picked, among the scene's tomatoes.
        layout: The layout.
        mechanics: Mechanical parameters.

    Raises:
        InvalidValueError: The fruit do not fit into the slots, or the arm has no cup.
    """
    model, scene = compiled.model, compiled.scene
    trusses = check_fits(topology, wanted, layout, scene.name)
    leaves = _nearest_leaves(topology, scene.arrays, wanted, layout.leaves)
    ids = SlotIds(model, layout)
    if ids.cup_geom < 0:
        raise InvalidValueError(
            f"robot {compiled.robot.name!r} has no gripper that can hold: its file needs a geom {CUP_GEOM!r} at the "
            "tip, such as greenhouse_gym.robots.tool.mount_tool adds"
        )
    filler = _Filler(compiled, mechanics)
    fruit = np.full((layout.trusses, layout.fruit), -1)
    _make_static(compiled, topology)
    for i, truss in enumerate(trusses):
        center = scene.arrays.starts[[f.row for f in truss.fruit if f.row in wanted]].mean(axis=0)
        order = sorted(
            truss.fruit,
            key=lambda f: (f.row not in wanted, float(np.linalg.norm(scene.arrays.starts[f.row] - center))),
        )
        live, rest = order[: layout.fruit], order[layout.fruit :]
        filler.truss(int(ids.truss[i]), truss, rest)
        for k, one in enumerate(live):
            filler.fruit(int(ids.fruit[i, k]), one, truss.root)
            fruit[i, k] = one.row
    for i, leaf in enumerate(leaves):
        filler.leaf(int(ids.leaf[i]), leaf)
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
    filler.finish(ids)
    return Planted(ids, tuple(trusses), tuple(leaves), fruit, np.isin(fruit, list(wanted)), mechanics, topology)


def _nearest_leaves(topology: Topology, arrays: ShapeArrays, wanted: Sequence[int], count: int) -> list[Leaf]:
    """Return the leaves nearest to the fruit to be picked and to the space in front of them."""
    centers = arrays.starts[list(wanted)]
    fitting = [leaf for leaf in topology.leaves if len(leaf.rows) <= PETIOLE and leaf.plates]

    def distance(leaf: Leaf) -> float:
        points = arrays.starts[list(leaf.plates)]
        return float(np.linalg.norm(points[:, None] - centers, axis=-1).min())

    return sorted(fitting, key=distance)[:count]


def _make_static(compiled: CompiledScene, topology: Topology) -> None:
    """Let the arm and loose fruit collide with the static scene; loose fruit passes through its leaves."""
    model, slots = compiled.model, compiled.obstacle_geoms
    world = slice(0, int(model.body_geomnum[0]))
    model.geom_contype[world], model.geom_conaffinity[world] = 0, ALL
    leafy = np.setdiff1d(np.array(topology.clutter), topology.fixed)
    model.geom_conaffinity[slots.start + leafy] = ARM | CUP


class _Filler:
    """Filling of a model: shapes of a scene move from its static slots into bodies."""

    def __init__(self, compiled: CompiledScene, mechanics: PlantMechanics):
        self._model, self._first = compiled.model, int(compiled.obstacle_geoms.start)
        self._arrays, self._mechanics = compiled.scene.arrays, mechanics
        self._colors = colors_of(compiled.scene)
        model = self._model
        for body in range(1, model.nbody):  # empty slots touch nothing
            if model.body(body).name.startswith(("truss_", "fruit_", "leaf_", "loose_", "cut_")):
                first = int(model.body_geomadr[body])
                model.geom_conaffinity[first : first + int(model.body_geomnum[body])] = 0

    def truss(self, body: int, truss: Truss, attached: Sequence[Fruit]) -> None:
        """Fill a truss with its rachis and the fruit that stay on it."""
        arrays, rows, thin = self._arrays, [*truss.rows, *(fruit.row for fruit in attached)], list(truss.rows[-1:])
        pedicels = _straight(
            np.array([fruit.joint for fruit in attached]).reshape(-1, 3),
            arrays.starts[[fruit.row for fruit in attached]], float(arrays.sizes[thin, 0].min()),
        )  # fmt: skip
        for fruit in attached:
            self._hide([fruit.row, *fruit.pedicel, *fruit.calyx])
        self._hide(truss.rows)
        self._hinges(body, truss, self._mechanics.truss_stiffness)
        colors = np.concatenate([self._colors[rows], np.repeat(self._colors[thin], len(attached), axis=0)])
        self._put(body, _joined(_chosen(arrays, rows), pedicels), colors, truss.root)

    def leaf(self, body: int, leaf: Leaf) -> None:
        """Fill the slots of a leaf."""
        self._hide([*leaf.rows, *leaf.plates])
        self._hinges(body, leaf, self._mechanics.leaf_stiffness)
        plates = merged(_chosen(self._arrays, leaf.plates), PLATES)
        petiole = self._colors[list(leaf.rows)]
        colors = np.concatenate([petiole, np.repeat(petiole[:1], len(plates.kinds), axis=0)])
        self._put(body, _joined(_chosen(self._arrays, leaf.rows), plates), colors, leaf.root)

    def fruit(self, body: int, fruit: Fruit, root: Array) -> None:
        """Fill a fruit that can come off, its first geom, with its pedicel."""
        self._hide([fruit.row, *fruit.pedicel, *fruit.calyx])
        model = self._model
        model.body_pos[body] = fruit.joint - root
        rows = [fruit.row, *fruit.pedicel[:PEDICEL]]
        self._put(body, _chosen(self._arrays, rows), self._colors[rows], fruit.joint)
        model.jnt_stiffness[model.body_jntadr[body]] = self._mechanics.pedicel_stiffness

    def finish(self, ids: SlotIds) -> None:
        """Choose damping, and springs that hold all organs where they were scanned."""
        model, mechanics = self._model, self._mechanics
        data = mujoco.MjData(model)
        mujoco.mj_setConst(model, data)
        data.qpos[:], data.qvel[:] = model.qpos0, 0.0
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        self._part_overlaps(data, ids)
        bias = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, bias)
        for body in (*ids.truss, *ids.fruit.ravel(), *ids.leaf):
            for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
                ball = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
                dof, qpos = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
                dofs = slice(dof, dof + (3 if ball else 1))
                torque = bias[dofs]
                above = data.subtree_com[body][2] - data.xanchor[joint][2]
                stiffness = float(model.jnt_stiffness[joint])
                tipping = float(-model.opt.gravity[2] * model.body_subtreemass[body] * above)
                stiffness += _UPRIGHT_MARGIN * max(0.0, tipping)
                stiffness = max(stiffness, float(np.linalg.norm(torque)) / mechanics.max_sag)
                model.jnt_stiffness[joint] = stiffness
                damping = 2 * mechanics.damping_ratio * np.sqrt(stiffness * model.dof_M0[dofs])
                model.dof_damping[dofs] = np.maximum(damping, _MIN_DAMPING)
                if ball:
                    bend = torque / stiffness
                    angle = float(np.linalg.norm(bend))
                    axis = bend / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
                    mujoco.mju_axisAngle2Quat(model.qpos_spring[qpos : qpos + 4], axis, angle)
                else:
                    model.qpos_spring[qpos] = torque[0] / stiffness

    def _part_overlaps(self, data: mujoco.MjData, ids: SlotIds) -> None:
        """Let what comes loose pass the static shapes that it overlapped in the scan, which would eject it."""
        model = self._model
        static = self._first + np.arange(len(self._arrays.kinds))
        static = static[(model.geom_conaffinity[static] & LOOSE) > 0]
        loose = [int(model.body_geomadr[body]) for body in ids.fruit.ravel()]
        for body in ids.truss[: len(ids.cut)]:  # whole trusses come loose
            loose += range(int(model.body_geomadr[body]), int(model.body_geomadr[body] + model.body_geomnum[body]))
        for one in loose:
            apart = np.linalg.norm(data.geom_xpos[static] - data.geom_xpos[one], axis=1)
            for geom in static[apart < model.geom_rbound[static] + model.geom_rbound[one]]:
                if mujoco.mj_geomDistance(model, data, one, int(geom), 0.0, None) < 0:
                    model.geom_conaffinity[geom] &= ~LOOSE

    def _hinges(self, body: int, branch: Branch, stiffness: float) -> None:
        """Place a body at the root of an organ that droops and swings about it."""
        model, outward = self._model, (branch.tip - branch.root) * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(outward))
        outward = outward / length if length > 1e-3 else np.array([-1.0, 0.0, 0.0])
        joint = int(model.body_jntadr[body])
        model.body_pos[body] = branch.root
        model.jnt_axis[joint], model.jnt_axis[joint + 1] = np.cross(_UP, outward), _UP
        model.jnt_stiffness[joint : joint + 2] = stiffness

    def _put(self, body: int, shapes: ShapeArrays, colors: Array, origin: Array) -> None:
        """Turn the first geoms of a body into shapes."""
        model = self._model
        shapes = shapes._replace(starts=shapes.starts - origin, ends=shapes.ends - origin)
        first = int(model.body_geomadr[body])
        own = slice(first, first + len(shapes.kinds))
        write_geoms(model, own, shapes, colors)
        model.geom_conaffinity[own] = ALL
        mass, center, inertia, quat = mass_properties(shapes, self._mechanics)
        model.body_mass[body], model.body_inertia[body] = mass, inertia
        model.body_ipos[body], model.body_iquat[body] = center, quat
        model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        build_tree(model, body)

    def _hide(self, rows: Sequence[int]) -> None:
        """Take shapes out of the static scene."""
        geoms = self._first + np.array(list(rows), dtype=np.int64)
        self._model.geom_conaffinity[geoms] = 0
        self._model.geom_rgba[geoms, 3] = 0.0


def merged(plates: ShapeArrays, count: int) -> ShapeArrays:
    """Merge the boxes of a leaf into at most ``count`` thin ones, each along neighboring ones."""
    if len(plates.kinds) <= count:
        return plates
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 3)).reshape(3, 8).T
    corners = plates.starts[:, None] + (signs * plates.sizes[:, None]) @ plates.rotations.transpose(0, 2, 1)
    groups = [np.arange(len(plates.kinds))]
    while len(groups) < count:
        spreads = [np.ptp(plates.starts[group], axis=0).max() for group in groups]
        group = groups.pop(int(np.argmax(spreads)))
        middle = plates.starts[group]
        axis = int(np.ptp(middle, axis=0).argmax())
        order = group[np.argsort(middle[:, axis], kind="stable")]
        groups += [order[: len(order) // 2], order[len(order) // 2 :]]
    result = ShapeArrays.empty(count)
    result.kinds[:] = BOX
    for k, group in enumerate(groups):
        points = corners[group].reshape(-1, 3)
        center = points.mean(axis=0)
        _, axes = np.linalg.eigh((points - center).T @ (points - center))
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        local = (points - center) @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        half = (high - low) / 2
        half[0] = min(half[0], _THICKEST)
        result.starts[k] = result.ends[k] = center + axes @ ([np.median(local[:, 0]), *(low + high)[1:] / 2])
        result.sizes[k], result.rotations[k] = half, axes
    return result


def _chosen(arrays: ShapeArrays, rows: Sequence[int]) -> ShapeArrays:
    return ShapeArrays._make(array[list(rows)] for array in arrays)


def _joined(*parts: ShapeArrays) -> ShapeArrays:
    return ShapeArrays._make(np.concatenate(arrays) for arrays in zip(*parts, strict=True))


def _straight(starts: Array, ends: Array, radius: float) -> ShapeArrays:
    """Return capsules between points (n, 3)."""
    result = ShapeArrays.empty(len(starts))
    result.kinds[:], result.starts[:], result.ends[:], result.sizes[:, 0] = CAPSULE, starts, ends, radius
    return result
