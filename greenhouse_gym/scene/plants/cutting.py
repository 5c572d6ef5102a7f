"""Cutter for trusses: a second tool, which cuts a peduncle and holds the whole truss by its stub."""

from __future__ import annotations

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.obstacle_slots import build_tree
from greenhouse_gym.scene.plants.detachment import first_geom, hold, leave_stub, move_free, update_constants
from greenhouse_gym.scene.plants.layout import ALL, CUP, LOOSE
from greenhouse_gym.scene.plants.live import FLOOR_HEIGHT, REST_ACTIONS, REST_SPEED, LivePlants
from greenhouse_gym.scene.plants.states import CRATED, HANGING, LOST, Work

CUT_GAP = 0.006
"""Maximum gap between the tool and a peduncle that it cuts, metres."""

_BODY = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_sameframe")
_GEOM = (
    "geom_type", "geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound", "geom_sameframe", "geom_rgba",
    "geom_conaffinity",
)  # fmt: skip


class CutterPlants(LivePlants):
    """Plants of one simulation whose arm has a cutter instead of a suction cup.

    A cut truss becomes a free body, with its fruit on their pedicels. The tool holds it by the peduncle until it opens.

    Attributes:
        held_truss: Slot of the truss in the tool, or -1.
    """

    held_truss = -1
    _cut_fruit = 0

    @property
    def holding(self) -> bool:
        """True if the tool holds a truss."""
        return self.held_truss >= 0

    @property
    def at_rest(self) -> bool:
        """True if the tool has not cut anything yet, and nothing that came off is on the move."""
        return super().at_rest and not self.cut.any()

    @property
    def hold_limit(self) -> float:
        """Force at which the tool lets go, N."""
        return self.planted.mechanics.grip_limit

    def truss_of(self, fruit: int) -> int:
        """Return the slot of the truss of a fruit."""
        return fruit // self._layout.fruit

    def on_truss(self, truss: int) -> list[int]:
        """Return the fruit in the slots of a truss that hang on it, cut or not."""
        slots = np.arange(len(self.state)) // self._layout.fruit == truss
        hanging: list[int] = np.flatnonzero(slots & (self.state == HANGING)).tolist()
        return hanging

    def cut_point(self, truss: int) -> Array:
        """Return the middle (3,) of the peduncle's first piece, metres: where the tool cuts and holds."""
        return self.data.geom_xpos[self._peduncle(truss)].copy()

    def work(self, tip: Array) -> Work:
        """Return the held truss, or that with fruit to be picked whose peduncle is nearest to the tip."""
        if self.holding:
            body = int(self._ids.cut[self.held_truss])
            return Work(
                self.held_truss, self.data.subtree_com[body].copy(), 0.0, self.cut_point(self.held_truss), False
            )
        trusses = [k for k in self._uncut() if self.wanted[self.on_truss(k)].any()]
        if not trusses:
            return Work(-1, tip, 0.0, tip, False)
        points = np.array([self.cut_point(k) for k in trusses])
        near = int(np.linalg.norm(points - tip, axis=1).argmin())
        radius = float(self.model.geom_size[self._peduncle(trusses[near]), 0])
        return Work(trusses[near], points[near], radius, points[near], True)

    def _uncut(self) -> list[int]:
        return [k for k in range(len(self.planted.trusses)) if not self.cut[k]]

    def _peduncle(self, truss: int) -> int:
        """Return the geom of the first piece of a peduncle."""
        body = self._ids.cut[truss] if self.cut[truss] else self._ids.truss[truss]
        return first_geom(self.model, int(body))

    def _catch(self) -> None:
        """Cut the nearest peduncle within reach of the tool, and hold its truss."""
        best, found = CUT_GAP, -1
        for truss in self._uncut():
            gap = mujoco.mj_geomDistance(
                self.model, self.data, self._cup_geom, self._peduncle(truss), 2 * CUT_GAP, None
            )
            if gap < best:
                best, found = gap, truss
        if found < 0:
            return
        fruit = self.on_truss(found)
        slots = self.planted.ids.fruit[found]
        swap_truss(
            self.model, self.data, self._scratch, int(self._ids.truss[found]), slots, int(self._ids.cut[found]),
            self._ids.cut_fruit[found],
        )  # fmt: skip
        first = found * self._layout.fruit
        self._bodies[first : first + self._layout.fruit] = self._ids.cut_fruit[found]
        self.cut[found], self._limits[found] = True, np.inf
        self.held_truss, self._cut_fruit = found, int(self.wanted[fruit].sum())
        self._by_cup[fruit] = self.wanted[fruit]
        hold(self.model, self.data, self._ids, int(self._ids.cut[found]), self._peduncle(found))

    def _release(self) -> None:
        self.data.eq_active[self._ids.weld] = 0
        self.held_truss = -1

    def _part(self, pull: Array) -> tuple[int, int]:
        on_cut = np.repeat(self.cut, self._layout.fruit) & (self.state == HANGING)
        _, off = super()._part(pull)
        detached, self._cut_fruit = self._cut_fruit, 0
        return detached, off - int(np.count_nonzero(on_cut & (self.state != HANGING)))

    def _follow_loose(self) -> tuple[int, int]:
        """Count the fruit of trusses that came to rest as well; they stay bodies, which sleep."""
        crated, dropped = super()._follow_loose()
        model, data = self.model, self.data
        for truss in np.flatnonzero(self.cut).tolist():
            fruit = self.on_truss(truss)
            if truss == self.held_truss or not fruit:
                continue
            dof = int(model.jnt_dofadr[model.body_jntadr[self._ids.cut[truss]]])
            slow = float(np.linalg.norm(data.qvel[dof : dof + 3])) < REST_SPEED
            self._truss_still[truss] = self._truss_still[truss] + 1 if slow else 0
            centers = np.array([self.center(k) for k in fruit])
            fallen = (centers[:, 2].min() - self.radius(fruit[0])) < FLOOR_HEIGHT
            if self._truss_still[truss] < REST_ACTIONS and not fallen:
                continue
            for k, center in zip(fruit, centers, strict=True):
                inside = not fallen and self._in_crate(center)
                self.state[k] = CRATED if inside else LOST
                crated += int(inside and self.wanted[k])
                dropped += int(not inside and self.wanted[k])
        return crated, dropped


