"""Time stepping of n models of one layout: one alone on an `MjData`, many on a `mujoco.batch.Batch`.

Both give the same numbers, bit for bit. After every call the poses, velocities and contacts of the configurations
reached are known, and the next call goes on from them, so that each physics step costs one pass of collision detection.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from greenhouse_gym.envs.reach_task import SUBSTEPS, Bools
from greenhouse_gym.geometry import Array

Ids = npt.NDArray[np.int64]

_VELOCITIES = mujoco.mjtStage.mjSTAGE_VEL
_CONTROLS = int(mujoco.mjtState.mjSTATE_CTRL)
_CHUNK = 32


class Stepper(Protocol):
    """n simulations.

    Attributes:
        qpos: (n, j) joint positions, radians; all arrays are live.
        qvel: (n, j) joint velocities, rad/s.
        ctrl: (n, j) commanded positions, radians.
        site_xpos: (n, sites, 3) positions of the sites, metres.
        site_xmat: (n, sites, 9) their frames.
        xanchor: (n, j, 3) points on the joints' axes, metres.
        xaxis: (n, j, 3) unit vectors along the joints' axes.
    """

    qpos: Array
    qvel: Array
    ctrl: Array
    site_xpos: Array
    site_xmat: Array
    xanchor: Array
    xaxis: Array

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """Put some arms, whose models may have been edited, at rest at configurations; which of them touch anything."""

    def run(self, ramp: Array) -> dict[int, Array]:
        """Step with commands (n, SUBSTEPS, j); the first configuration that touched anything, by simulation.

        Where the arms stood before counts as well.
        """


class OneStepper:
    """A single simulation, without the detour over a batch."""

    def __init__(self, model: mujoco.MjModel):
        self._model, self._data = model, mujoco.MjData(model)
        data = self._data
        self.qpos, self.qvel, self.ctrl = data.qpos[None], data.qvel[None], data.ctrl[None]
        self.site_xpos, self.site_xmat = data.site_xpos[None], data.site_xmat[None]
        self.xanchor, self.xaxis = data.xanchor[None], data.xaxis[None]

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """As `Stepper.place`."""
        mujoco.mj_resetData(self._model, self._data)
        self.qpos[:], self.ctrl[:] = configurations, configurations
        mujoco.mj_step1(self._model, self._data)
        return np.array([self._data.ncon > 0])

    def run(self, ramp: Array) -> dict[int, Array]:
        """As `Stepper.run`."""
        model, data, control = self._model, self._data, self._data.ctrl
        first: dict[int, Array] = {0: data.qpos.copy()} if data.ncon else {}
        for command in ramp[0]:
            control[:] = command
            mujoco.mj_step2(model, data)
            mujoco.mj_step1(model, data)
            if data.ncon and not first:
                first[0] = data.qpos.copy()
        return first


class ManyStepper:
    """Many simulations on a thread pool.

    They are stepped in chunks that fit the processor's cache: a whole action of one chunk, then of the next.

    Args:
        models: Each simulation's model.
        threads: Threads of the batch; 0 uses all cores.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], threads: int):
        count = len(models)
        self._batch = batch = Batch(models[0], count, threads, persistent=True)
        batch.set_models(models)
        self.qpos, self.qvel, self.ctrl = batch.bind("qpos"), batch.bind("qvel"), batch.bind("ctrl")
        self.site_xpos, self.site_xmat = batch.bind("site_xpos"), batch.bind("site_xmat")
        self.xanchor, self.xaxis = batch.bind("xanchor"), batch.bind("xaxis")
        self._ncon = batch.bind("ncon")
        size = _CHUNK * batch.nthread
        starts = range(0, count, size)
        self._chunks = [np.arange(i, min(i + size, count), dtype=np.int32) for i in starts] if count > size else [None]
        joints = self.qpos.shape[1]
        self._second = np.empty((count, joints))
        self._later = np.empty((count, SUBSTEPS - 1, joints))
        self._between = np.empty((count, SUBSTEPS - 1), dtype=np.int32)

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """As `Stepper.place`."""
        # Models that were edited need not be set again: their simulations start afresh here.
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[ids], self.ctrl[ids] = configurations, configurations
        self._batch.forward(ids, stage=_VELOCITIES)
        return np.asarray(self._ncon[ids] > 0)

    def run(self, ramp: Array) -> dict[int, Array]:
        """As `Stepper.run`."""
        batch, began, at_rest = self._batch, self.qpos.copy(), self._ncon.copy()
        self.ctrl[:] = ramp[:, 0]
        for ids in self._chunks:
            part = slice(None) if ids is None else slice(ids[0], ids[-1] + 1)
            # A step goes on from what is known, a rollout does not; but the record of a rollout tells what was touched
            # at the starts of its physics steps, and the last forward what is touched at the end.
            batch.step(ids, nstep=1)
            self._second[part] = self.qpos[part]
            out = {"ncon": self._between[part], "qpos": self._later[part]}
            batch.rollout(SUBSTEPS - 1, ramp[part, 1:], _CONTROLS, ("ncon", "qpos"), ids, out)
            batch.forward(ids, stage=_VELOCITIES)
        touched = (self._between.max(axis=1) + self._ncon + at_rest) > 0
        first = {}
        for i in np.flatnonzero(touched).tolist():
            hits = np.flatnonzero([at_rest[i], *self._between[i]])
            index = int(hits[0]) if len(hits) else SUBSTEPS
            first[i] = np.array([began[i], self._second[i], *self._later[i]][index])
        return first
