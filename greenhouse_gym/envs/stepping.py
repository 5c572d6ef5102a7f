"""Time stepping of n models of one layout: a single one on an `MjData`, many on a `mujoco.batch.Batch`.

Both compute the same numbers, bit for bit. Each call ends with the poses, velocities and contacts of the configuration
reached and the next one continues from there, so each physics step runs collision detection once. A call runs a whole
action: the models move the servos from one command to the next and record contacts themselves (`drive_and_record`).
"""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
import numpy.typing as npt
from mujoco.batch import Batch

from greenhouse_gym.envs.hidden_worlds import HiddenWorlds, beyond, foreseen
from greenhouse_gym.envs.state import Bools, Ids
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.geom_order import ShortGeomLists
from greenhouse_gym.scene.world_tree import BoxTree

_VELOCITIES = mujoco.mjtStage.mjSTAGE_VEL
_LARGEST_FORCE = 2  # of the ways to reduce the contacts of a sensor to one
_STATE = ("time", "qpos", "qvel", "act", "ctrl", "qacc_warmstart", "history")
_RECORDED = "{} recorded"


class ForkedError(GreenhouseError, RuntimeError):
    """Raised if an object with threads is used in a process that was forked after its creation."""


def drive_and_record(spec: mujoco.MjSpec, substeps: int, forces: bool = False) -> None:
    """Prepare the servos and sensors of an arm for the steppers.

    The position servos follow the integral of their controls: ``act`` is the commanded position (rad) and ``ctrl`` its
    speed (rad/s). Sensors keep what they measured before each of the last ``substeps`` physics steps: one for each
    joint its position, and one the number of all contacts, with the largest force (3,) of one (N, along its normal
    first) if ``forces`` is true.
    """
    for servo in list(spec.actuators):
        name, kind = _RECORDED.format(servo.target), mujoco.mjtSensor.mjSENS_JOINTPOS
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=servo.target, nsample=substeps)
        servo.dyntype, servo.actearly, servo.ctrllimited = mujoco.mjtDyn.mjDYN_INTEGRATOR, True, False
    sensor = spec.add_sensor(name="contacts", type=mujoco.mjtSensor.mjSENS_CONTACT, nsample=substeps)
    fields = [mujoco.mjtConDataField.mjCONDATA_FOUND, *([mujoco.mjtConDataField.mjCONDATA_FORCE] if forces else [])]
    sensor.intprm[:3] = [sum(1 << int(field) for field in fields), _LARGEST_FORCE if forces else 0, 1]


def _records(history: Array, substeps: int, model: mujoco.MjModel) -> Array:
    """Return a view (n, substeps, 1 or 4) of the contact sensor's records at the end of a history (n, k)."""
    width = int(model.sensor("contacts").dim[0])
    return history[:, -width * substeps :].reshape(-1, substeps, width)


def _recorded_joints(history: Array, substeps: int, model: mujoco.MjModel) -> Array:
    """Return a view (n, j, substeps) of the joint positions recorded before each physics step in a history (n, k)."""
    count = model.nu
    first = int(model.sensor_historyadr[model.sensor(_RECORDED.format(model.joint(0).name)).id])
    size = 2 + 2 * substeps  # two numbers and the times come before the values
    return history[:, first : first + count * size].reshape(-1, count, size)[..., -substeps:]


_ROWS = ("nefc", "ne", "nf", "nl")  # all rows of constraints, and those that are no contacts


def _found(records: Array, last: npt.NDArray[np.integer]) -> npt.NDArray[np.int64]:
    """Return contacts (n, substeps) after each physics step: recorded before the next one, or ``last`` (n,)."""
    return np.column_stack([records[:, 1:, 0], last]).astype(np.int64)


def _pushed(records: Array, rows: npt.NDArray[np.integer]) -> Bools:
    """See `Stepper.pushed`; ``rows`` (4, n) are the numbers of `_ROWS` at the end."""
    return np.asarray((records[..., 1] > 0).any(axis=1) | (rows[0] > rows[1:].sum(axis=0)))


