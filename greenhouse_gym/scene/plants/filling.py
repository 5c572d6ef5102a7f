"""Move shapes of a scene between its static slots and bodies, which rest where the shapes hang."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from types import MappingProxyType

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array, ShapeArrays, transform
from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE
from greenhouse_gym.scene import CompiledScene
from greenhouse_gym.scene.geom_order import first_world_geom, without_world_geoms
from greenhouse_gym.scene.obstacle_slots import build_tree, write_geoms
from greenhouse_gym.scene.plants.detachment import first_geom, update_constants
from greenhouse_gym.scene.plants.filled import FilledBodies
from greenhouse_gym.scene.plants.layout import (
    ALL,
    EMPTY_INERTIA,
    EMPTY_MASS,
    EMPTY_SIZE,
    LOOSE,
    PEDICEL,
    PLATES,
    SlotIds,
)
from greenhouse_gym.scene.plants.mechanics import PlantMechanics, mass_properties
from greenhouse_gym.scene.plants.topology import Branch, Fruit, Leaf, Truss

Colors = npt.NDArray[np.floating]

_UP = np.array([0.0, 0.0, 1.0])
_UPRIGHT_MARGIN = 1.5  # stiffness of an organ above its root over that at which gravity would tip it
_THICKEST = 0.004  # metres: half thickness of merged leaflets, which curve
_MIN_DAMPING = 1e-4  # N m s/rad


class Filler:
    """Filling of a model: shapes of a scene move from its static slots into bodies, and back.

    Args:
        model: The model, its geoms in either order; it is changed.
        compiled: The scene, compiled with the layout of the model.
        mechanics: Mechanical parameters.
        motions: (4, 4) motions since the scan of shapes that have moved, by their rows.
        filled: Bodies of the scene that were filled before; None if shapes have moved.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        compiled: CompiledScene,
        mechanics: PlantMechanics,
        motions: Mapping[int, Array] = MappingProxyType({}),
        filled: FilledBodies | None = None,
    ):
        self._filled = FilledBodies() if filled is None else filled
        self._model, self._mechanics, self._motions = model, mechanics, motions
        self._first = first_world_geom(model) + int(compiled.obstacle_geoms.start)
        self._arrays, self._colors = compiled.scene.arrays, compiled.model.geom_rgba[compiled.obstacle_geoms].copy()

    def truss(self, body: int, truss: Truss, attached: Sequence[Fruit]) -> None:
        """Fill a truss with its rachis and the fruit that stay on it."""
        self._hide([*truss.rows, *(row for one in attached for row in (one.row, *one.pedicel, *one.calyx))])
        self._hinges(body, truss, self._mechanics.truss_stiffness)
        organ = (truss, *attached)
        if self._filled.recall(self._model, body, organ, self._mechanics):
            return
        rows, thin = [*truss.rows, *(fruit.row for fruit in attached)], list(truss.rows[-1:])
        joints = np.array([self.joint(fruit) for fruit in attached]).reshape(-1, 3)
        centers = self.shapes([fruit.row for fruit in attached]).starts
        pedicels = _straight(joints, centers, float(self._arrays.sizes[thin, 0].min()))
        colors = np.concatenate([self._colors[rows], np.repeat(self._colors[thin], len(attached), axis=0)])
        self._put(body, ShapeArrays.joined([self.shapes(rows), pedicels]), colors, truss.root, organ)

    def leaf(self, body: int, leaf: Leaf) -> None:
        """Fill the slots of a leaf."""
        self._hide([*leaf.rows, *leaf.plates])
        self._hinges(body, leaf, self._mechanics.leaf_stiffness)
        if self._filled.recall(self._model, body, leaf, self._mechanics):
            return
        known = self._filled.plates
        plates = known[leaf] if leaf in known else known.setdefault(leaf, merged(self.shapes(leaf.plates), PLATES))
        petiole = self._colors[list(leaf.rows)]
        colors = np.concatenate([petiole, np.repeat(petiole[:1], len(plates.kinds), axis=0)])
        self._put(body, ShapeArrays.joined([self.shapes(leaf.rows), plates]), colors, leaf.root, leaf)

    def fruit(self, body: int, fruit: Fruit, root: Array) -> None:
        """Fill a fruit that can come off, its first geom, with its pedicel."""
        self._hide([fruit.row, *fruit.pedicel, *fruit.calyx])
        model, joint = self._model, self.joint(fruit)
        model.body_pos[body] = joint - root
        model.jnt_stiffness[model.body_jntadr[body]] = self._mechanics.pedicel_stiffness
        if self._filled.recall(model, body, fruit, self._mechanics):
            return
        rows = [fruit.row, *fruit.pedicel[:PEDICEL]]
        self._put(body, self.shapes(rows), self._colors[rows], joint, fruit)

    def show(self, rows: Sequence[int], mask: int) -> None:
        """Make shapes static where they are now; they stop what the mask holds. The world's tree has to be built."""
        geoms = self._first + np.array(rows, dtype=np.int64)
        write_geoms(self._model, geoms, self.shapes(rows), self._colors[list(rows)])
        self._model.geom_conaffinity[geoms] = mask

    def finish(self, bodies: Sequence[int], ids: SlotIds, scratch: mujoco.MjData) -> None:
        """Choose damping, and springs that hold the organs in bodies where they hang."""
        model, data = self._model, scratch
        update_constants(model, data)
        data.qpos[:], data.qvel[:] = model.qpos0, 0.0
        with without_world_geoms(model):
            mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        self._part_overlaps(data, bodies, ids)
        bias = np.zeros(model.nv)
        mujoco.mj_rne(model, data, 0, bias)
        self._preload(data, np.array(bodies), bias)

    def _preload(self, data: mujoco.MjData, bodies: npt.NDArray[np.int64], bias: Array) -> None:
        """Choose stiffness, damping and rest poses of organs, which have a ball joint or two hinges each.

        Args:
            data: The pose in which they hang, without springs.
            bodies: (n,) the bodies.
            bias: (dofs,) torques of gravity, N m.
        """
        model, mechanics = self._model, self._mechanics
        first, dof = model.body_jntadr[bodies], model.body_dofadr[bodies]
        at = model.jnt_qposadr[first]
        above = data.subtree_com[bodies, 2] - data.xanchor[first, 2]
        tipping = np.maximum(0.0, -model.opt.gravity[2] * model.body_subtreemass[bodies] * above)
        stiffness = model.jnt_stiffness[first] + _UPRIGHT_MARGIN * tipping
        ball = model.jnt_type[first] == mujoco.mjtJoint.mjJNT_BALL
        torques = bias[dof[:, None] + np.where(ball[:, None], [0, 1, 2], [0, 1, 1])]
        # an organ is as stiff sideways, where it bears no weight, as up and down: it would fall over when it rises
        largest = np.abs(torques).max(axis=1)
        largest[ball] = [np.linalg.norm(torque) for torque in torques[ball]]
        stiffness = np.maximum(stiffness, largest / mechanics.max_sag)
        for k in range(3):
            has = ball | (k < 2)
            own = dof[has] + k
            damping = 2 * mechanics.damping_ratio * np.sqrt(stiffness[has] * model.dof_M0[own])
            model.dof_damping[own] = np.maximum(damping, _MIN_DAMPING)
        bends = torques / stiffness[:, None]
        for k in range(2):
            model.jnt_stiffness[first[~ball] + k] = stiffness[~ball]
            model.qpos_spring[at[~ball] + k] = bends[~ball, k]
        model.jnt_stiffness[first[ball]] = stiffness[ball]
        for k in np.flatnonzero(ball).tolist():
            angle = float(np.linalg.norm(bends[k]))
            axis = bends[k] / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
            mujoco.mju_axisAngle2Quat(model.qpos_spring[at[k] : at[k] + 4], axis, angle)

    def shapes(self, rows: Sequence[int]) -> ShapeArrays:
        """Return shapes where they are now."""
        chosen = self._arrays.select(np.array(rows, dtype=np.int64))
        for k, row in enumerate(rows):
            if row in self._motions:
                motion = self._motions[row]
                chosen.starts[k], chosen.ends[k] = transform(motion, np.stack([chosen.starts[k], chosen.ends[k]]))
                chosen.rotations[k] = motion[:3, :3] @ chosen.rotations[k]
        return chosen

    def joint(self, fruit: Fruit) -> Array:
        """Return the start (3,) of the pedicel of a fruit where it is now, metres."""
        motion = self._motions.get(fruit.row)
        return fruit.joint if motion is None else transform(motion, fruit.joint)

    def _part_overlaps(self, data: mujoco.MjData, bodies: Sequence[int], ids: SlotIds) -> None:
        """Let what comes loose pass the static shapes that it overlapped in the scan, which would eject it."""
        model = self._model
        static = self._first + np.arange(len(self._arrays.kinds))
        static = static[(model.geom_conaffinity[static] & LOOSE) > 0]
        loose = [int(model.body_geomadr[body]) for body in bodies if body in ids.fruit]
        for body in ids.truss[: len(ids.cut)]:  # whole trusses come loose
            loose += range(int(model.body_geomadr[body]), int(model.body_geomadr[body] + model.body_geomnum[body]))
        offsets = model.geom_pos[static] - data.geom_xpos[loose][:, None]
        apart = np.sqrt((offsets * offsets).sum(axis=2))
        for k, j in np.argwhere(apart < model.geom_rbound[static] + model.geom_rbound[loose][:, None]).tolist():
            geom = int(static[j])
            data.geom_xpos[geom] = model.geom_pos[geom]
            mujoco.mju_quat2Mat(data.geom_xmat[geom], model.geom_quat[geom])
            if mujoco.mj_geomDistance(model, data, loose[k], geom, 0.0, None) < 0:
                model.geom_conaffinity[geom] &= ~LOOSE

    def _hinges(self, body: int, branch: Branch, stiffness: float) -> None:
        """Place a body at the root of an organ that droops and swings about it."""
        motion = self._motions.get(branch.rows[0])
        tip = branch.tip if motion is None else transform(motion, branch.tip)
        model, outward = self._model, (tip - branch.root) * [1.0, 1.0, 0.0]
        length = float(np.linalg.norm(outward))
        outward = outward / length if length > 1e-3 else np.array([-1.0, 0.0, 0.0])
        joint = int(model.body_jntadr[body])
        model.body_pos[body] = branch.root
        model.jnt_axis[joint], model.jnt_axis[joint + 1] = [-outward[1], outward[0], 0.0], _UP
        model.jnt_stiffness[joint : joint + 2] = stiffness

    def _put(self, body: int, shapes: ShapeArrays, colors: Colors, origin: Array, organ: Hashable) -> None:
        """Turn the first geoms of a body into the shapes of an organ."""
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
        self._filled.remember(model, body, organ)

    def _hide(self, rows: Sequence[int]) -> None:
        """Take shapes out of the static scene."""
        geoms = self._first + np.array(list(rows), dtype=np.int64)
        self._model.geom_conaffinity[geoms] = 0
        self._model.geom_rgba[geoms, 3] = 0.0


def empty_bodies(model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    """Take all shapes out of bodies."""
    for body in bodies:
        own = slice(first_geom(model, body), first_geom(model, body) + int(model.body_geomnum[body]))
        points = ShapeArrays.empty(own.stop - own.start)
        points.sizes[:, 0] = EMPTY_SIZE
        write_geoms(model, own, points, np.zeros((len(points.kinds), 4)))
        model.geom_contype[own] = model.geom_conaffinity[own] = 0
        model.body_mass[body], model.body_inertia[body] = EMPTY_MASS, EMPTY_INERTIA
        model.body_ipos[body], model.body_iquat[body] = 0.0, [1.0, 0.0, 0.0, 0.0]
        if model.body_parentid[body]:  # a fruit of a truss; others stay where they are
            model.body_pos[body] = 0.0
        build_tree(model, body)


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


def _straight(starts: Array, ends: Array, radius: float) -> ShapeArrays:
    """Return capsules between points (n, 3)."""
    result = ShapeArrays.empty(len(starts))
    result.kinds[:], result.starts[:], result.ends[:], result.sizes[:, 0] = CAPSULE, starts, ends, radius
    return result
