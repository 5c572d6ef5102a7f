"""Physics of n simulations with plants that give way, fruit that comes off, a suction cup and a crate."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.compliant_simulation import NO_CONTACTS, ArmContacts, CompliantSimulation
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, Contacts
from greenhouse_gym.envs.randomization import Disturbance, displace_base
from greenhouse_gym.envs.state import Bools, ControlTiming, Ids
from greenhouse_gym.envs.world import World
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import (
    ShortGeomLists,
    copy_bodies,
    first_world_geom,
    put_arm_first,
    put_world_first,
)
from greenhouse_gym.scene.plants.cutting import CutterPlants
from greenhouse_gym.scene.plants.layout import Layout
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.out_of_reach import Organs, hide_out_of_reach
from greenhouse_gym.scene.plants.row import RowPlants
from greenhouse_gym.scene.plants.slots import Planted, plant
from greenhouse_gym.scene.plants.states import Felt
from greenhouse_gym.scene.world_tree import copy_whole_tree

_NOTHING_FELT = Felt(np.zeros(3))


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
        self._felt = [_NOTHING_FELT] * count

    def __deepcopy__(self, memo: dict[int, Any]) -> CompliantPhysics:
        """Return an independent copy in the same state."""
        twin = memo[id(self)] = copy.copy(self)
        twin._sims = [None if sim is None else sim.copied() for sim in self._sims]
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
        return [sim.model for sim in self._loaded]

    def simulation(self, i: int) -> CompliantSimulation:
        """Return a simulation that has been loaded."""
        sim = self._sims[i]
        assert sim is not None
        return sim

    @property
    def _loaded(self) -> list[CompliantSimulation]:
        """All simulations."""
        return [self.simulation(i) for i in range(len(self._sims))]

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
            world.tree.load(model)
            data = mujoco.MjData(model)
        else:
            model, data = old.model, old.data
            copy_bodies(source, model)
            world.load(model, old.world)
        plant(model, planted, self._layout, self._scratch)
        groups = np.roll(world.groups, first_world_geom(model))
        if disturbance.shift.any() or disturbance.yaw:
            displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)
        kind = CutterPlants if self._layout.cutter else RowPlants if world.compiled.robot.on_rail else LivePlants
        plants = kind(model, data, self._scratch, planted, self._layout)
        organs = Organs(model, data, planted.ids, self._joints)
        self._sims[i] = CompliantSimulation(model, data, plants, groups, ShortGeomLists([model]), organs, world)
        self._felt[i] = _NOTHING_FELT

    def place(self, ids: Ids, configurations: Array) -> Contacts:
        """Place some arms at rest at configurations (len(ids), j) and return their contacts there.

        Raises:
            InvalidValueError: An arm would start in its crate.
        """
        joints, found = self._joints, []
        for i, configuration in zip(ids.tolist(), configurations, strict=True):
            sim = self.simulation(i)
            model, data = sim.model, sim.data
            mujoco.mj_resetData(model, data)
            data.qpos[:joints], data.act[:] = configuration, configuration
            mujoco.mj_forward(model, data)
            sim.check_crate()
            sim.plants.move_on()
            sim.organs.refresh()
            found.append(sim.arm_contacts(self._ends)._replace(leaf_steps=0))
            self._read(i, sim)
        return _contacts(ids, found)

    def advance(self, command: Array, vacuum: Bools) -> Contacts:
        """Run one action: commands move at constant speed to new ones (n, j), and the tool holds or not (n,)."""
        speed, sims, found = (command - self.command) / self._timing.interval, self._loaded, []
        for sim, on in zip(sims, vacuum.tolist(), strict=True):
            sim.plants.grip(on)
        resting = np.array([sim.at_rest for sim in sims])
        hide_out_of_reach([sim.organs for sim in sims if sim.at_rest], (command - self.qpos)[resting])
        for i, sim in enumerate(sims):
            sim.data.ctrl[:] = speed[i]
            contacts = sim.run(self._timing.substeps, self._ends)
            changed = contacts is not None or not resting[i]
            self._felt[i] = sim.plants.finish_action(self._timing.substeps) if changed else _NOTHING_FELT
            if sim.plants.move_on() or changed:
                sim.organs.refresh()
            self._read(i, sim)
            found.append(contacts or NO_CONTACTS)
        return _contacts(np.arange(len(sims)), found)

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Return tip and probe points (m, 1 + k, 3) and tool frames (m, 3, 3) of some simulations in their scenes."""
        data = [self.simulation(i).data for i in np.arange(len(self._sims))[ids].tolist()]
        points = np.array([d.site_xpos[self._points] for d in data])
        return points, np.array([d.site_xmat[self._tip].reshape(3, 3) for d in data])

    def motion(self, heading: Array) -> ToolMotion:
        """Return the tools' motions with the joints, given (n, 2) cosine and sine of the bases' headings."""
        data, joints = [sim.data for sim in self._loaded], self._joints
        anchors = np.array([d.xanchor[:joints] for d in data])
        axes = np.array([d.xaxis[:joints] for d in data])
        return ToolMotion(anchors, axes, np.array([d.site_xpos[self._tip] for d in data]), heading)

    def felt(self, ids: Ids | slice) -> Mapping[str, Array]:
        """Return plants and gripper as in `greenhouse_gym.envs.state.State.plants`, in the scene."""
        rows, rim = [], np.array([0.0, 0.0, 2 * self._layout.crate.half_extents[2]])
        for i in np.arange(len(self._sims))[ids].tolist():
            sim, felt = self.simulation(i), self._felt[i]
            plants = sim.plants
            work = plants.work(sim.data.site_xpos[self._tip])
            rows.append(
                (
                    *work, plants.holding, plants.vacuum(felt.force), felt.force, plants.left, plants.total, *felt[1:],
                    sim.data.xpos[plants.planted.ids.crate] + rim,
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
        copy_whole_tree(sim.world.compiled.model, model)
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


def _contacts(ids: Ids, found: Sequence[ArmContacts]) -> Contacts:
    """Return the contacts of some simulations."""
    first = {i: one.ending for i, one in zip(ids.tolist(), found, strict=True) if one.ending is not None}
    collided = np.array([one.ending is not None for one in found])
    leaf_steps = np.array([one.leaf_steps for one in found], dtype=np.int64)
    return Contacts(np.array([one.counts for one in found]), leaf_steps, collided, first)