class Start(NamedTuple):
    """State at the beginning of an action: each (j,) of one simulation, or (n, j) of all.

    Attributes:
        joints: Joint positions, radians.
        velocities: Joint velocities, rad/s.
        warmstart: Warm start of the constraint solver.
        command: Commanded positions, radians.
    """

    joints: Array
    velocities: Array
    warmstart: Array
    command: Array

    def of(self, i: int) -> Start:
        """Return the state of one of all simulations."""
        return Start._make(values[i] for values in self)


class Stepper(Protocol):
    """Stepper of n simulations; all arrays are live.

    Attributes:
        qpos: (n, j) joint positions, radians.
        qvel: (n, j) joint velocities, rad/s.
        command: (n, j) commanded positions, radians.
        speed: (n, j) speeds of the commands, rad/s.
        warmstart: (n, j) warm start of the constraint solver.
        site_xpos: (n, sites, 3) positions of the sites, metres.
        site_xmat: (n, sites, 9) rotations of the sites.
        xanchor: (n, j, 3) points on the joint axes, metres.
        xaxis: (n, j, 3) unit vectors along the joint axes.
        listed: Lists of the geoms of the models.
        start: State of all simulations at the beginning of the last action.
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
    listed: ShortGeomLists
    start: Start

    def load(self, i: int, tree: BoxTree, used: int) -> None:
        """Take note of another world in a model: the boxes around all that the arm can touch, and its used geoms."""

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """Place some arms, whose models may have been edited, at rest and return which have contacts."""

    def run(self) -> Bools:
        """Run the physics steps of an action; return a mask (n,) of simulations with contacts at any of them."""

    def found(self) -> npt.NDArray[np.int64]:
        """Return the number (n, substeps) of contacts after each physics step of the last action."""

    def pushed(self) -> Bools:
        """Return a mask (n,) of the simulations whose last action had a contact that does not give way.

        It must have pushed before a physics step or be present at the end.
        """


def _start(stepper: Stepper) -> Start:
    """Return copies of the present state of all simulations."""
    return Start(stepper.qpos.copy(), stepper.qvel.copy(), stepper.warmstart.copy(), stepper.command.copy())


class OneStepper:
    """Stepper of a single simulation, without the overhead of a batch.

    Args:
        model: The model.
        substeps: Physics steps per action.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int):
        self._model, self._data, self._substeps = model, mujoco.MjData(model), substeps
        data = self._data
        self.qpos, self.qvel, self.warmstart = data.qpos[None], data.qvel[None], data.qacc_warmstart[None]
        self.command, self.speed = data.act[None], data.ctrl[None]
        self.site_xpos, self.site_xmat = data.site_xpos[None], data.site_xmat[None]
        self.xanchor, self.xaxis = data.xanchor[None], data.xaxis[None]
        self._records, self.listed = _records(data.history[None], substeps, model), ShortGeomLists([model])

    def __deepcopy__(self, memo: dict[int, Any]) -> OneStepper:
        twin = OneStepper(copy.deepcopy(self._model, memo), self._substeps)
        mujoco.mj_copyData(twin._data, twin._model, self._data)
        twin.listed.load_all(self.listed)
        return twin

    def load(self, i: int, tree: BoxTree, used: int) -> None:
        """See `Stepper.load`; a single simulation hides nothing, so it needs no boxes."""
        self.listed.load(i, used)

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """See `Stepper.place`."""
        with self.listed.unparked(ids.tolist()):
            mujoco.mj_resetData(self._model, self._data)
            self.qpos[:], self.command[:] = configurations, configurations
            mujoco.mj_step1(self._model, self._data)
        return np.array([self._data.ncon > 0])

    def run(self) -> Bools:
        """See `Stepper.run`."""
        model, data, self.start = self._model, self._data, _start(self)
        with self.listed:
            mujoco.mj_step2(model, data)
            mujoco.mj_step(model, data, self._substeps - 1)
            mujoco.mj_step1(model, data)
        return np.array([data.ncon > 0 or self._records[..., 0].any()])

    def found(self) -> npt.NDArray[np.int64]:
        """See `Stepper.found`."""
        return _found(self._records, np.array([self._data.ncon]))

    def pushed(self) -> Bools:
        """See `Stepper.pushed`."""
        return _pushed(self._records, np.array([[getattr(self._data, name)] for name in _ROWS]))