def swap_truss(
    model: mujoco.MjModel, data: mujoco.MjData, scratch: mujoco.MjData, truss: int, fruit: Array, cut: int, own: Array
) -> None:
    """Swap a truss for a free one with the same shapes, masses, pose and velocity; nothing stays on the main stem.

    Args:
        model: The model.
        data: Its state, with current kinematics.
        scratch: Any data of the model, to compute its constants with.
        truss: Body of the truss.
        fruit: (fruit,) bodies of its fruit.
        cut: Free body that is parked.
        own: (fruit,) bodies of its fruit.
    """
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, truss, velocity, 0)
    move_free(model, data, cut, data.xpos[truss], data.xquat[truss], velocity)
    for old, new in zip((truss, *fruit), (cut, *own), strict=True):
        _copy_body(model, int(old), int(new), solid=int(model.body_geomnum[old]) if old == truss else 1)
        if old != truss:
            _copy_ball(model, data, int(old), int(new))
        leave_stub(model, data, int(old))
        first = first_geom(model, int(old))
        model.geom_rgba[first : first + int(model.body_geomnum[old]), 3] = 0.0
    model.body_pos[own] = model.body_pos[fruit]
    mujoco.mj_kinematics(model, data)
    update_constants(model, scratch)


def _copy_body(model: mujoco.MjModel, old: int, new: int, solid: int) -> None:
    """Give a parked body the shapes and mass of another one; the first ones stop at what stands and lies around."""
    for name in _BODY:
        getattr(model, name)[new] = getattr(model, name)[old]
    model.body_gravcomp[new] = 0.0
    first, source, count = first_geom(model, new), first_geom(model, old), int(model.body_geomnum[old])
    for name in _GEOM:
        getattr(model, name)[first : first + count] = getattr(model, name)[source : source + count]
    geoms = np.arange(first, first + count)
    stops = (model.geom_conaffinity[geoms] > 0) & (np.arange(count) < solid)  # pedicels do not
    model.geom_contype[geoms] = np.where(stops, LOOSE, 0)
    model.geom_conaffinity[geoms] = np.where(stops, ALL & ~CUP, 0)
    build_tree(model, new)


def _copy_ball(model: mujoco.MjModel, data: mujoco.MjData, old: int, new: int) -> None:
    """Give the pedicel of a fruit spring, damping and state of another one."""
    source, joint = int(model.body_jntadr[old]), int(model.body_jntadr[new])
    model.jnt_stiffness[joint] = model.jnt_stiffness[source]
    at, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    q, v = int(model.jnt_qposadr[source]), int(model.jnt_dofadr[source])
    model.qpos_spring[at : at + 4] = model.qpos_spring[q : q + 4]
    model.dof_damping[dof : dof + 3] = model.dof_damping[v : v + 3]
    data.qpos[at : at + 4], data.qvel[dof : dof + 3] = data.qpos[q : q + 4], data.qvel[v : v + 3]
