"""The physics of n simulations: private models on one `mujoco.batch.Batch`, servo ramps, and what is touched."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from greenhouse_gym.envs.actions import ToolMotion
from greenhouse_gym.envs.randomization import Disturbance, displace_base
from greenhouse_gym.envs.reach_task import SUBSTEPS, Bools
from greenhouse_gym.envs.worlds import World
from greenhouse_gym.geometry import Array

Ids = npt.NDArray[np.int64]

_VELOCITIES = mujoco.mjtStage.mjSTAGE_VEL
_CONTROLS = int(mujoco.mjtState.mjSTATE_CTRL)
_RAMP = (np.arange(1, SUBSTEPS + 1) / SUBSTEPS)[:, None]


class Contact(NamedTuple):
    """What touches what.

    Attributes:
        names: Names of two geoms, the arm's part first; empty when nothing is touched.
        of_arm_alone: Whether both belong to the arm.
    """

    names: tuple[str, ...] = ()
    of_arm_alone: bool = False


NOTHING = Contact()


@dataclass(frozen=True, eq=False)
class Touches:
    """What n simulations touched in an action.

    Attributes:
        any: (n,) whether anything was touched in any substep.
        contacts: The first contact of those that touched, by simulation.
    """

    any: Bools
    contacts: dict[int, Contact]


class Physics:
    """n simulations, each on a private padded model into which a reset copies the episode's scene.

    Args:
        count: Number of simulations n.
        world: Any world; all that are loaded must compile to the same sizes.
        threads: Threads of the batch; 0 uses all cores.
        needs_motion: Whether `motion` will be asked for.

    Attributes:
        models: Each simulation's model.
        qpos: (n, j) joint positions, radians.
        qvel: (n, j) joint velocities, rad/s.
    """

    def __init__(self, count: int, world: World, threads: int, needs_motion: bool):
        compiled = world.compiled
        self.models = [copy.copy(compiled.model) for _ in range(count)]
        self._worlds: list[World | None] = [None] * count
        self._batch = batch = Batch(compiled.model, count, threads, persistent=True)
        self._data = mujoco.MjData(compiled.model)
        self.qpos, self.qvel, self._ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self._site_xpos, self._site_xmat = batch.bind("site_xpos"), batch.bind("site_xmat")
        self._ncon = batch.bind("ncon")
        self._anchors: Array | None = batch.bind("xanchor") if needs_motion else None
        self._axes: Array | None = batch.bind("xaxis") if needs_motion else None
        self._tip = compiled.tip_site
        self._points = np.array([compiled.tip_site, *compiled.probe_sites])

    def load(self, i: int, world: World, target: int, disturbance: Disturbance) -> None:
        """Make a simulation's model that of a world; takes effect with the next `place`."""
        prepare(self.models[i], world, target, disturbance)
        self._worlds[i] = world

    def place(self, ids: Ids, configurations: Array) -> Touches:
        """Put some arms, at rest, at configurations (len(ids), j)."""
        self._batch.set_models(self.models)
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[ids] = configurations
        self._ctrl[ids] = configurations
        self._batch.forward(ids, stage=_VELOCITIES)
        touched = self._ncon[ids] > 0
        at = np.flatnonzero(touched)
        return Touches(touched, {int(ids[k]): self._contact(int(ids[k]), configurations[k]) for k in at})

    def advance(self, last: Array, command: Array) -> Touches:
        """One action: all servos follow a ramp from the last commands (n, j) to the new ones."""
        began, at_rest = self.qpos.copy(), self._ncon.copy()
        ramp = last[:, None] + (command - last)[:, None] * _RAMP
        # A step's derived values are one substep old. So the last forward tells what is touched at the end, and the
        # batch, which is persistent, goes on from there in the first substep of the next action; the record of the
        # other substeps tells what is touched at their starts.
        self._ctrl[:] = ramp[:, 0]
        self._batch.step(nstep=1)
        second = self.qpos.copy()
        record = self._batch.rollout(SUBSTEPS - 1, ramp[:, 1:], _CONTROLS, record=("ncon", "qpos"))
        self._batch.forward(stage=_VELOCITIES)
        between = record["ncon"].reshape(len(last), SUBSTEPS - 1)
        touched = np.asarray((between.max(axis=1) + self._ncon + at_rest) > 0)
        contacts = {}
        for i in np.flatnonzero(touched).tolist():
            hits = np.flatnonzero(np.concatenate([at_rest[i : i + 1], between[i]]))
            first = int(hits[0]) if len(hits) else SUBSTEPS
            contacts[i] = self._contact(i, [began[i], second[i], *record["qpos"][i]][first])
        return Touches(touched, contacts)

    def sites(self, ids: Ids | slice) -> tuple[Array, Array]:
        """Tip and probe points (m, 1 + k, 3) and tool frames (m, 3, 3) of some simulations in their scenes."""
        frames = self._site_xmat[ids, self._tip].reshape(-1, 3, 3)
        return self._site_xpos[ids][:, self._points], frames

    def motion(self, heading: Array) -> ToolMotion:
        """How the tools move with the joints, (n, 2) cosine and sine of the bases' headings given."""
        assert self._anchors is not None
        assert self._axes is not None
        return ToolMotion(self._anchors, self._axes, self._site_xpos[:, self._tip], heading)

    def copy_state(self, i: int, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Copy a simulation's state into the ``data`` of its ``model`` and compute what follows from it."""
        data.qpos[:], data.qvel[:], data.ctrl[:] = self.qpos[i], self.qvel[i], self._ctrl[i]
        mujoco.mj_forward(model, data)

    def _contact(self, i: int, configuration: Array) -> Contact:
        """The deepest contact of a simulation at a configuration."""
        model, data, world = self.models[i], self._data, self._worlds[i]
        assert world is not None
        data.qpos[:] = configuration
        mujoco.mj_fwdPosition(model, data)
        if data.ncon == 0:
            return NOTHING
        contact = data.contact[int(np.argmin(data.contact.dist))]
        geoms = sorted((int(contact.geom1), int(contact.geom2)), key=lambda g: model.geom_bodyid[g], reverse=True)
        names = tuple(str(world.compiled.model.geom(g).name) for g in geoms)
        return Contact(names, of_arm_alone=bool(model.geom_bodyid[geoms[1]] > 0))


def prepare(model: mujoco.MjModel, world: World, target: int, disturbance: Disturbance) -> None:
    """Make a model that of an episode: the world's geoms, the cup allowed on the target, the base where it stands."""
    world.load(model, target)
    if disturbance.shift.any() or disturbance.yaw:
        displace_base(model, world.frame[3:], disturbance.shift, disturbance.yaw)