class ManyStepper:
    """Stepper of many simulations on a thread pool.

    During an action, links of arms that cannot reach the world do not search it for contacts. An arm that turned
    farther than was foreseen repeats its action with the search.

    Args:
        models: Model of each simulation.
        threads: Number of threads; 0 uses all cores.
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
        self._records, self._ncon = _records(batch.bind("history"), substeps, models[0]), batch.bind("ncon")
        self._rows = [batch.bind(name) for name in _ROWS] if self._records.shape[2] > 1 else []
        self._joints = _recorded_joints(batch.bind("history"), substeps, models[0])
        self.listed, self._hidden = ShortGeomLists(models), HiddenWorlds(models, models[0].nu)
        frames = self._hidden.frames
        self._bodies = batch.bind("xpos")[:, frames], batch.bind("xmat")[:, frames]
        self._time, self._interval = batch.bind("time"), substeps * models[0].opt.timestep

    def __deepcopy__(self, memo: dict[int, Any]) -> ManyStepper:
        self._check_process()
        twin = ManyStepper(copy.deepcopy(self._models, memo), self._threads, self._substeps)
        twin._hidden = self._hidden.copied(twin._models)
        twin._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)  # poses of static bodies
        for name in _STATE:
            twin._batch.bind(name)[:] = self._batch.bind(name)
        twin._batch.forward(stage=_VELOCITIES)
        twin.listed.load_all(self.listed)
        return twin

    def load(self, i: int, tree: BoxTree, used: int) -> None:
        """See `Stepper.load`."""
        self._hidden.load(i, tree)
        self.listed.load(i, used)

    def place(self, ids: Ids, configurations: Array) -> Bools:
        """See `Stepper.place`."""
        self._check_process()
        self._hidden.show(ids)
        # edited models need not be set again, because their simulations are reset here
        with self.listed.unparked(ids.tolist()):
            self._batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
            self.qpos[ids], self.command[ids] = configurations, configurations
            self._batch.forward(ids, stage=_VELOCITIES)
        return np.asarray(self._ncon[ids] > 0)

    def run(self) -> Bools:
        """See `Stepper.run`."""
        self._check_process()
        self.start, time = _start(self), self._time.copy()
        turns = foreseen(self.qpos, self.command, self.speed, self._interval)
        self._hidden.hide(*self._bodies, self.xanchor, turns)
        with self.listed:
            self._batch.step(nstep=self._substeps, stage=_VELOCITIES)
            late = np.flatnonzero(beyond(self._joints, self.qpos, self.start.joints, turns))
            if len(late):
                self._repeat(late, time)
        return self._records[..., 0].any(axis=1) | (self._ncon > 0)

    def _repeat(self, ids: Ids, time: Array) -> None:
        """Repeat the last action of some simulations, which began at times (n,), with their whole worlds."""
        self._hidden.show(ids)
        now = self.qpos, self.qvel, self.warmstart, self.command, self._time
        for array, before in zip(now, (*self.start, time), strict=True):
            array[ids] = before[ids]
        self._batch.forward(ids, stage=_VELOCITIES)
        self._batch.step(ids, nstep=self._substeps, stage=_VELOCITIES)

    def found(self) -> npt.NDArray[np.int64]:
        """See `Stepper.found`."""
        return _found(self._records, self._ncon)

    def pushed(self) -> Bools:
        """See `Stepper.pushed`."""
        return _pushed(self._records, np.stack(self._rows))

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise ForkedError(
                "a vector environment cannot be used in a forked process, which lacks its threads: create it in the "
                'process that steps it, or start processes with "spawn"'
            )
