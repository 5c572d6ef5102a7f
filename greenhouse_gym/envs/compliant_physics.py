"""Physics of n simulations with plants that give way, fruit that comes off, a suction cup and a crate."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, Contact, Contacts
from greenhouse_gym.envs.randomization import Disturbance, displace_base
from greenhouse_gym.envs.state import ControlTiming, Ids
from greenhouse_gym.envs.world import World
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import (
    ShortGeomLists,
    compiled_geom_id,
    copy_bodies,
    first_world_geom,
    put_arm_first,
    put_world_first,
)
from greenhouse_gym.scene.plants.cutting import CutterPlants
from greenhouse_gym.scene.plants.layout import Layout
from greenhouse_gym.scene.plants.live import Felt, LivePlants
from greenhouse_gym.scene.plants.row import RowPlants
from greenhouse_gym.scene.plants.slots import Planted, plant

_FRUIT, _STEM, _LEAF, _, _SELF = range(len(CONTACT_GROUPS))
_PRESSED = (_FRUIT, _STEM)  # groups that a pressing force damages


class CompliantSimulation(NamedTuple):
    """One simulation with compliant plants.

    Attributes:
        model: Its own model.
        data: Its state.
        plants: Its plants.
        groups: (geoms,) contact group of each geom.
        listed: Context in which its steps list few geoms.
        world: Its world.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    plants: LivePlants
    groups: npt.NDArray[np.int8]
    listed: ShortGeomLists
    world: World


