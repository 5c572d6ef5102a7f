"""The physics of n simulations: private models, and what is touched."""

from __future__ import annotations

import copy
from typing import NamedTuple

import mujoco
import numpy as np

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.randomization import Disturbance, displace_base
from greenhouse_gym.envs.reach_task import Bools, ControlTiming
from greenhouse_gym.envs.stepping import Ids, ManyStepper, OneStepper, Stepper
from greenhouse_gym.envs.worlds import World
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import compiled_geom_id, put_arm_first

_SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)


class Contact(NamedTuple):
    """What touches what.

    Attributes:
        names: Names of two geoms, the arm's part first; empty when nothing is touched.
        self_collision: Whether both belong to the arm.
    """

    names: tuple[str, ...] = ()
    self_collision: bool = False


NOTHING = Contact()


class Contacts(NamedTuple):
    """What n simulations collided in an action.

    Attributes:
        any: (n,) whether anything was touched in any substep.
        contacts: The first contact of those that collided, by simulation.
    """

    any: Bools
    contacts: dict[int, Contact]


class _Start(NamedTuple):
    """What a simulation goes on from: positions, velocities, the solver's first guess and commands, each (j,)."""

    joints: Array
    velocities: Array
    warmstart: Array
    command: Array


class Physics:
    """n simulations, each on a private padded model into which a reset copies the episode's scene.

    Args:
        count: Number of simulations n.
        world: Any world; all that are loaded must compile to the same sizes.
        threads: Threads that simulate; 0 uses all cores.
        timing: How the time goes.

    Attributes:
        models: Each simulation's model, the arm's geoms before those of the world. They are set to compute the poses of
            what never moves only when their data are reset (MuJoCo's sleep flag), which saves a third of the time; the
            arm itself never sleeps.
    """

    def __init__(self, count: int, world: World, threads: int, timing: ControlTiming):
        compiled = world.compiled
        self.models = [copy.copy(compiled.model) for _ in range(count)]
        for model in self.models:
            model.opt.enableflags |= _SLEEP
            put_arm_first(model)
        self._timing = timing
        self._worlds: list[World | None] = [None] * count
        self._stepper: Stepper = (
            OneStepper(self.models[0], timing.substeps)
            if count == 1
            else ManyStepper(self.models, threads, timing.substeps)
        )
        self._data = mujoco.MjData(compiled.model)
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

    def load(self, i: int, world: World, target: int, disturbance: Disturbance) -> None:
        """Make a simulation's model that of a world; takes effect with the next `place`."""
        prepare(self.models[i], world, target, disturbance, self._worlds[i])
        self._worlds[i] = world

    def place(self, ids: Ids, configurations: Array) -> Contacts:
        """Put some arms, at rest, at configurations (len(ids), j)."""
        collided = self._stepper.place(ids, configurations)
        still = np.zeros(configurations.shape[1])
        contacts = {
            int(ids[k]): self._first_contact(int(ids[k]), _Start(configurations[k], still, still, configurations[k]))
            for k in np.flatnonzero(collided)
        }
        return Contacts(collided, contacts)

    def advance(self, command: Array) -> Contacts:
        """One action: the servos' commands move evenly to the new ones (n, j)."""
        stepper = self._stepper
        before = [array.copy() for array in (stepper.qpos, stepper.qvel, stepper.warmstart, stepper.command)]
        stepper.speed[:] = (command - stepper.command) / self._timing.interval
        collided = stepper.run()
        contacts = {
            i: self._first_contact(i, _Start(*(array[i] for array in before)))
            for i in np.flatnonzero(collided).tolist()
        }
        return Contacts(collided, contacts)

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Tip and probe points (m, 1 + k, 3) and tool frames (m, 3, 3) of some simulations in their scenes."""
        frames = self._stepper.site_xmat[ids, self._tip].reshape(-1, 3, 3)
        return self._stepper.site_xpos[ids][:, self._points], frames

    def motion(self, heading: Array) -> ToolMotion:
        """How the tools move with the joints, (n, 2) cosine and sine of the bases' headings given."""
        stepper = self._stepper
        return ToolMotion(stepper.xanchor, stepper.xaxis, stepper.site_xpos[:, self._tip], heading)

    def copy_state(self, i: int, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Copy a simulation's state into the ``data`` of its ``model`` and compute what follows from it."""
        stepper = self._stepper
        data.qpos[:], data.qvel[:], data.act[:] = stepper.qpos[i], stepper.qvel[i], stepper.command[i]
        mujoco.mj_forward(model, data)

    def _first_contact(self, i: int, start: _Start) -> Contact:
        """The deepest contact where a simulation first touches anything in an action, found by doing it once more."""
        model, data = self.models[i], self._data
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:], data.act[:] = start
        data.ctrl[:] = self._stepper.speed[i]
        mujoco.mj_step1(model, data)
        for _ in range(self._timing.substeps):
            if data.ncon:
                break
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
        contact = data.contact[int(np.argmin(data.contact.dist))]
        geoms = sorted((int(contact.geom1), int(contact.geom2)), key=lambda g: model.geom_bodyid[g], reverse=True)
        world = self._worlds[i]
        assert world is not None
        # The simulation's own model has the names of the first scene, so they are read from the world's.
        names = tuple(name_of(world.compiled.model, compiled_geom_id(model, g)) for g in geoms)
        return Contact(names, self_collision=bool(model.geom_bodyid[geoms[1]] > 0))


def name_of(model: mujoco.MjModel, geom: int) -> str:
    """A geom's name, or that of its body where it has none, as in files of other makers' arms."""
    # asked for by id: `MjModel.geom` makes a table of all names first, of which there are thousands
    own = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom)
    return str(own or model.body(model.geom_bodyid[geom]).name or f"geom {geom}")


def prepare(
    model: mujoco.MjModel, world: World, target: int, disturbance: Disturbance, last: World | None = None
) -> None:
    """Make a model that of an episode: the world's geoms, the cup allowed on the target, the base where it stands.

    It takes less time where the world that the model was last is told.
    """
    world.load(model, target, last)
    if disturbance.shift.any() or disturbance.yaw:
        displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)
