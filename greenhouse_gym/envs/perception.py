"""Perception: from the kinematics of n simulations to their states, in the base frame of each."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.executors import usable_cores
from greenhouse_gym.envs.contacts import Contacts
from greenhouse_gym.envs.observations import ObservationSpec
from greenhouse_gym.envs.physics import AnyPhysics
from greenhouse_gym.envs.setups import Setup
from greenhouse_gym.envs.state import Bools, Ids, State
from greenhouse_gym.envs.views import TaskCamera, View
from greenhouse_gym.envs.worlds import STOP, Worlds
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import NO_TOMATO, FieldsOfSimulations
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.waypoints import WaypointTracker
from greenhouse_gym.rendering.cameras import CameraRig, DepthCamera, Images, no_images
from greenhouse_gym.robots import Robot


class Perception:
    """Computation of the states of n simulations.

    Args:
        count: Number of simulations n.
        robot: The arm.
        observe: The observation; only what it requires is computed.
        worlds: The worlds of the episodes.
        requires_roadmap: Compute waypoints and paths.
        threads: Number of threads of the cameras; 0 uses all cores.
        camera: Camera of the task, if it has one.

    Attributes:
        images_due: (n,) whether the images of each simulation are rendered; the others are zero.
    """

    def __init__(
        self,
        count: int,
        robot: Robot,
        observe: ObservationSpec,
        worlds: Worlds,
        requires_roadmap: bool,
        threads: int,
        camera: DepthCamera | None = None,
    ):
        self._count, self._robot, self._observe, self._worlds = count, robot, observe, worlds
        self._threads = 1 if count == 1 else threads or usable_cores()
        self._rig: CameraRig | None = None
        self._camera = camera
        self._task_camera: TaskCamera | None = None
        self._no_images = no_images(count)
        self.images_due = np.ones(count, dtype=np.bool_)
        self._probe_radii = robot.probe_radii.astype(np.float32)
        self._setups: dict[int, Setup] = {}
        self._joint_offset = np.zeros((count, len(robot.joints)))
        self._field, self._ignored, self._remaining = np.zeros((3, count), dtype=np.int64)
        self._frame = np.zeros((count, 5))  # position of the base, cosine and sine of its heading
        self._axes = np.zeros((count, 3, 3))  # columns: the axes of the base frame in the scene
        self._target = np.zeros((count, 3))  # as observed, in the base frame
        self._goal = np.zeros((count, 3))  # true center, in the base frame
        self._radius = np.zeros((count, 1))
        # read-only values of what is not required
        self._nothing, self._unset, self._false = np.empty((count, 0)), np.full(count, np.nan), np.zeros(count, bool)
        self._unmoved = np.zeros((count, 1, 3))
        self._waypoints = WaypointTracker(count, len(robot.joints)) if requires_roadmap else None

    def __deepcopy__(self, memo: dict[int, Any]) -> Perception:
        """Return a copy, without cameras until they are needed."""
        twin = memo[id(self)] = object.__new__(Perception)
        twin.__dict__ = copy.deepcopy({**self.__dict__, "_rig": None, "_task_camera": None}, memo)
        return twin

    @property
    def heading(self) -> Array:
        """(n, 2) cosine and sine of the heading of each base."""
        return self._frame[:, 3:].copy()

    def begin(self, i: int, setup: Setup) -> None:
        """Prepare a new episode of a simulation."""
        self._setups[i] = setup
        episode, world, disturbance, _ = setup
        self._joint_offset[i] = disturbance.joints
        self._field[i] = world.field
        self._frame[i] = world.frame
        cosine, sine = world.frame[3:]
        self._axes[i] = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
        self.set_target(i, 0, episode.start)

    def set_target(self, i: int, index: int, start: Array) -> None:
        """Make one of the targets of a simulation's episode the current one.

        Args:
            i: The simulation.
            index: Index into the targets of the episode.
            start: (j,) joint positions from which the roadmap leads to the target, radians.
        """
        episode, world, disturbance, _ = self._setups[i]
        target = episode.targets[index]
        self._remaining[i] = len(episode.targets) - index
        self._target[i] = world.tomatoes[target, :3] + disturbance.target
        self._goal[i], self._radius[i] = world.goal(target)
        self._ignored[i] = NO_TOMATO if self._observe.target_is_obstacle else target
        if self._waypoints is not None:
            center = self._frame[i, :3] + self._axes[i] @ self._target[i]
            goals = GoalSampler(world.roadmaps.compiled, target, start, center)
            self._waypoints.begin(i, world.roadmaps.roadmap(goals))

    def close(self) -> None:
        """Free the cameras."""
        for part in (self._rig, self._task_camera):
            if part is not None:
                part.close()
        self._rig = self._task_camera = None

    def look(
        self,
        ids: Ids | slice,
        physics: AnyPhysics,
        contacts: Contacts,
        steps: npt.NDArray[np.int64],
        memory: Mapping[str, Array],
    ) -> State:
        """Return the state of some simulations, without the outcome of the task.

        Args:
            ids: Indices of k of the n simulations.
            physics: All simulations.
            contacts: Contacts of the k simulations.
            steps: (n,) steps of the episodes so far.
            memory: The task's memory of the k simulations.
        """
        frame = self._frame[ids]
        sites, tool = physics.sites(ids)
        vectors = np.concatenate([sites - frame[:, None, :3], tool[:, None, :, 2]], axis=1) @ self._axes[ids]
        points, axis = vectors[:, :-1], vectors[:, -1]
        fields = self._fields(ids, physics)
        distance, direction = fields.lookup(points[:, 1:])
        joints = physics.qpos[ids]
        command_error = physics.command[ids] - joints
        waypoint, path_length, path_free = self._paths(ids, physics.command, steps)
        target, goal, radius = self._target[ids].copy(), self._goal[ids].copy(), self._radius[ids]
        plants = dict(physics.felt(ids))
        if plants:  # the fruit in work is the target, wherever it hangs now
            origin, axes = frame[:, None, :3], self._axes[ids]
            for name in ("fruit", "joint", "crate"):
                plants[name] = ((plants[name][:, None] - origin) @ axes)[:, 0]
            plants["force"] = (plants["force"][:, None] @ axes)[:, 0]
            target, goal, radius = plants["fruit"].copy(), plants["fruit"].copy(), plants["radius"][:, None]
        images = self._render_images(ids, physics, frame, sites[:, 0], tool)
        return State(
            joints=joints + self._joint_offset[ids],
            velocities=physics.qvel[ids].copy(),
            command_error=command_error,
            tip=points[:, 0],
            axis=axis,
            grasp=points[:, 0] + radius * axis,
            target=target,
            goal=goal,
            remaining=self._remaining[ids].copy(),
            clearance=distance - self._probe_radii,
            obstacle=direction,
            waypoint=waypoint,
            path_length=path_length,
            path_free=path_free,
            unknown=self._unknown_at(ids, sites[:, 1:]),
            depth=images.depth,
            color=images.color,
            views=images.views,
            fields=fields,
            plants=plants,
            contacts=contacts.counts,
            collided=contacts.collided,
            distance=self._unset[: len(points)],
            success=self._false[: len(points)],
            failure=self._false[: len(points)],
            memory=memory,
        )

    def _fields(self, ids: Ids | slice, physics: AnyPhysics) -> FieldsOfSimulations:
        """Return the distance fields around some arms, which move on with a cart."""
        slots, along = self._field[ids].copy(), self._unmoved[ids]
        if self._robot.on_rail:
            stops = np.rint(physics.qpos[ids, 0] / STOP).astype(np.int64)
            along = STOP * stops[:, None, None] * [0.0, 1.0, 0.0]
            chosen = zip(np.arange(self._count)[ids].tolist(), stops.tolist(), strict=True)
            slots = np.array([self._worlds.field(self._setups[i].world, stop) for i, stop in chosen])
        return FieldsOfSimulations(self._worlds.fields, slots, self._ignored[ids].copy(), along)

    def _paths(self, ids: Ids | slice, command: Array, steps: npt.NDArray[np.int64]) -> tuple[Array, Array, Bools]:
        """Return waypoint offsets (k, j) from the commands, path lengths (k,), and whether the motion is free (k,).

        Args:
            ids: Indices of k of the n simulations.
            command: (n, j) commanded joint positions, radians.
            steps: (n,) steps of the episodes so far.
        """
        tracker = self._waypoints
        if tracker is None:
            return self._nothing[ids], self._unset[ids], self._false[ids]
        observed = command[ids] + self._joint_offset[ids]
        tracker.update(np.arange(self._count)[ids], observed, steps[ids])
        return tracker.configuration[ids] - observed, tracker.cost_to_go[ids].copy(), tracker.free[ids].copy()

    def _unknown_at(self, ids: Ids | slice, probes: Array) -> Bools:
        """Return a mask (n, k) of the probe points (n, k, 3) in unobserved space; k is 0 unless required."""
        if not self._observe.requires_occupancy:
            return self._false[ids, None][:, :0]
        unknown = np.empty(probes.shape[:2], dtype=np.bool_)
        for k, i in enumerate(np.arange(self._count)[ids]):
            occupancy = self._setups[i].episode.scene.occupancy
            assert occupancy is not None
            unknown[k] = ~occupancy.is_known(probes[k])
        return unknown

    def _render_images(self, ids: Ids | slice, physics: AnyPhysics, frame: Array, tip: Array, tool: Array) -> Images:
        """Return the images of the cameras of some simulations."""
        cameras = self._observe.cameras
        if not cameras:
            return self._no_images.first(len(tip))
        setups = [self._setups[i] for i in np.arange(self._count)[ids]]
        if self._rig is None:
            compiled = self._setups[0].world.compiled
            shows = self._observe.renders_arm, self._observe.renders_color
            self._rig = CameraRig(cameras, compiled, self._threads, *shows)
        noises = [setup.disturbance.noise for setup in setups]
        models = [physics.models[i] for i in np.arange(self._count)[ids]]
        plants = [physics.plants(i) for i in np.arange(self._count)[ids]]
        return self._rig.render(models, physics.qpos[ids], frame, tip, tool, noises, plants, self.images_due[ids])

    def take_views(self, ids: Ids, physics: AnyPhysics) -> list[View]:
        """Take a view with the camera of the task in some simulations."""
        setups = [self._setups[i] for i in ids]
        if self._task_camera is None:
            assert self._camera is not None
            self._task_camera = TaskCamera(self._camera, setups[0], self._threads)
        sites, tool = physics.sites(ids)
        models = [physics.models[i] for i in ids]
        return self._task_camera.take(models, physics.qpos[ids], self._frame[ids], sites[:, 0], tool, setups)
