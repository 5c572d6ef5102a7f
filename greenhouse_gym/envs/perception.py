"""What n simulations of the reaching task look like: where base and target are in each, and what follows from that."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.executors import usable_cores
from greenhouse_gym.envs.clearance_rays import NUM_CLEARANCES, clearance_rays
from greenhouse_gym.envs.episodes import Episode
from greenhouse_gym.envs.observations import ObservationSpec
from greenhouse_gym.envs.physics import Physics
from greenhouse_gym.envs.randomization import Disturbance
from greenhouse_gym.envs.reach_task import Bools, State, lengths
from greenhouse_gym.envs.stepping import Ids
from greenhouse_gym.envs.worlds import World, Worlds
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import NO_TOMATO
from greenhouse_gym.motion.goals import GoalSampler
from greenhouse_gym.motion.waypoints import WaypointTracker
from greenhouse_gym.rendering.cameras import CameraRig, Images, no_images
from greenhouse_gym.robots import Robot


class Perception:
    """Makes the states of n simulations out of their kinematics, in the base frame of each.

    Args:
        count: Number of simulations n.
        robot: The arm.
        observe: What is observed; only what it asks for is looked at.
        worlds: The worlds that episodes are in.
        success_radius: How near the grasp point must come, metres.
        requires_roadmap: Whether it is told where the arm can go straight.
        threads: Threads of the cameras; 0 uses all cores.
    """

    def __init__(
        self,
        count: int,
        robot: Robot,
        observe: ObservationSpec,
        worlds: Worlds,
        success_radius: float,
        requires_roadmap: bool,
        threads: int,
    ):
        self._count, self._robot, self._observe, self._worlds = count, robot, observe, worlds
        self._success_radius, self._threads = success_radius, threads
        self._rig: CameraRig | None = None
        self._no_images = no_images(count)
        self._probe_radii = robot.probe_radii.astype(np.float32)
        self._first: World | None = None
        self._episodes: list[Episode | None] = [None] * count
        self._disturbances: list[Disturbance | None] = [None] * count
        self._joint_offset = np.zeros((count, len(robot.joints)))
        self._field, self._ignored = np.zeros((2, count), dtype=np.int64)
        self._frame = np.zeros((count, 5))  # base position and cosine, sine of its heading
        self._axes = np.zeros((count, 3, 3))  # columns: the axes of the base frame in the scene
        self._target = np.zeros((count, 3))  # as told, in the base frame
        self._goal = np.zeros((count, 3))  # what counts, in the base frame
        self._radius = np.zeros((count, 1))
        self._clearance_rays = np.empty(
            (count, NUM_CLEARANCES if observe.requires_clearance_rays else 0), dtype=np.float32
        )
        self._waypoints = WaypointTracker(count, len(robot.joints)) if requires_roadmap else None

    def __deepcopy__(self, memo: dict[int, Any]) -> Perception:
        """The same, without cameras until they are needed."""
        twin = memo[id(self)] = object.__new__(Perception)
        twin.__dict__ = copy.deepcopy({**self.__dict__, "_rig": None}, memo)
        return twin

    @property
    def heading(self) -> Array:
        """(n, 2) cosine and sine of the heading of each base, live."""
        return self._frame[:, 3:]

    def begin(self, i: int, episode: Episode, world: World, disturbance: Disturbance) -> None:
        """Make ready for a new episode of a simulation."""
        self._episodes[i], self._disturbances[i] = episode, disturbance
        if i == 0:
            self._first = world
        self._joint_offset[i] = disturbance.joints
        self._field[i] = world.field
        self._frame[i] = world.frame
        cosine, sine = world.frame[3:]
        self._axes[i] = [[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]]
        self._target[i] = world.tomatoes[episode.target, :3] + disturbance.target
        self._goal[i], self._radius[i] = world.goal(episode.target)
        self._ignored[i] = NO_TOMATO if self._observe.target_is_obstacle else episode.target
        if self._observe.requires_clearance_rays:
            self._clearance_rays[i] = clearance_rays(
                self._worlds.fields, world.field, self._ignored[i], self._target[i]
            )
        if self._waypoints is not None:
            center = self._frame[i, :3] + self._axes[i] @ self._target[i]
            goals = GoalSampler(world.roadmaps.compiled, episode.target, episode.start, center)
            self._waypoints.begin(i, world.roadmaps.roadmap(goals))

    def close(self) -> None:
        """Free the cameras."""
        if self._rig is not None:
            self._rig.close()
        self._rig = None

    def look(self, ids: Ids | slice, physics: Physics, collided: npt.ArrayLike, steps: npt.NDArray[np.int64]) -> State:
        """The state of some simulations from their current kinematics.

        Args:
            ids: Which of the n simulations, k of them.
            physics: All simulations.
            collided: (k,) whether something was touched that must not be.
            steps: (n,) steps of the episodes so far.
        """
        frame = self._frame[ids]
        sites, tool = physics.sites(ids)
        vectors = np.concatenate([sites - frame[:, None, :3], tool[:, None, :, 2]], axis=1) @ self._axes[ids]
        points, axis = vectors[:, :-1], vectors[:, -1]
        grasp = points[:, 0] + self._radius[ids] * axis
        gap = self._goal[ids] - grasp
        distance, direction = self._worlds.fields.lookup(self._field[ids], self._ignored[ids], points[:, 1:])
        joints = physics.qpos[ids]
        command = physics.command[ids] + self._joint_offset[ids]
        waypoint, path_length, path_free = self._waypoints_of(ids, command, steps[ids])
        pictures = self._render_images(ids, physics, frame, sites[:, 0], tool)
        away = lengths(gap)
        collided = np.asarray(collided, dtype=np.bool_)
        return State(
            joints=joints + self._joint_offset[ids],
            velocities=physics.qvel[ids].copy(),
            command_error=physics.command[ids] - joints,
            tip=points[:, 0],
            axis=axis,
            grasp=grasp,
            target=self._target[ids].copy(),
            distance=away,
            clearance=distance - self._probe_radii,
            obstacle=direction,
            clearance_rays=self._clearance_rays[ids].copy(),
            waypoint=waypoint,
            path_length=path_length,
            path_free=path_free,
            collided=collided,
            success=(away < self._success_radius) & ~collided,
            unknown=self._unknown_at(ids, sites[:, 1:]),
            depth=pictures.depth,
            color=pictures.color,
            views=pictures.views,
        )

    def _waypoints_of(
        self, ids: Ids | slice, command: Array, steps: npt.NDArray[np.int64]
    ) -> tuple[Array, Array, Bools]:
        """Return waypoint offsets (k, j) from the commands, path lengths (k,), and whether the motion is free (k,)."""
        if self._waypoints is None:
            n = len(command)
            return np.empty((n, 0)), np.full(n, np.nan), np.zeros(n, dtype=np.bool_)
        tracker = self._waypoints
        tracker.update(np.arange(self._count)[ids], command, steps)
        return tracker.configuration[ids] - command, tracker.cost_to_go[ids].copy(), tracker.free[ids].copy()

    def _unknown_at(self, ids: Ids | slice, probes: Array) -> Bools:
        """Return (n, k) whether probe points (n, k, 3) lie in unobserved space; k is 0 unless required."""
        if not self._observe.requires_occupancy:
            return np.empty((len(probes), 0), dtype=np.bool_)
        unknown = np.empty(probes.shape[:2], dtype=np.bool_)
        for k, i in enumerate(np.arange(self._count)[ids]):
            episode = self._episodes[i]
            assert episode is not None
            assert episode.scene.occupancy is not None
            unknown[k] = ~episode.scene.occupancy.is_known(probes[k])
        return unknown

    def _render_images(self, ids: Ids | slice, physics: Physics, frame: Array, tip: Array, tool: Array) -> Images:
        """What the cameras of some simulations see."""
        cameras = self._observe.cameras
        if not cameras:
            return self._no_images.first(len(tip))
        if self._rig is None:
            threads = 1 if self._count == 1 else self._threads or usable_cores()
            assert self._first is not None
            self._rig = CameraRig(
                cameras, self._first.compiled, threads, self._observe.renders_arm, self._observe.renders_color
            )
        chosen = np.arange(self._count)[ids]
        noises = [None if drawn is None else drawn.noise for drawn in (self._disturbances[i] for i in chosen)]
        models = [physics.models[i] for i in chosen]
        return self._rig.render(models, physics.qpos[ids], frame, tip, tool, noises)
