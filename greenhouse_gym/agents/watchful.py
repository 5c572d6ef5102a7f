"""An agent that knows the scan and observes unknown space with the camera at its wrist before it moves there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice, pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.agents.agent import JointAgent, Problem, action_towards
from greenhouse_gym.agents.local_map import LocalMap
from greenhouse_gym.agents.occupancy_map import wrist_reading
from greenhouse_gym.agents.viewpoints import DEPTHS, NOISY_DEPTHS, initial_view, viewpoints, visible
from greenhouse_gym.envs.image_observations import DepthObservation
from greenhouse_gym.errors import InvalidValueError, check_flag, check_items
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import arm_spheres
from greenhouse_gym.motion.caution import (
    CautionLevel,
    apply_caution,
    cautious_roadmap,
    check_margin,
    unexplained_cells,
    with_unexplained_cells,
)
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.goals import MAX_BATCHES, MAX_GOALS, GoalSampler, nearest_free_goals
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.roadmap import REACHED, RESOLUTION, ROADMAP_MARGIN
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.planning import plan
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene import CompiledScene, Scene

CAUTION_DEPTHS = (0.1, 0.15, 0.2, float("inf"))
"""Depths in unknown space that are tried in turn, metres. With none at all, no path led to any of 15 tomatoes."""

MAX_PLANS, MAX_LOOKS = 10, 4
"""Largest number of plans in an episode, and of motions to observe unknown space."""

EXTRA_PLANS = 4
"""Further plans in which the points that the camera has observed replace the boxes of the scan that it has examined:
boxes may be larger than the leaves they stand for. In the latter half of them, all unknown space is free."""

VOXELS = (0.01, 0.004)
"""Sides of the voxels that cover observed points, metres: the next is tried if the roadmap has no path with the one
before."""

MAX_CHECKS, NUM_GOALS, FREE_PLANS = 30_000, 60, 4
"""RRTConnect is used where the roadmap has no path: first from the current configuration, then from the start, to which
the arm goes back the way it came. These are its collision checks, the goals that are sampled for each retry, with
another seed, once there is nothing left to look at, and the number of last retries in which all unknown space is free.
"""

DEPTH, IMAGE = 0.05, (128, 96)
"""Preferred depth in unknown space, metres, about a voxel of the occupancy; and width and height of the camera's
images, pixels. Their rays are 7 mm apart at half a metre: thinner parts may hang unobserved between them."""

_NO_CAUTION = (CautionLevel(0.0, np.inf, unexplained=True), CautionLevel(0.0, np.inf))
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

    Raises:
        InvalidValueError: A negative margin or depth, or an image without a width and a height of a pixel or more.

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
    ) -> None:
        if not (isinstance(depth, int | float | np.floating) and depth >= 0):
            raise InvalidValueError(f"depth must be 0 m or more, got {depth!r}")
        size = check_items("image", image, "a width and a height, pixels")
        if len(size) != 2:
            raise InvalidValueError(f"image must be a width and a height, pixels, got {image!r}")
        check_flag("unexplained", unexplained)
        check_flag("noisy", noisy)
        self.status = ""
        self._levels = caution_levels(check_margin(margin), unexplained, depth)
        self._heed_unexplained, self._noisy = unexplained, noisy
        self.env_options: Mapping[str, Any] = {
            **JointAgent.env_options, "observation": DepthObservation(DepthCamera("wrist", *size)),
        }  # fmt: skip
        self._problem: Problem | None = None
        self._episode: _Episode | None = None

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
                self._problem, reading.target, camera, self._levels, self._heed_unexplained, self._noisy
            )
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
        unexplained: bool,
        noisy: bool = False,
    ):
        self.status, self._levels, self._heed_unexplained = "", levels, unexplained
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
        checker = self._checker(self._compiled(problem.scene), 0.0)
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
        scene, level = self._plan(command)
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
        self._path = self._search(scene, command, NUM_GOALS, self._problem.seed + self._plans, level)
        self._report(level)
        self._stuck = not self._path

    def _report(self, level: CautionLevel) -> None:
        """Set the status."""
        depth = np.inf if self._problem.scene.occupancy is None else level.depth
        self.status = f"{self._plans}, {depth:g}" if self._path else f"{self._plans}, no path"

    def _plan(self, command: Array) -> tuple[Scene, CautionLevel]:
        """Plan a path to the target; return the scene as it is known and the caution level of the path."""
        problem = self._problem
        goals = GoalSampler(self._compiled(problem.scene), problem.target, command)
        for voxel in VOXELS:
            scene = self._map.scene(command, voxel)
            roadmap, level = cautious_roadmap(scene, problem.robot, goals, self._levels)
            self._path = roadmap.path(command)
            if self._path:
                return scene, level
        checker = self._checker(self._compiled(scene))
        free = nearest_free_goals(checker, goals, MAX_GOALS, MAX_BATCHES)
        avoid_surfaces = self._heed_unexplained and bool(unexplained_cells(scene).any())
        for level in (_NO_CAUTION if avoid_surfaces else _NO_CAUTION[1:]) if len(free) else ():
            self._path = self._search(scene, command, free, problem.seed, level)
            if self._path:
                return scene, level
        return scene, _NO_CAUTION[-1]

    def _search(self, scene: Scene, command: Array, goals: Array | int, seed: int, level: CautionLevel) -> list[Array]:
        """Search with RRTConnect for a path to goals (k, j), or to a number of goals that it samples."""
        problem = self._problem
        unknown: str | float = "free" if scene.occupancy is None or np.isinf(level.depth) else level.depth
        known = with_unexplained_cells(scene, problem.robot, command) if level.unexplained else scene
        for back in ([], self._trail[::-1]):
            path = plan(
                known, problem.target, problem.robot, start=back[-1] if back else command, goals=goals, time_limit=None,
                max_checks=MAX_CHECKS, seed=seed, unknown=unknown, margin=level.margin,
            ).path  # fmt: skip
            if path is not None:
                return [*back, *path[1:]]
        return []

    def _look(self, scene: Scene, command: Array, points: Array) -> None:
        """Go to the viewpoint that shows most of points (k, 3), if a free motion leads to one."""
        robot = self._problem.robot
        self._looks += 1
        checker = self._checker(apply_caution(scene, robot, command, self._levels[0]))
        sees = partial(visible, self._arm, points=points, opaque=self._map.occupied, depths=self._depths)
        found = viewpoints(robot, command, sees, self._rng)
        for viewpoint, seen in islice(found, _MAX_VIEWPOINTS):
            if checker.is_free(viewpoint) and checker.inside_is_free(command, viewpoint, RESOLUTION):
                self._path, self._looking = [viewpoint], True
                self._looked_at = np.concatenate([self._looked_at, points[seen]])
                return

    def _compiled(self, scene: Scene) -> CompiledScene:
        """Return a scene in which all unknown space is free; the last ones are cached."""
        return guarded(scene, self._problem.robot, self._problem.start, np.inf)

    def _checker(self, compiled: CompiledScene, margin: float = ROADMAP_MARGIN) -> CollisionChecker:
        return search_checker(planning_model(compiled, self._problem.target, margin), arm_reaches(compiled.robot))

    def _remaining(self, command: Array) -> Array:
        """Return configurations (m, j) along the rest of the path from a configuration (j,), its end included."""
        corners = np.array([command, *self._path])
        counts = np.ceil(np.abs(np.diff(corners, axis=0)) @ self._arm.checker.reaches / RESOLUTION).astype(int) + 1
        segments = [
            a + np.linspace(0, 1, count, endpoint=False)[:, None] * (b - a)
            for (a, b), count in zip(pairwise(corners), counts, strict=True)
        ]
        return np.concatenate([*segments, corners[-1:]])


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
