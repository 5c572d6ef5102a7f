"""Physics of n simulations: private models, stepping, and contacts."""

from __future__ import annotations

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.contacts import CONTACT_GROUPS, LEAF, Contact, Contacts, contact_groups
from greenhouse_gym.envs.randomization import Disturbance, displace_base
from greenhouse_gym.envs.state import Bools, ControlTiming, Ids
from greenhouse_gym.envs.stepping import ManyStepper, OneStepper, Start, Stepper
from greenhouse_gym.envs.world import World
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.scene.geom_order import compiled_geom_id, put_arm_first
from greenhouse_gym.scene.plants.slots import Planted

_SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)


class AnyPhysics(Protocol):
    """Physics of n simulations, with rigid plants (`Physics`) or compliant ones.

    Attributes:
        models: The model of each simulation.
        qpos: (n, j) joint positions, radians.
        qvel: (n, j) joint velocities, rad/s.
        command: (n, j) commanded joint positions, radians.
    """

    @property
    def models(self) -> list[mujoco.MjModel]: ...  # noqa: D102
    @property
    def qpos(self) -> Array: ...  # noqa: D102
    @property
    def qvel(self) -> Array: ...  # noqa: D102
    @property
    def command(self) -> Array: ...  # noqa: D102

    def load(
        self, i: int, world: World, targets: Sequence[int], disturbance: Disturbance, planted: Planted | None
    ) -> None:
        """Copy a world into the model of a simulation."""

    def place(self, ids: Ids, configurations: Array) -> Contacts:
        """Place some arms at rest and return their contacts there."""

    def advance(self, command: Array, vacuum: Bools) -> Contacts:
        """Run one action."""

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Return tip and probe points and tool frames of some simulations."""

    def motion(self, heading: Array) -> ToolMotion:
        """Return the tools' motions with the joints."""

    def felt(self, ids: Ids | slice) -> Mapping[str, Array]:
        """Return the state of compliant plants, see `greenhouse_gym.envs.state.PLANTS`."""

    def plants(self, i: int) -> mujoco.MjData | None:
        """Return the state of a simulation with plants that move; None if they are rigid."""

    def model_and_data(
        self, i: int, targets: Sequence[int], disturbance: Disturbance
    ) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return copies of the model and the state of a simulation."""


class Physics:
    """Batch of n simulations, each with a private padded model into which a reset copies the scene of the episode.

    Args:
        count: Number of simulations n.
        world: Any world; all worlds that are loaded must compile to the same sizes.
        threads: Number of simulation threads; 0 uses all cores.
        timing: Timing of actions and physics steps.
        ends_on: Contact groups that end an episode.

    Attributes:
        models: The model of each simulation, the arm's geoms first. MuJoCo's sleep flag makes them compute the poses of
            static bodies only when their data are reset, which saves a third of the time; the arm never sleeps.
        brushed: The leaves that each arm has touched at the end of an action of its episode, as indices into the leaves
            of the simulated scene; empty if leaves are rigid.
    """

    def __init__(self, count: int, world: World, threads: int, timing: ControlTiming, ends_on: Collection[str]):
        compiled = world.compiled
        model = copy.copy(compiled.model)
        model.opt.enableflags |= _SLEEP
        put_arm_first(model)
        self.models = [model, *(copy.copy(model) for _ in range(count - 1))]
        self._timing = timing
        self._leaves_push = world.leaves == "rigid"
        self._ends = np.isin(CONTACT_GROUPS, list(ends_on))
        self._worlds = [world] * count
        self._stepper: Stepper = (
            OneStepper(self.models[0], timing.substeps)
            if count == 1
            else ManyStepper(self.models, threads, timing.substeps)
        )
        self._data = mujoco.MjData(compiled.model)
        self._ids, self._no_counts = np.arange(count), np.zeros((count, len(CONTACT_GROUPS)), dtype=np.int64)
        self.brushed: list[set[int]] = [set() for _ in range(count)]
        self._leaf_contacts: list[LeafContacts] = [world.leaf_contacts] * (0 if self._leaves_push else count)
        self._tip = compiled.tip_site
        self._points = np.array([compiled.tip_site, *compiled.probe_sites])

    @property
    def qpos(self) -> Array:
        """(n, j) joint positions, radians, live."""
        return self._stepper.qpos

    @property
    def qvel(self) -> Array:
        """(n, j) joint velocities, rad/s, live."""
        return self._stepper.qvel

    @property
    def command(self) -> Array:
        """(n, j) commanded joint positions, radians, live."""
        return self._stepper.command

    def load(
        self, i: int, world: World, targets: Sequence[int], disturbance: Disturbance, planted: Planted | None = None
    ) -> None:
        """Copy a world, in which nothing is planted, into a simulation; takes effect with the next `place`."""
        model = self.models[i]
        world.load(model, self._worlds[i])
        _begin(model, world, targets, disturbance)
        self._worlds[i] = world
        self._stepper.load(i, world.tree.reach, world.used)
        if not self._leaves_push:
            self.brushed[i], self._leaf_contacts[i] = set(), _leaf_contacts(world, disturbance)

    def place(self, ids: Ids, configurations: Array) -> Contacts:
        """Place some arms at rest at configurations (len(ids), j) and return their contacts there."""
        touching = self._stepper.place(ids, configurations)
        rest = np.zeros(configurations.shape)
        return self._contacts(ids, touching, Start(configurations, rest, rest, configurations), 0)

    def advance(self, command: Array, vacuum: Bools) -> Contacts:
        """Run one action, during which the servos' commands move at constant speed to the new ones (n, j).

        The vacuum holds nothing: no fruit comes off rigid plants.
        """
        stepper = self._stepper
        stepper.speed[:] = (command - stepper.command) / self._timing.interval
        touching = stepper.run()
        start = stepper.start
        if self._leaves_push or not touching.any():
            return self._contacts(self._ids, touching, start, self._timing.substeps)
        # only leaves were touched where nothing pushed, so that these actions need no repetition
        pushed, found = stepper.pushed(), stepper.found()
        contacts = self._contacts(self._ids, pushed, start, self._timing.substeps)
        counts, leaf_steps = contacts.counts.copy(), contacts.leaf_steps.copy()
        counts[~pushed, LEAF], leaf_steps[~pushed] = found[~pushed].sum(axis=1), (found[~pushed] > 0).sum(axis=1)
        for i in np.flatnonzero(found[:, -1]).tolist():
            self.brushed[i].update(self._leaf_contacts[i].at(stepper.qpos[i : i + 1]).tolist())
        return contacts._replace(counts=counts, leaf_steps=leaf_steps)

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Return tip and probe points (m, 1 + k, 3) and tool frames (m, 3, 3) of some simulations in their scenes."""
        frames = self._stepper.site_xmat[ids, self._tip].reshape(-1, 3, 3)
        return self._stepper.site_xpos[ids][:, self._points], frames

    def motion(self, heading: Array) -> ToolMotion:
        """Return the tools' motions with the joints, given (n, 2) cosine and sine of the bases' headings."""
        stepper = self._stepper
        return ToolMotion(stepper.xanchor, stepper.xaxis, stepper.site_xpos[:, self._tip], heading)

    def felt(self, ids: Ids | slice) -> Mapping[str, Array]:
        """Return no numbers, since rigid plants have no state."""
        return {}

    def plants(self, i: int) -> None:
        """Return no state: rigid plants do not move."""

    def model_and_data(
        self, i: int, targets: Sequence[int], disturbance: Disturbance
    ) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """Return a copy of the compiled model of a simulation, prepared for an episode, and its state."""
        world, stepper = self._worlds[i], self._stepper
        model = copy.copy(world.compiled.model)
        _begin(model, world, targets, disturbance)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.act[:] = stepper.qpos[i], stepper.qvel[i], stepper.command[i]
        mujoco.mj_forward(model, data)
        return model, data

    def _contacts(self, ids: Ids, touching: Bools, start: Start, substeps: int) -> Contacts:
        """Classify the contacts of the few simulations that have any by repeating their action."""
        if not touching.any():
            return Contacts(self._no_counts[: len(ids)], self._no_counts[: len(ids), LEAF], touching, {})
        counts = np.zeros((len(ids), len(CONTACT_GROUPS)), dtype=np.int64)
        leaf_steps = np.zeros(len(ids), dtype=np.int64)
        collided = np.zeros(len(ids), dtype=np.bool_)
        first: dict[int, Contact] = {}
        for k in np.flatnonzero(touching).tolist():
            i = int(ids[k])
            counts[k], leaf_steps[k], contact = self._repeat(i, start.of(k), substeps)
            if contact is not None:
                collided[k], first[i] = True, contact
        return Contacts(counts, leaf_steps, collided, first)

    def _repeat(self, i: int, start: Start, substeps: int) -> tuple[npt.NDArray[np.int64], int, Contact | None]:
        """Repeat the last action of a simulation.

        Returns its contacts by group, its physics steps with a leaf, and the first contact that ends the episode.

        Contacts are counted after each physics step until one ends the episode. Those at the start belong to the action
        before, so they count only if one of them ends the episode or there is no physics step.
        """
        model, data, listed = self.models[i], self._data, self._stepper.listed
        with listed.unparked([i]):
            mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.act[:] = start
        data.ctrl[:] = self._stepper.speed[i]
        with listed.short(i):
            mujoco.mj_step1(model, data)
        counts, ending = self._present(i)
        if ending is None and substeps:
            counts = np.zeros_like(counts)
        leaf_steps = int(counts[LEAF] > 0)
        for _ in range(substeps):
            if ending is not None:
                break
            with listed.short(i):
                mujoco.mj_step2(model, data)
                mujoco.mj_step1(model, data)
            if data.ncon:
                present, ending = self._present(i)
                counts += present
                leaf_steps += int(present[LEAF] > 0)
        return counts, leaf_steps, None if ending is None else self._named(i, ending)

    def _present(self, i: int) -> tuple[npt.NDArray[np.int64], int | None]:
        """Return the present contacts by group and the index of the deepest that ends the episode."""
        data = self._data
        if not data.ncon:
            return np.zeros(len(CONTACT_GROUPS), dtype=np.int64), None
        contacts = data.contact
        groups = contact_groups(self.models[i], contacts.geom, self._worlds[i].groups)
        ending = np.flatnonzero(self._ends[groups])
        deepest = int(ending[np.argmin(contacts.dist[ending])]) if len(ending) else None
        return np.bincount(groups, minlength=len(CONTACT_GROUPS)), deepest

    def _named(self, i: int, index: int) -> Contact:
        """Return a present contact by names."""
        model, contact = self.models[i], self._data.contact[index]
        geoms = sorted((int(contact.geom1), int(contact.geom2)), key=lambda g: model.geom_bodyid[g], reverse=True)
        # the simulation's own model has the names of the first scene that was loaded
        names = tuple(self._worlds[i].compiled.geom_name(compiled_geom_id(model, g)) for g in geoms)
        return Contact(names, self_collision=bool(model.geom_bodyid[geoms[1]] > 0))


def _begin(model: mujoco.MjModel, world: World, targets: Sequence[int], disturbance: Disturbance) -> None:
    """Let the cup touch the targets in a model that holds a world, and displace the arm's base."""
    world.allow_cup_on(model, targets)
    if disturbance.shift.any() or disturbance.yaw:
        displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)


def _leaf_contacts(world: World, disturbance: Disturbance) -> LeafContacts:
    """Return the finder of touched leaves of an episode."""
    if not (disturbance.shift.any() or disturbance.yaw):
        return world.leaf_contacts
    model = copy.copy(world.compiled.model)
    displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)
    return LeafContacts(world.compiled, model)