class CompliantPhysics:
    """Physics of n simulations with compliant plants; has the methods of `greenhouse_gym.envs.physics.Physics`.

    Args:
        count: Number of simulations n.
        world: Any world with compliant plants; all that are loaded must have its layout.
        timing: Timing of actions and physics steps.
        ends_on: Contact groups that end an episode.
        layout: Layout of the slots.
    """

    def __init__(self, count: int, world: World, timing: ControlTiming, ends_on: Collection[str], layout: Layout):
        robot, model = world.compiled.robot, world.compiled.model
        joints = len(robot.joints)
        self._timing, self._layout, self._joints = timing, layout, joints
        self._ends = np.isin(CONTACT_GROUPS, list(ends_on))
        self._sims: list[CompliantSimulation | None] = [None] * count
        self._scratch = mujoco.MjData(model)
        self._tip = world.compiled.tip_site
        self._points = np.array([world.compiled.tip_site, *world.compiled.probe_sites])
        self.qpos, self.qvel, self.command = np.zeros((3, count, joints))
        self._felt = [Felt(np.zeros(3))] * count

    def __deepcopy__(self, memo: dict[int, Any]) -> CompliantPhysics:
        """Return an independent copy in the same state."""
        twin = memo[id(self)] = copy.copy(self)
        twin._sims = [None if sim is None else _copied(sim) for sim in self._sims]
        twin.qpos, twin.qvel, twin.command = self.qpos.copy(), self.qvel.copy(), self.command.copy()
        twin._felt = list(self._felt)
        return twin

    def twin(self, i: int) -> CompliantPhysics:
        """Return an independent copy of one simulation in the same state."""
        view = copy.copy(self)
        view._sims, view._felt = [self.simulation(i)], [self._felt[i]]
        view.qpos, view.qvel, view.command = self.qpos[i : i + 1], self.qvel[i : i + 1], self.command[i : i + 1]
        return copy.deepcopy(view)

    @property
    def models(self) -> list[mujoco.MjModel]:
        """The model of each simulation, the geoms of moving bodies first."""
        return [self.simulation(i).model for i in range(len(self._sims))]

    def simulation(self, i: int) -> CompliantSimulation:
        """Return a simulation that has been loaded."""
        sim = self._sims[i]
        assert sim is not None
        return sim

    def plants(self, i: int) -> mujoco.MjData:
        """Return the state of a simulation."""
        return self.simulation(i).data

    def load(
        self, i: int, world: World, targets: Sequence[int], disturbance: Disturbance, planted: Planted | None
    ) -> None:
        """Copy a world with its plants into a simulation; takes effect with the next `place`."""
        assert planted is not None
        source, old = world.compiled.model, self._sims[i]
        if old is None:
            model = copy.copy(source)
            model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            put_arm_first(model)
            data = mujoco.MjData(model)
        else:
            model, data = old.model, old.data
            world.load(model, (), old.world)
            copy_bodies(source, model)
        plant(model, planted, self._layout, self._scratch)
        groups = np.roll(world.groups, first_world_geom(model))
        if disturbance.shift.any() or disturbance.yaw:
            displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)
        kind = CutterPlants if self._layout.cutter else RowPlants if world.compiled.robot.on_rail else LivePlants
        plants = kind(model, data, self._scratch, planted, self._layout)
        self._sims[i] = CompliantSimulation(model, data, plants, groups, ShortGeomLists([model]), world)
        self._felt[i] = Felt(np.zeros(3))

    def place(self, ids: Ids, configurations: Array) -> Contacts:
        """Place some arms at rest at configurations (len(ids), j) and return their contacts there.

        Raises:
            InvalidValueError: An arm would start in its crate.
        """
        joints = self._joints
        counts = np.zeros((len(ids), len(CONTACT_GROUPS)), dtype=np.int64)
        collided, first = np.zeros(len(ids), dtype=np.bool_), {}
        leaf_steps = np.zeros(len(ids), dtype=np.int64)
        for k, i in enumerate(ids.tolist()):
            sim = self.simulation(i)
            model, data = sim.model, sim.data
            mujoco.mj_resetData(model, data)
            data.qpos[:joints], data.act[:] = configurations[k], configurations[k]
            mujoco.mj_forward(model, data)
            _check_crate(sim)
            sim.plants.move_on()
            counts[k], contact, _ = self._contacts(sim)
            if contact is not None:
                collided[k], first[i] = True, contact
            self._read(i, sim)
        return Contacts(counts, leaf_steps, collided, first)

    def advance(self, command: Array, vacuum: npt.NDArray[np.bool_]) -> Contacts:
        """Run one action: commands move at constant speed to new ones (n, j), and the tool holds or not (n,)."""
        count = len(self._sims)
        counts = np.zeros((count, len(CONTACT_GROUPS)), dtype=np.int64)
        collided = np.zeros(count, dtype=np.bool_)
        first: dict[int, Contact] = {}
        leaf_steps = np.zeros(count, dtype=np.int64)
        for i in range(count):
            sim = self.simulation(i)
            sim.data.ctrl[:] = (command[i] - self.command[i]) / self._timing.interval
            sim.plants.grip(bool(vacuum[i]))
            for _ in range(self._timing.substeps):
                with sim.listed:
                    mujoco.mj_step(sim.model, sim.data)
                pressed: dict[int, float] = {}
                if sim.data.ncon:
                    present, contact, pressed = self._contacts(sim)
                    counts[i] += present
                    leaf_steps[i] += present[_LEAF] > 0
                    if contact is not None:
                        collided[i] = True
                        first.setdefault(i, contact)
                sim.plants.after_step(pressed)
            mujoco.mj_kinematics(sim.model, sim.data)
            mujoco.mj_comPos(sim.model, sim.data)
            self._felt[i] = sim.plants.finish_action()
            sim.plants.move_on()
            self._read(i, sim)
        return Contacts(counts, leaf_steps, collided, first)

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Return tip and probe points (m, 1 + k, 3) and tool frames (m, 3, 3) of some simulations in their scenes."""
        data = [self.simulation(i).data for i in np.arange(len(self._sims))[ids].tolist()]
        points = np.array([d.site_xpos[self._points] for d in data])
        return points, np.array([d.site_xmat[self._tip].reshape(3, 3) for d in data])

    def motion(self, heading: Array) -> ToolMotion:
        """Return the tools' motions with the joints, given (n, 2) cosine and sine of the bases' headings."""
        data, joints = [self.simulation(i).data for i in range(len(self._sims))], self._joints
        anchors = np.array([d.xanchor[:joints] for d in data])
        axes = np.array([d.xaxis[:joints] for d in data])
        return ToolMotion(anchors, axes, np.array([d.site_xpos[self._tip] for d in data]), heading)

    def felt(self, ids: Ids | slice) -> Mapping[str, Array]:
        """Return plants and gripper as in `greenhouse_gym.envs.state.State.plants`, in the scene."""
        rows = []
        for i in np.arange(len(self._sims))[ids].tolist():
            sim, felt = self.simulation(i), self._felt[i]
            plants = sim.plants
            work = plants.work(sim.data.site_xpos[self._tip])
            rows.append(
                (
                    *work, plants.holding,
                    plants.vacuum(felt.force), felt.force, plants.left, plants.wanted.sum(), *felt[1:],
                    sim.data.xpos[plants.planted.ids.crate] + [0.0, 0.0, 2 * self._layout.crate.half_extents[2]],
                )
            )  # fmt: skip
        names = (
            "work",
            "fruit",
            "radius",
            "joint",
            "hangs",
            "held",
            "vacuum",
            "force",
            "left",
            "wanted",
            *Felt._fields[1:],
            "crate",
        )
        return {
            name: np.array(column, dtype=np.float64)
            for name, column in zip(names, zip(*rows, strict=True), strict=True)
        }

    def model_and_data(
        self, i: int, targets: Sequence[int], disturbance: Disturbance
    ) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return a copy of the model of a simulation, its geoms in the compiled order, and its state."""
        sim = self.simulation(i)
        model = copy.copy(sim.model)
        put_world_first(model)
        model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        data = mujoco.MjData(model)
        for name in ("time", "qpos", "qvel", "act", "ctrl", "eq_active", "qacc_warmstart"):
            setattr(data, name, getattr(sim.data, name))
        mujoco.mj_forward(model, data)
        return model, data

    def _read(self, i: int, sim: CompliantSimulation) -> None:
        joints = self._joints
        self.qpos[i], self.qvel[i] = sim.data.qpos[:joints], sim.data.qvel[:joints]
        self.command[i] = sim.data.act

    def _contacts(self, sim: CompliantSimulation) -> tuple[npt.NDArray[np.int64], Contact | None, dict[int, float]]:
        """Return the arm's contacts by group, the deepest that ends the episode, and its forces by pressed geom."""
        model, data = sim.model, sim.data
        geoms = data.contact.geom
        groups = sim.groups[geoms]
        of_arm = np.flatnonzero((groups == _SELF).any(axis=1))
        counts, ending = np.zeros(len(CONTACT_GROUPS), dtype=np.int64), -1
        pressed: dict[int, float] = {}
        force = np.zeros(6)
        for k in of_arm.tolist():
            group = int(groups[k].min())
            counts[group] += 1
            if self._ends[group] and (ending < 0 or data.contact.dist[k] < data.contact.dist[ending]):
                ending = k
            if group in _PRESSED:
                mujoco.mj_contactForce(model, data, k, force)
                geom = int(geoms[k][groups[k].argmin()])
                pressed[geom] = pressed.get(geom, 0.0) + abs(float(force[0]))
        return counts, None if ending < 0 else _named(sim, geoms[ending]), pressed


