"""Plants of one running simulation: effects of the arm in an action, and the state of each fruit."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.plants.detachment import (
    bend_of,
    detach,
    first_geom,
    held_force,
    let_go,
    load_of,
    park,
    pull_on,
    settle,
    weld,
)
from greenhouse_gym.scene.plants.layout import CRATE_BOXES, Crate, Layout
from greenhouse_gym.scene.plants.mechanics import GRAVITY
from greenhouse_gym.scene.plants.slots import Planted
from greenhouse_gym.scene.plants.states import CRATED, EMPTY, HANGING, LOOSE, LOST, WAITING, Felt, InReach, Work

SEAL_GAP, SEAL_ANGLE = 0.005, 0.7
"""Maximum gap between cup and skin, metres, and angle between tool and skin normal, radians, to suck a fruit."""

REST_SPEED = 0.05
"""Speed of a fruit at rest, m/s."""

REST_ACTIONS = 4
"""Number of actions in a row after which a slow fruit lies still: at the top of a bounce it is slow as well."""

FLOOR_HEIGHT = 0.02
"""Gap to the floor below which a fruit has been dropped, metres."""


class LivePlants:
    """Plants of one simulation, whose arm has a suction cup.

    Args:
        model: The simulation's own model.
        data: Its state.
        scratch: Further data of a model of this layout.
        planted: Organs in the slots.
        layout: The layout.

    Attributes:
        state: (fruit,) state of each fruit that can come off, truss by truss.
        wanted: (fruit,) whether each is to be picked.
        total: Number of fruit to be picked.
        held: Index of the fruit in the cup, or -1.
        seated: (slots,) truss in each slot, or -1.
        leaves: Leaf in each slot.
        motions: (4, 4) motions since the scan of shapes that did not hang as scanned when they became static or came
            into their slots, by their rows.
        cut: (trusses,) whether a truss was cut off.
    """

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, scratch: mujoco.MjData, planted: Planted, layout: Layout
    ):
        self.model, self.data, self._scratch = model, data, scratch
        self.planted, self._layout, self._ids = planted, layout, planted.ids
        in_slot = np.arange(len(planted.fruit)) < layout.trusses
        self.state = np.where(planted.fruit >= 0, np.where(in_slot[:, None], HANGING, WAITING), EMPTY).ravel()
        self.wanted = planted.wanted.ravel()
        self.total = int(np.count_nonzero(self.wanted))
        self.held = -1
        self.seated = np.where(np.arange(layout.trusses) < len(planted.trusses), np.arange(layout.trusses), -1)
        self.leaves = planted.leaves
        self.motions: Mapping[int, Array] = {}
        self._bodies = np.resize(planted.ids.fruit, len(self.state))  # valid for fruit in slots only
        self._loose_of = np.full(layout.loose, -1)
        self._last_in_reach: InReach | None = None
        self._by_cup = np.zeros(len(self.state), dtype=np.bool_)
        self._settled = 0
        self._still = np.zeros(layout.loose, dtype=np.int64)
        self.cut = np.zeros(len(planted.fruit), dtype=np.bool_)
        self._truss_still = np.zeros(layout.trusses, dtype=np.int64)
        self._damaged: set[int] = set()
        self._press: dict[int, float] = {}
        self._pull, self._force = np.zeros(len(self.state)), np.zeros(3)
        self._axes = self._pedicel_axes(self._bodies)
        self._organs = [*planted.ids.truss, *planted.ids.leaf]
        self._hinges = np.array([model.jnt_qposadr[model.body_jntadr[body]] for body in self._organs])
        limits = [planted.mechanics.truss_bend_limit] * len(planted.ids.truss)
        self._limits = np.array(limits + [planted.mechanics.leaf_bend_limit] * len(planted.ids.leaf))

    def twin(self, model: mujoco.MjModel, data: mujoco.MjData) -> LivePlants:
        """Return a copy for a copied model and state."""
        other = copy.copy(self)
        other.model, other.data = model, data
        for name in (
            "state", "cut", "seated", "_loose_of", "_by_cup", "_damaged", "_press", "_pull", "_force", "_still",
            "_truss_still", "_bodies", "_axes", "_limits",
        ):  # fmt: skip
            setattr(other, name, copy.copy(getattr(self, name)))
        return other

    @property
    def holding(self) -> bool:
        """True if the tool holds something."""
        return self.held >= 0

    @property
    def at_rest(self) -> bool:
        """True if the tool holds nothing and nothing that came off is on the move."""
        return not self.holding and bool(self._loose_of.max(initial=-1) < 0)

    @property
    def hold_limit(self) -> float:
        """Force at which the tool lets go, N."""
        return self.planted.mechanics.cup_limit

    def grip(self, on: bool) -> None:
        """Switch the tool on, which holds what is at it if there is something, or off, which lets go."""
        if on and not self.holding:
            self._catch()
        elif not on and self.holding:
            self._release()

    def after_step(self, pressed: dict[int, float]) -> None:
        """Record the effects of a physics step.

        Args:
            pressed: Forces of the arm on other things, N, by geom.
        """
        for geom, force in pressed.items():
            self._press[geom] = self._press.get(geom, 0.0) + force
        if self.data.ntree_awake > 1:
            mujoco.mj_rnePostConstraint(self.model, self.data)
            self._pull += pull_on(self.model, self.data, self._bodies)
        if self.holding:
            self._force += held_force(self.data, self._ids)

    def finish_action(self, steps: int) -> Felt:
        """Find the fruit that came off or came to rest and the organs damaged, with current kinematics.

        Args:
            steps: Number of physics steps of the action.
        """
        force = self._force / steps
        detached, knocked = self._part(self._pull / steps)
        if self.holding and np.linalg.norm(force) > self.hold_limit:
            self._release()
        crated, dropped = self._follow_loose()
        damaged = self._damage(steps)
        self._pull[:], self._press = 0.0, {}
        self._force = np.zeros(3)
        return Felt(force, detached, knocked, crated, dropped, damaged)

    def vacuum(self, force: Array) -> float:
        """Return the reading of the vacuum: 1 at rest on a fruit, down to 0 at the tool's limit; 0 without one."""
        return max(0.0, 1.0 - float(np.linalg.norm(force)) / self.hold_limit) if self.holding else 0.0

    @property
    def crate(self) -> Crate:
        """Crate of the layout."""
        return self._layout.crate

    @property
    def left(self) -> int:
        """Number of fruit to be picked that are neither in the crate nor lost."""
        return self._in_reach().left

    def body_of(self, fruit: int) -> int:
        """Return the body of a fruit that is not at rest."""
        loose = np.flatnonzero(self._loose_of == fruit)
        return int(self._ids.loose[loose[0]]) if len(loose) else int(self._bodies[fruit])

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit that is not at rest, metres."""
        if self.state[fruit] <= HANGING:
            return self.data.geom_xpos[int(self._geoms(np.array(fruit)))].copy()
        return self.data.geom_xpos[first_geom(self.model, self.body_of(fruit))].copy()

    def joint_of(self, fruit: int) -> Array:
        """Return the start (3,) of the pedicel of a fruit on its rachis, metres."""
        return self.data.xpos[self._bodies[fruit]].copy()

    def radius(self, fruit: int) -> float:
        """Return the radius of the sphere of the same volume as a fruit, metres."""
        return self._radius_of(int(self._geoms(np.array(fruit))))

    def _radius_of(self, geom: int) -> float:
        size = self.model.geom_size[geom]
        ellipsoid = self.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_ELLIPSOID
        return float(np.cbrt(size.prod()) if ellipsoid else size[0])

    def weight(self, fruit: int) -> Array:
        """Return the weight (3,) of a fruit that is not at rest, N."""
        return np.array([0.0, 0.0, -GRAVITY * self.model.body_mass[self.body_of(fruit)]])

    def work(self, tip: Array) -> Work:
        """Return the held fruit, or the fruit to be picked that hangs nearest to the tip (3,)."""
        fruit = self.held
        if fruit >= 0:
            hangs = bool(self.state[fruit] <= HANGING)
            return Work(fruit, self.center(fruit), self.radius(fruit), self.joint_of(fruit), hangs)
        known = self._in_reach()
        if not len(known.wanted):
            return Work(-1, tip, 0.0, tip, False)
        centers = self.data.geom_xpos[known.geoms]
        offsets = centers - tip
        nearest = int((offsets * offsets).sum(axis=1).argmin())
        fruit = int(known.wanted[nearest])
        return Work(fruit, centers[nearest], known.radii[nearest], self.joint_of(fruit), True)

    def _in_reach(self) -> InReach:
        """Return the fruit that the tool may go to; they are looked up again when one changes its state or body."""
        known, key = self._last_in_reach, (self.state.tobytes(), self._bodies.tobytes())
        if known is None or known.key != key:
            wanted = np.flatnonzero(self.wanted & (self.state <= HANGING))
            geoms, bodies = self._geoms(wanted), self._bodies.copy()
            slots = np.flatnonzero(self._loose_of >= 0)
            bodies[self._loose_of[slots]] = self._ids.loose[slots]
            loose = np.flatnonzero((self.state == HANGING) | (self.state == LOOSE))
            loose_geoms = self.model.body_geomadr[bodies[loose]]
            known = self._last_in_reach = InReach(
                key, int(np.count_nonzero(self.wanted & (self.state <= LOOSE))), wanted, geoms,
                [self._radius_of(geom) for geom in geoms.tolist()],
                loose, loose_geoms, self.model.geom_rbound[loose_geoms] + SEAL_GAP,
            )  # fmt: skip
        return known

    def move_on(self) -> bool:
        """Give slots to other organs, which only plants along a row do; return True if any did."""
        return False

    def _geoms(self, fruit: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
        """Return the geoms of fruit (n,) that hang."""
        return np.asarray(self.model.body_geomadr[self._bodies[fruit]])

    def _catch(self) -> None:
        """Hold the nearest fruit that the cup can seal on."""
        model, data, known = self.model, self.data, self._in_reach()
        apart = data.geom_xpos[known.loose_geoms] - data.site_xpos[self._ids.tip]
        distances = np.sqrt((apart * apart).sum(axis=1))
        near = distances <= known.reaches
        if not near.any():
            return
        near &= apart @ data.site_xmat[self._ids.tip, 2::3] >= np.cos(SEAL_ANGLE) * distances
        best, found = SEAL_GAP, -1
        for fruit, geom in zip(known.loose[near].tolist(), known.loose_geoms[near].tolist(), strict=True):
            gap = mujoco.mj_geomDistance(model, data, self._cup_geom, geom, 2 * SEAL_GAP, None)
            if gap < best:
                best, found = gap, fruit
        if found >= 0:
            self.held = found
            weld(model, data, self._ids, self.body_of(found))

    @property
    def _cup_geom(self) -> int:
        """Geom at the tip, in the order of this model."""
        world = int(self.model.body_geomnum[0])
        return (self._ids.cup_geom - world) % self.model.ngeom if self.model.body_geomadr[0] else self._ids.cup_geom

    def _pedicel_axes(self, bodies: npt.NDArray[np.int64]) -> Array:
        """Return unit vectors (n, 3) along the unbent pedicels of fruit in bodies (n,)."""
        axes = self.model.geom_pos[self.model.body_geomadr[bodies]]
        norms = np.linalg.norm(axes, axis=1, keepdims=True)
        return np.where(norms > 0, axes / np.maximum(norms, 1e-9), [0.0, 0.0, -1.0])

    def _release(self) -> None:
        let_go(self.model, self.data, self._ids)
        self.held = -1

    def _part(self, pull: Array) -> tuple[int, int]:
        """Take off the fruit whose pedicels part; return how many the cup held, and how many it did not."""
        bend = bend_of(self.model, self.data, self._bodies, self._axes)
        parting = (load_of(pull, bend, self.planted.mechanics) >= 1) & (self.state == HANGING)
        detached = knocked = 0
        for fruit in np.flatnonzero(parting).tolist():
            free = np.flatnonzero(self._loose_of < 0)
            if not len(free):
                break  # it comes off when another one has come to rest
            slot = int(free[0])
            detach(
                self.model, self.data, self._scratch, int(self._bodies[fruit]), int(self._ids.loose[slot]),
                self.planted.mechanics.density,
            )  # fmt: skip
            self._loose_of[slot], self.state[fruit] = fruit, LOOSE
            if fruit == self.held:
                weld(self.model, self.data, self._ids, int(self._ids.loose[slot]))
                self._by_cup[fruit] = True
                detached += int(self.wanted[fruit])
            else:
                knocked += 1
        return detached, knocked

    def _follow_loose(self) -> tuple[int, int]:
        """Park the fruit that have come to rest; return how many lie in the crate, and how many the arm dropped."""
        model, data = self.model, self.data
        crated = dropped = 0
        for slot, fruit in enumerate(self._loose_of.tolist()):
            if fruit < 0 or fruit == self.held:
                continue
            body = int(self._ids.loose[slot])
            dof = int(model.jnt_dofadr[model.body_jntadr[body]])
            geom = first_geom(model, body)
            slow = float(np.linalg.norm(data.qvel[dof : dof + 3])) < REST_SPEED
            self._still[slot] = self._still[slot] + 1 if slow else 0
            still = self._still[slot] >= REST_ACTIONS
            fallen = data.geom_xpos[geom, 2] - model.geom_size[geom].max() < FLOOR_HEIGHT
            inside = self._in_crate(data.geom_xpos[geom])
            if self.state[fruit] == LOOSE and ((still and not inside) or fallen):
                self.state[fruit] = LOST
                dropped += int(self._by_cup[fruit])
            if still and inside and self.state[fruit] == LOOSE:
                self.state[fruit] = CRATED
                crated += int(self.wanted[fruit])
            if still or data.geom_xpos[geom, 2] < -1:
                if self._settled < model.body_geomnum[self._ids.crate] - CRATE_BOXES and still:
                    settle(model, data, body, self._ids.crate, CRATE_BOXES + self._settled)
                    self._settled += 1
                else:
                    park(model, data, body)
                self._loose_of[slot], self._still[slot] = -1, 0
        return crated, dropped

    def above_crate(self, local: Array) -> Array:
        """Return a point (3,) in the scene that is given from the middle of the crate's bottom, metres."""
        crate = self._ids.crate
        return np.asarray(self.data.xpos[crate] + self.data.xmat[crate].reshape(3, 3) @ local)

    def _in_crate(self, point: Array) -> bool:
        crate, half = self._ids.crate, np.array(self._layout.crate.half_extents)
        local = self.data.xmat[crate].reshape(3, 3).T @ (point - self.data.xpos[crate])
        return bool((np.abs(local[:2]) < half[:2]).all() and 0 < local[2] < 2 * half[2] + 0.03)

    def _damage(self, steps: int) -> int:
        """Return the number of organs that are damaged for the first time: bent or pressed too far."""
        hinges = self.data.qpos[self._hinges[:, None] + [0, 1]]
        bent = {-1 - int(k) for k in np.flatnonzero(np.sqrt((hinges * hinges).sum(axis=1)) > self._limits)}
        limit = self.planted.mechanics.press_limit * steps
        pressed = {geom for geom, force in self._press.items() if force > limit}
        fresh = (bent | pressed) - self._damaged
        self._damaged |= fresh
        return len(fresh)
