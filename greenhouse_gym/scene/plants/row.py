"""Plants along a row, whose slots move on to other organs as the arm's cart goes."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array, transform
from greenhouse_gym.scene.geom_order import first_world_geom
from greenhouse_gym.scene.obstacle_slots import build_tree
from greenhouse_gym.scene.plants.detachment import leave_stub
from greenhouse_gym.scene.plants.filling import Filler, empty_bodies
from greenhouse_gym.scene.plants.layout import ALL, ARM, CUP, ROW_REACH
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.live_scene import motions
from greenhouse_gym.scene.plants.slots import nearest_leaves, seat
from greenhouse_gym.scene.plants.states import HANGING, WAITING
from greenhouse_gym.scene.plants.topology import Leaf

BEHIND = 0.1
"""Distance beyond reach from which a truss loses its slot to one within reach, metres."""

IDLE_SPEED = 0.1
"""Speed of the joints of an organ below which it may become static, rad/s."""

Ints = npt.NDArray[np.int64]


class RowPlants(LivePlants):
    """Plants along a row that may have more trusses to be picked than slots.

    Slots whose truss is empty or out of reach go to the nearest trusses with fruit within reach, and slots of leaves to
    the leaves around them. All organs stay where they hang: one without a slot is static, and one with a slot rests
    there. Organs that move or are touched stay as they are.
    """

    def move_on(self) -> bool:
        """Move slots on to trusses within reach, with current kinematics; return True if any did."""
        if not (self.wanted & (self.state == WAITING)).any():
            return False
        gaps = self._gaps()
        own = np.where(self.seated >= 0, gaps[self.seated], np.inf)
        late = own > ROW_REACH + BEHIND
        waiting = [truss for truss in np.flatnonzero(gaps < ROW_REACH).tolist() if truss not in self.seated]
        if not late.any() or not waiting:
            return False
        in_contact: Ints = np.unique(self.data.contact.geom)
        near = [
            truss for truss in sorted(waiting, key=lambda truss: float(gaps[truss]))
            if not np.isin(self._static(self._rows(truss)[0]), in_contact).any()
        ]  # fmt: skip
        free = [
            slot for slot in (-own).argsort(kind="stable").tolist() if late[slot] and self._may_leave(slot, in_contact)
        ]
        swaps = list(zip(free, near, strict=False))
        if swaps:
            self._swap(swaps, in_contact)
        return bool(swaps)

    def joint_of(self, fruit: int) -> Array:
        """Return the start (3,) of the pedicel of a fruit on its rachis, metres."""
        if self.state[fruit] != WAITING:
            return super().joint_of(fruit)
        row = int(self.planted.fruit.flat[fruit])
        truss = self.planted.trusses[fruit // self._layout.fruit]
        joint = next(one.joint for one in truss.fruit if one.row == row)
        return transform(self.motions[row], joint) if row in self.motions else joint.copy()

    def _geoms(self, fruit: Ints) -> Ints:
        waiting = self.state[fruit] == WAITING
        return np.where(waiting, self._static(self.planted.fruit.flat[fruit]), super()._geoms(fruit))

    def _static(self, rows: Sequence[int] | Ints) -> Ints:
        """Return the static geoms of shapes, by their rows."""
        first = first_world_geom(self.model) + self.planted.compiled.obstacle_geoms.start
        return np.asarray(first + np.array(rows, dtype=np.int64))

    def _gaps(self) -> Array:
        """Return the distance (trusses,) from the shoulder to the nearest fruit that is to be picked; inf without."""
        left = self.wanted & (self.state <= HANGING)
        shoulder = self.data.xpos[1] + [0.0, 0.0, self.planted.compiled.robot.shoulder_height]
        apart = self.data.geom_xpos[self._geoms(np.arange(len(left)))] - shoulder
        gaps = np.where(left, np.sqrt((apart * apart).sum(axis=1)), np.inf)
        return np.asarray(gaps.reshape(-1, self._layout.fruit).min(axis=1))

    def _may_leave(self, slot: int, in_contact: Ints) -> bool:
        """Return whether a slot is empty, or its truss hangs still, alone and with no fruit on the move."""
        ids, truss = self._ids, int(self.seated[slot])
        moving = np.append(self._loose_of, self.held) // self._layout.fruit
        return truss < 0 or (truss not in moving and self._is_idle([ids.truss[slot], *ids.fruit[slot]], in_contact))

    def _is_idle(self, bodies: Sequence[int], in_contact: Ints) -> bool:
        """Return whether bodies stand still and touch nothing."""
        model = self.model
        moving = np.abs(self.data.qvel[np.isin(model.dof_bodyid, bodies)]).max() >= IDLE_SPEED
        return not moving and not np.isin(model.geom_bodyid[in_contact], bodies).any()

    def _rows(self, truss: int) -> tuple[list[int], list[int], list[int]]:
        """Return the rows of a truss with its fruit, of their calyces, and of the stubs of fruit that came off."""
        first = truss * self._layout.fruit
        live, attached = self.planted.split(truss)
        hangs = self.state[first : first + len(live)] <= HANGING
        fruit = [*attached, *(one for one, there in zip(live, hangs, strict=True) if there)]
        solid = [*self.planted.trusses[truss].rows, *(row for one in fruit for row in (one.row, *one.pedicel))]
        stubs = [row for one, there in zip(live, hangs, strict=True) if not there for row in one.pedicel]
        return solid, [row for one in fruit for row in one.calyx], stubs

    def _swap(self, swaps: Sequence[tuple[int, int]], in_contact: Ints) -> None:
        """Give slots to other trusses, and slots of leaves to the leaves around the fruit in slots.

        Args:
            swaps: Slots and trusses.
            in_contact: Geoms in contact.
        """
        planted, ids, now = self.planted, self._ids, motions(self)
        numbers = np.arange(len(self.state)).reshape(-1, self._layout.fruit)
        states = self.state.reshape(numbers.shape)
        solid: list[int] = []
        soft: list[int] = []
        stubs: list[int] = []
        for slot, truss in swaps:
            old, self.seated[slot] = int(self.seated[slot]), truss
            if old >= 0:
                for rows, more in zip((solid, soft, stubs), self._rows(old), strict=True):
                    rows += more
                states[old, states[old] == HANGING] = WAITING
            states[truss, states[truss] == WAITING] = HANGING
        leaves = self._leaf_swaps(in_contact)
        kept = list(self.leaves)
        for k, leaf in leaves:
            soft += [*kept[k].rows, *kept[k].plates]
            kept[k] = leaf
        self.leaves = tuple(kept)
        back = [*solid, *soft, *stubs]
        self.motions = {**self.motions, **{row: now[row] for row in back if row in now}}
        filler = Filler(self.model, planted.compiled, planted.mechanics, self.motions)
        for rows, mask in ((solid, ALL), (soft, ARM | CUP), (stubs, 0)):
            filler.show(rows, mask)
        bodies = [int(body) for slot, _ in swaps for body in (ids.truss[slot], *ids.fruit[slot])]
        bodies += [int(ids.leaf[k]) for k, _ in leaves]
        empty_bodies(self.model, bodies)
        self._begin(bodies)
        for slot, truss in swaps:
            seat(filler, planted, slot, truss)
            self._bodies[numbers[truss]] = ids.fruit[slot]
            self._axes[numbers[truss]] = self._pedicel_axes(ids.fruit[slot])
            for body in ids.fruit[slot][states[truss] > HANGING].tolist():
                leave_stub(self.model, self.data, body)
        for k, leaf in leaves:
            filler.leaf(int(ids.leaf[k]), leaf)
        filler.finish(bodies, ids, self._scratch)
        build_tree(self.model)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        for geom in self._static(back).tolist():  # kinematics leave out what is static
            self.data.geom_xpos[geom] = self.model.geom_pos[geom]
            mujoco.mju_quat2Mat(self.data.geom_xmat[geom], self.model.geom_quat[geom])

    def _leaf_swaps(self, in_contact: Ints) -> list[tuple[int, Leaf]]:
        """Return slots of leaves with the leaves that they go to."""
        planted, arrays = self.planted, self.planted.compiled.scene.arrays
        rows = planted.fruit.ravel()[self.wanted & (self.state == HANGING)]
        nearest = nearest_leaves(planted.topology, arrays, arrays.starts[rows], len(self.leaves))
        fresh = [
            leaf for leaf in nearest
            if leaf not in self.leaves and not np.isin(self._static([*leaf.rows, *leaf.plates]), in_contact).any()
        ]  # fmt: skip
        free = [
            k for k, leaf in enumerate(self.leaves)
            if leaf not in nearest and self._is_idle([self._ids.leaf[k]], in_contact)
        ]  # fmt: skip
        return list(zip(free, fresh, strict=False))

    def _begin(self, bodies: Sequence[int]) -> None:
        """Bring bodies to rest in their unbent pose, undamaged; kinematics wake those that moved."""
        model, data = self.model, self.data
        dofs = np.isin(model.dof_bodyid, bodies)
        data.qvel[dofs] = data.qacc_warmstart[dofs] = 0.0
        for joint in np.flatnonzero(np.isin(model.jnt_bodyid, bodies)):
            at = int(model.jnt_qposadr[joint])
            ball = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
            data.qpos[at : at + (4 if ball else 1)] = model.qpos0[at : at + (4 if ball else 1)]
        self._damaged -= {-1 - k for k, body in enumerate(self._organs) if body in bodies}
        self._damaged -= {geom for geom in self._damaged if geom >= 0 and model.geom_bodyid[geom] in bodies}
