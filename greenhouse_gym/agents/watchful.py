"""An agent that knows the scan and observes unknown space with the camera at its wrist before it moves there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.agents.agent import JointAgent, Problem, action_towards
from greenhouse_gym.agents.goal_choice import load_policy
from greenhouse_gym.agents.local_map import LocalMap
from greenhouse_gym.agents.occupancy_map import wrist_reading
from greenhouse_gym.agents.shield import ShieldedAgent
from greenhouse_gym.agents.viewpoints import DEPTHS, NOISY_DEPTHS, initial_view, viewpoints, visible
from greenhouse_gym.agents.watchful_paths import (
    VOXELS,
    Paths,
    PlannedPaths,
    RehearsedPaths,
    checker_for,
    compiled_for,
)
from greenhouse_gym.envs.image_observations import DepthObservation
from greenhouse_gym.errors import InvalidValueError, check_flag, check_items
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.caution import (
    CautionLevel,
    apply_caution,
    check_margin,
)
from greenhouse_gym.motion.roadmap import REACHED, RESOLUTION
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene import Scene

CAUTION_DEPTHS = (0.1, 0.15, 0.2, float("inf"))
"""Depths in unknown space that are tried in turn, metres. With none at all, no path led to any of 15 tomatoes."""

MAX_PLANS, MAX_LOOKS = 10, 4
"""Largest number of plans in an episode, and of motions to observe unknown space."""

EXTRA_PLANS = 4
"""Further plans in which the points that the camera has observed replace the boxes of the scan that it has examined:
boxes may be larger than the leaves they stand for. In the latter half of them, all unknown space is free."""

FREE_PLANS = 4
"""Number of last retries in which all unknown space is free, once there is nothing left to look at."""

DEPTH, IMAGE = 0.05, (128, 96)
"""Preferred depth in unknown space, metres, about a voxel of the occupancy; and width and height of the camera's
images, pixels. Their rays are 7 mm apart at half a metre: thinner parts may hang unobserved between them."""

_EVERY = 2  # steps between images
_MAX_VIEWPOINTS = 60  # whose motions are checked
_MIN_UNOBSERVED = 6  # points on a path that are worth a look
_SAME = 0.05  # metres: points so near to those of an earlier look are not looked at again
_INITIAL_POINT = np.array([1.0, 0.5, 0.5])  # the initial view is of the target's position, scaled by this


class WatchfulAgent(JointAgent):
    """Follow paths through observed space, and observe unknown space on them before entering it.

    It begins with a view of the plants. If its path leads through space that neither the scan nor its camera has
    observed, it first moves to where its camera sees that space, if there is such a viewpoint and it has looked fewer
    than `MAX_LOOKS` times, and plans again. Points on its images that the scan does not explain are obstacles: when one
    blocks the rest of its path, it plans again from where it is. Where the roadmap has no path to the target, it plans
    with RRTConnect, which needs OMPL. After `MAX_PLANS` plans without success it trusts its camera more than the boxes
    of the scan, and after `EXTRA_PLANS` further ones it holds still.

    Args:
        margin: Distance kept from boxes of clutter if possible, metres; leaves reach beyond their boxes, see
            `greenhouse_gym.motion.caution.with_margin`. Otherwise half of it is kept, then none.
        unexplained: Whether it avoids unexplained occupied cells if possible, and looks at them as at unknown space;
            see `greenhouse_gym.motion.caution.with_unexplained_cells`.
        depth: Preferred depth in unknown space, metres.
        image: Width and height of its camera's images, pixels.
        noisy: Whether its images have the noise of a D435, as with ``Randomization(depth_noise=True)``.
        policy: Policy whose motions it rehearses behind the shield instead of planning, as `load_policy` takes it: one
            with joint actions and the observation "state".

    Raises:
        InvalidValueError: A negative margin or depth, an image without a width and a height of a pixel or more, or a
            policy with other actions or another observation.

    Attributes:
        env_options: Puts the camera's images into the observation.
        status: Number of plans in the last episode, and the depth in unknown space that the last one allows, metres:
            "inf" if unknown space is free.
    """

    name = "watchful"

    def __init__(
        self,
        margin: float = 0.0,
        unexplained: bool = True,
        depth: float = DEPTH,
        image: tuple[int, int] = IMAGE,
        noisy: bool = False,
        policy: str | Path | None = None,
    ) -> None:
        if not (isinstance(depth, int | float | np.floating) and depth >= 0):
            raise InvalidValueError(f"depth must be 0 m or more, got {depth!r}")
        size = check_items("image", image, "a width and a height, pixels")
        if len(size) != 2:
            raise InvalidValueError(f"image must be a width and a height, pixels, got {image!r}")
        check_flag("unexplained", unexplained)
        check_flag("noisy", noisy)
        self.status = ""
        options: Mapping[str, Any] = JointAgent.env_options
        self._policy = None if policy is None else _shielded(policy)
        if self._policy is not None:
            self.name = f"{self.name}-{self._policy.name}"
            self.takes_other_actions, options = False, self._policy.env_options
        self._levels = caution_levels(check_margin(margin), unexplained, depth)
        self._heed_unexplained, self._noisy = unexplained, noisy
        self.env_options: Mapping[str, Any] = {
            **options, "observation": DepthObservation(DepthCamera("wrist", *size)),
        }  # fmt: skip
        self._problem: Problem | None = None
        self._episode: _Episode | None = None

    def _paths(self, problem: Problem) -> Paths:
        if self._policy is None:
            return PlannedPaths(problem, self._levels, self._heed_unexplained)
        return RehearsedPaths(problem, self._levels, self._policy)

    def reset(self, problem: Problem) -> None:
        """Forget the last episode."""
        self._problem, self._episode, self.status = problem, None, ""

    @property
    def reads_images(self) -> bool:
        """Return whether it reads the next image."""
        return self._episode is None or self._episode.reads_images

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """Return the next action, (joints,)."""
        if self._problem is None:
            raise RuntimeError("reset the agent before it acts")
        reading = wrist_reading(observation, self._problem.robot)
        if self._episode is None:
            height, width = reading.depth.shape
            camera = DepthCamera(width=width, height=height)
            self._episode = _Episode(
                self._problem, reading.target, camera, self._levels, self._paths(self._problem), self._heed_unexplained,
                self._noisy,
            )  # fmt: skip
        action = self._episode.act(reading.depth, reading.joints, reading.command)
        self.status = self._episode.status
        return action


class _Episode:
    """State of the agent in one episode; it begins with the first observation."""

    def __init__(
        self,
        problem: Problem,
        target: Array,
        camera: DepthCamera,
        levels: Sequence[CautionLevel],
        paths: Paths,
        unexplained: bool,
        noisy: bool = False,
    ):
        self.status, self._levels, self._paths = "", levels, paths
        self._problem, self._arm = problem, arm_spheres(problem.robot)
        self._map = LocalMap(problem, target, camera, unexplained, noisy)
        self._depths = NOISY_DEPTHS if noisy else DEPTHS
        self._path, self._trail = self._initial_path(target), [problem.start]
        self._looking, self._stuck, self._age, self._plans, self._looks = True, False, 0, 0, 0
        self.reads_images = True
        self._looked_at: Array = np.zeros((0, 3))
        self._rng = np.random.default_rng(problem.seed)

    def _initial_path(self, target: Array) -> list[Array]:
        """Return the configuration with the plants in view; empty if the scan has something in the way."""
        problem = self._problem
        checker = checker_for(problem, compiled_for(problem, problem.scene), 0.0)
        view = initial_view(self._arm, problem.robot, problem.start, _INITIAL_POINT * target)
        return [view] if checker.motion_is_free(problem.start, view, RESOLUTION) else []

    def act(self, depth: npt.NDArray[np.float32], joints: Array, command: Array) -> npt.NDArray[np.float32]:
        """Return the next action, (joints,)."""
        while self._path and np.abs(self._path[0] - command).max() < REACHED / 10:
            self._arrive(self._path.pop(0))
        arrived = self._looking and not self._path
        added = (arrived or self._age % _EVERY == 0) and self._map.add(depth, joints)
        blocked = added and self._path and self._map.blocked(self._remaining(command), self._plans <= MAX_PLANS)
        if arrived or blocked:
            self._replan(command)
        elif self._stuck:
            self._retry(command)
        self._age += 1
        steps = self._problem.joint_steps
        self.reads_images = self._age % _EVERY == 0 or (self._looking and self._may_arrive(command, steps))
        if not self._path:
            return np.zeros(len(command), dtype=np.float32)
        return action_towards(self._path[0], command, steps).astype(np.float32)

    def _may_arrive(self, command: Array, steps: Array) -> bool:
        """Return whether the next action may lead to the end of the path."""
        return not self._path or bool((np.abs(self._path[-1] - command) < 2 * steps).all())

    def _arrive(self, configuration: Array) -> None:
        """Add a configuration (j,) to the trail from the start, or go back on the trail to it."""
        before = [k for k, each in enumerate(self._trail) if each is configuration]
        self._trail = self._trail[: before[0] + 1] if before else [*self._trail, configuration]

    def _replan(self, command: Array) -> None:
        """Plan a path to the target; if it leads through unobserved space, one to a viewpoint of that space."""
        self._path, self._looking, self._stuck = [], False, self._plans >= MAX_PLANS
        if self._stuck:
            return
        self._plans += 1
        self._path, scene, level = self._paths.find(partial(self._map.scene, command), command, self._trail[::-1])
        self._report(level)
        if self._path:
            unobserved = self._map.unobserved(self._remaining(command))
        else:
            unobserved = self._map.unobserved_around_target()
        if len(unobserved) and len(self._looked_at):
            unobserved = unobserved[cKDTree(self._looked_at).query(unobserved)[0] > _SAME]
        if len(unobserved) >= _MIN_UNOBSERVED and self._looks < MAX_LOOKS:
            self._look(scene, command, unobserved)
        self._stuck = not self._path

    def _retry(self, command: Array) -> None:
        """Plan with other goals and another seed where there was no path and there is nothing to look at."""
        self._stuck = False
        if self._plans == MAX_PLANS + EXTRA_PLANS:
            return
        self._plans += 1
        extra = self._plans - MAX_PLANS
        free = -FREE_PLANS < extra <= 0 or extra > EXTRA_PLANS // 2
        level = self._levels[-1] if free else self._levels[-2]
        scene = self._map.scene(command, VOXELS[-1], boxes=extra <= 0)
        seed = self._problem.seed + self._plans
        self._path = self._paths.find_again(scene, command, self._trail[::-1], seed, level)
        self._report(level)
        self._stuck = not self._path

    def _report(self, level: CautionLevel) -> None:
        """Set the status."""
        depth = np.inf if self._problem.scene.occupancy is None else level.depth
        self.status = f"{self._plans}, {depth:g}" if self._path else f"{self._plans}, no path"

    def _look(self, scene: Scene, command: Array, points: Array) -> None:
        """Go to the viewpoint that shows most of points (k, 3), if a free motion leads to one."""
        robot = self._problem.robot
        self._looks += 1
        checker = checker_for(self._problem, apply_caution(scene, robot, command, self._levels[0]))
        sees = partial(visible, self._arm, points=points, opaque=self._map.occupied, depths=self._depths)
        found = viewpoints(robot, command, sees, self._rng)
        for viewpoint, seen in islice(found, _MAX_VIEWPOINTS):
            if checker.is_free(viewpoint) and checker.inside_is_free(command, viewpoint, RESOLUTION):
                self._path, self._looking = [viewpoint], True
                self._looked_at = np.concatenate([self._looked_at, points[seen]])
                return

    def _remaining(self, command: Array) -> Array:
        """Return configurations (m, j) along the rest of the path from a configuration (j,), its end included."""
        corners = np.array([command, *self._path])
        counts = np.ceil(np.abs(np.diff(corners, axis=0)) @ self._arm.checker.reaches / RESOLUTION).astype(int) + 1
        segments = [
            a + np.linspace(0, 1, count, endpoint=False)[:, None] * (b - a)
            for (a, b), count in zip(pairwise(corners), counts, strict=True)
        ]
        return np.concatenate([*segments, corners[-1:]])


def _shielded(policy: str | Path) -> ShieldedAgent:
    agent = load_policy(policy)
    given = tuple(agent.env_options.get(name) for name in ("observation", "action"))
    if given != ("state", "joint"):
        raise InvalidValueError(
            f"only a policy with observation='state' and action='joint' can be rehearsed, {policy} has {given}"
        )
    return ShieldedAgent(agent, agent.name)


def caution_levels(margin: float, unexplained: bool, depth: float) -> list[CautionLevel]:
    """Return the caution levels that the agent tries, the most cautious first.

    Args:
        margin: Distance kept from boxes at first, metres.
        unexplained: Whether unexplained occupied cells are avoided at first.
        depth: Depth in unknown space at first, metres.
    """
    shallow, *_, deep, free = CAUTION_DEPTHS
    if margin:
        limits = [(margin, shallow), (margin, deep), (margin / 2, deep), (0.0, deep), (0.0, free)]
    else:
        limits = [(0.0, each) for each in ((shallow, deep, free) if unexplained else CAUTION_DEPTHS)]
    levels = [CautionLevel(*limit) for limit in limits]
    if unexplained:
        levels = [*(level._replace(unexplained=True) for level in levels), *(levels[-2:] if margin else levels)]
    return list(dict.fromkeys([CautionLevel(margin, depth, unexplained), *levels]))