def _named(sim: CompliantSimulation, geoms: npt.NDArray[np.integer]) -> Contact:
    """Return a contact by the names of its geoms, the arm's first."""
    arm_first = sorted(geoms.tolist(), key=lambda g: -int(sim.groups[g]))
    names = tuple(sim.world.compiled.geom_name(compiled_geom_id(sim.model, g)) for g in arm_first)
    return Contact(names, self_collision=bool((sim.groups[geoms] == _SELF).all()))


def _check_crate(sim: CompliantSimulation) -> None:
    """Check that an arm does not start in its crate."""
    ids, data = sim.plants.planted.ids, sim.data
    for k, geoms in enumerate(data.contact.geom):
        bodies = sim.model.geom_bodyid[geoms]
        if ids.crate in bodies and (sim.groups[geoms] == _SELF).any():
            names = " and ".join(_named(sim, data.contact.geom[k]).names)
            raise InvalidValueError(
                f"the crate is in the arm's way at its start ({names}): move it, as in "
                "TomatoHarvest(layout=Layout(crate=Crate(position=...))), or choose another start"
            )


def _copied(sim: CompliantSimulation) -> CompliantSimulation:
    model = copy.copy(sim.model)
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, sim.data)
    return sim._replace(model=model, data=data, plants=sim.plants.twin(model, data), listed=ShortGeomLists([model]))
