"""Time stepping of n models of one layout: one alone on an `MjData`, many on a `mujoco.batch.Batch`.

Both give the same numbers, bit for bit. After every call the poses, velocities and contacts of the configurations
reached are known, and the next call goes on from them, so that each physics step costs one pass of collision detection.
A whole action is one call: the models themselves lead the servos from one command to the next and keep a record of
what was touched on the way (`drive_and_record`).
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from greenhouse_gym.envs.reach_task import Bools
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import ShortGeomLists

Ids = npt.NDArray[np.int64]

_VELOCITIES = mujoco.mjtStage.mjSTAGE_VEL
_STATE = ("time", "qpos", "qvel", "act", "ctrl", "qacc_warmstart", "history")
_CHUNK = 32


class ForkedError(GreenhouseError, RuntimeError):
    """Something that works with threads was used in a process that was forked off after it had been made."""


def drive_and_record(spec: mujoco.MjSpec, substeps: int) -> None:
    """Make an arm ready for the steppers.

    Its position servos follow the integral of their controls: ``act`` is the commanded position, radians, ``ctrl`` the
    speed with which it moves, rad/s. A sensor counts the contacts, and its history keeps the last ``substeps`` counts.
    """
    for servo in spec.actuators:
        servo.dyntype, servo.actearly, servo.ctrllimited = mujoco.mjtDyn.mjDYN_INTEGRATOR, True, False
    sensor = spec.add_sensor(name="contacts", type=mujoco.mjtSensor.mjSENS_CONTACT, nsample=substeps)
    sensor.intprm[:3] = [1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1]


class Stepper(Protocol):
    """n simulations.

    Attributes:
        qpos: (n, j) joint positions, radians; all arrays are live.
        qvel: (n, j) joint velocities, rad/s.
        command: (n, j) commanded positions, radians.
        speed: (n, j) how fast the commands move, rad/s.
        warmstart: (n, j) what the solver of contacts and limits begins with.
        site_xpos: (n, sites, 3) positions of the sites, metres.
        site_xmat: (n, sites, 9) their frames.
        xanchor: (n, j, 3) points on the joints' axes, metres.
        xaxis: (n, j, 3) unit vectors along the joints' axes.
    """

    qpos: Array
    qvel: Array
    command: Array
    speed: Array
    warmstart: Array
    site_xpos: Array
    site_xmat: Array
    xanchor: Array
    xaxis: Array

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """Put some arms, whose models may have been edited, at rest at configurations; tell which touch anything."""

    def run(self) -> Bools:
        """Make the physics steps of an action; tell (n,) which touched anything in them, or where they stood before."""


class OneStepper:
    """A single simulation, without the detour over a batch.

    Args:
        model: Its model.
        substeps: Physics steps per action.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int):
        self._model, self._data, self._substeps = model, mujoco.MjData(model), substeps
        data = self._data
        self.qpos, self.qvel, self.warmstart = data.qpos[None], data.qvel[None], data.qacc_warmstart[None]
        self.command, self.speed = data.act[None], data.ctrl[None]
        self.site_xpos, self.site_xmat = data.site_xpos[None], data.site_xmat[None]
        self.xanchor, self.xaxis = data.xanchor[None], data.xaxis[None]
        self._counts, self._listed = data.history[None, -substeps:], ShortGeomLists([model])

    def __deepcopy__(self, memo: dict[int, Any]) -> OneStepper:
        twin = OneStepper(copy.deepcopy(self._model, memo), self._substeps)
        mujoco.mj_copyData(twin._data, twin._model, self._data)
        return twin

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """See `Stepper.place`."""
        mujoco.mj_resetData(self._model, self._data)
        self.qpos[:], self.command[:] = configurations, configurations
        mujoco.mj_step1(self._model, self._data)
        return np.array([self._data.ncon > 0])

    def run(self) -> Bools:
        """See `Stepper.run`."""
        model, data = self._model, self._data
        with self._listed:
            mujoco.mj_step2(model, data)
            mujoco.mj_step(model, data, self._substeps - 1)
            mujoco.mj_step1(model, data)
        return np.array([data.ncon > 0 or self._counts.any()])


class ManyStepper:
    """Many simulations on a thread pool.

    They are stepped in chunks that fit the processor's cache: a whole action of one chunk, then of the next.

    Args:
        models: Each simulation's model.
        threads: Threads of the batch; 0 uses all cores.
        substeps: Physics steps per action.
    """

    def __init__(self, models: Sequence[mujoco.MjModel], threads: int, substeps: int):
        count = len(models)
        self._models, self._threads, self._substeps, self._process = models, threads, substeps, os.getpid()
        self._batch = batch = Batch(models[0], count, threads, persistent=True)
        batch.set_models(models)
        self.qpos, self.qvel, self.warmstart = batch.bind("qpos"), batch.bind("qvel"), batch.bind("qacc_warmstart")
        self.command, self.speed = batch.bind("act"), batch.bind("ctrl")
        self.site_xpos, self.site_xmat = batch.bind("site_xpos"), batch.bind("site_xmat")
        self.xanchor, self.xaxis = batch.bind("xanchor"), batch.bind("xaxis")
        self._counts, self._ncon = batch.bind("history")[:, -substeps:], batch.bind("ncon")
        self._listed = ShortGeomLists(models)
        size = _CHUNK * batch.nthread
        starts = range(0, count, size)
        self._chunks = [np.arange(i, min(i + size, count), dtype=np.int32) for i in starts] if count > size else [None]

    def __deepcopy__(self, memo: dict[int, Any]) -> ManyStepper:
        self._check_process()
        twin = ManyStepper(copy.deepcopy(self._models, memo), self._threads, self._substeps)
        twin._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)  # where what never moves is placed
        for name in _STATE:
            twin._batch.bind(name)[:] = self._batch.bind(name)
        twin._batch.forward(stage=_VELOCITIES)
        return twin

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """See `Stepper.place`."""
        self._check_process()
        # Models that were edited need not be set again: their simulations start afresh here.
        self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        self.qpos[ids], self.command[ids] = configurations, configurations
        self._batch.forward(ids, stage=_VELOCITIES)
        return np.asarray(self._ncon[ids] > 0)

    def run(self) -> Bools:
        """See `Stepper.run`."""
        self._check_process()
        with self._listed:
            for ids in self._chunks:
                self._batch.step(ids, nstep=self._substeps, stage=_VELOCITIES)
        return self._counts.any(axis=1) | (self._ncon > 0)

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise ForkedError(
                "a vector environment cannot go on in a forked process, where its threads are missing: make it in the "
                'process that steps it, or start processes by "spawn"'
            )
