"""One simulation with compliant plants: its physics steps and the arm's contacts."""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.contacts import CONTACT_GROUPS, LEAF, Contact, Groups
from greenhouse_gym.envs.state import Bools
from greenhouse_gym.envs.world import World
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.scene.geom_order import ShortGeomLists, compiled_geom_id
from greenhouse_gym.scene.plants.live import LivePlants
from greenhouse_gym.scene.plants.out_of_reach import Organs

_STEM, _SELF = CONTACT_GROUPS.index("stem"), CONTACT_GROUPS.index("self")


class ArmContacts(NamedTuple):
    """Contacts of the arm of one simulation.

    Attributes:
        counts: (groups,) contacts by group, summed over physics steps.
        leaf_steps: Number of physics steps with a contact of a leaf.
        ending: First contact that ends the episode, the deepest of its physics step; None without one.
        pressed: Forces of the arm on fruit and stems, N, by geom.
    """

    counts: npt.NDArray[np.int64]
    leaf_steps: int = 0
    ending: Contact | None = None
    pressed: dict[int, float] = {}  # noqa: RUF012  never changed

    def then(self, later: ArmContacts) -> ArmContacts:
        """Return the contacts of this and of a later physics step."""
        return ArmContacts(
            self.counts + later.counts, self.leaf_steps + later.leaf_steps, self.ending or later.ending, later.pressed
        )


NO_CONTACTS = ArmContacts(np.zeros(len(CONTACT_GROUPS), dtype=np.int64))


class CompliantSimulation(NamedTuple):
    """One simulation with compliant plants.

    Attributes:
        model: Its own model.
        data: Its state.
        plants: Its plants.
        groups: (geoms,) contact group of each geom.
        listed: Context in which its steps list few geoms.
        organs: Its organs, which are hidden from its steps when they are out of reach.
        world: Its world.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    plants: LivePlants
    groups: Groups
    listed: ShortGeomLists
    organs: Organs
    world: World

    @property
    def at_rest(self) -> bool:
        """True if all organs sleep, nothing that came off is on the move, and the tool holds nothing."""
        return bool(self.data.ntree_awake == 1 and self.plants.at_rest)

    @property
    def is_busy(self) -> bool:
        """True if anything but the arm moves, or if it touches or holds something."""
        return bool(self.data.ncon or self.data.ntree_awake > 1 or self.plants.holding)

    def run(self, steps: int, ends: Bools) -> ArmContacts | None:
        """Run the physics steps of an action, after which kinematics are current.

        Args:
            steps: Number of physics steps.
            ends: (groups,) contact groups that end the episode.

        Returns:
            The arm's contacts; None if nothing but the arm moved and it touched nothing.
        """
        contacts, left = None, steps
        while left:
            left -= self._step_until_busy(left)
            if self.is_busy:
                now = self.arm_contacts(ends)
                self.plants.after_step(now.pressed)
                contacts = now if contacts is None else contacts.then(now)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        return contacts

    def _step_until_busy(self, steps: int) -> int:
        """Step until the simulation is busy, at most so many times; return the number of steps."""
        model, data, organs, done = self.model, self.data, self.organs, 0
        with self.listed:
            while not done or (done < steps and not self.is_busy):
                if organs.hidden:
                    organs.check()
                mujoco.mj_step(model, data)
                done += 1
        if organs.hidden:
            organs.show()
        return done

    def arm_contacts(self, ends: Bools) -> ArmContacts:
        """Return the present contacts of the arm.

        Args:
            ends: (groups,) contact groups that end the episode.
        """
        data = self.data
        if not data.ncon:
            return NO_CONTACTS
        contacts = data.contact
        geoms = contacts.geom
        groups = self.groups[geoms]
        of_arm = np.flatnonzero(groups.max(axis=1) == _SELF)  # the arm's own group is the largest
        if not len(of_arm):
            return NO_CONTACTS
        other = groups[of_arm].min(axis=1)
        ending = of_arm[ends[other]]
        first = self._named(geoms[ending[contacts.dist[ending].argmin()]]) if len(ending) else None
        pressed, force = dict[int, float](), np.zeros(6)
        for k in of_arm[other <= _STEM].tolist():
            mujoco.mj_contactForce(self.model, data, k, force)
            geom = int(geoms[k, groups[k].argmin()])
            pressed[geom] = pressed.get(geom, 0.0) + abs(float(force[0]))
        counts = np.bincount(other, minlength=len(CONTACT_GROUPS))
        return ArmContacts(counts, int(counts[LEAF] > 0), first, pressed)

    def _named(self, geoms: npt.NDArray[np.integer]) -> Contact:
        """Return a contact by the names of its geoms, the arm's first."""
        arm_first = sorted(geoms.tolist(), key=lambda g: -int(self.groups[g]))
        names = tuple(self.world.compiled.geom_name(compiled_geom_id(self.model, g)) for g in arm_first)
        return Contact(names, self_collision=bool((self.groups[geoms] == _SELF).all()))

    def check_crate(self) -> None:
        """Check that the arm is not in its crate.

        Raises:
            InvalidValueError: It is.
        """
        crate = self.plants.planted.ids.crate
        for geoms in self.data.contact.geom:
            if crate in self.model.geom_bodyid[geoms] and (self.groups[geoms] == _SELF).any():
                raise InvalidValueError(
                    f"the crate is in the arm's way at its start ({' and '.join(self._named(geoms).names)}): move it, "
                    "as in TomatoHarvest(layout=Layout(crate=Crate(position=...))), or choose another start"
                )

    def copied(self) -> CompliantSimulation:
        """Return an independent copy in the same state."""
        model = copy.copy(self.model)
        data = mujoco.MjData(model)
        mujoco.mj_copyData(data, model, self.data)
        organs = Organs(model, data, self.plants.planted.ids, self.organs.arm.levers.shape[1])
        return self._replace(
            model=model, data=data, plants=self.plants.twin(model, data), listed=ShortGeomLists([model]), organs=organs
        )
