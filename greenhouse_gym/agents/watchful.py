"""An agent that knows the scan, and looks with the camera at its wrist at what the scan does not show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.careful import CAREFUL_DEPTHS, Care, cared, careful_ways, ends_of
from greenhouse_gym.agents.guide import towards
from greenhouse_gym.agents.judging import between
from greenhouse_gym.agents.knowledge import Knowledge
from greenhouse_gym.agents.sight_map import sensed
from greenhouse_gym.agents.views import DEPTHS, NOISY_DEPTHS, views
from greenhouse_gym.envs.image_observations import DepthObservation
from greenhouse_gym.envs.waypoints import GOALS, MARGIN, MAX_ROUNDS, REACHED, Ways, free_goals
from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.approaches import FRONT, glance
from greenhouse_gym.motion.arm_spheres import arm_balls
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.margins import check_margin
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.motion.roadmap import RESOLUTION
from greenhouse_gym.motion.unexplained_cells import unexplained_cells, with_unexplained_cells
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.planning import plan
from greenhouse_gym.rendering.cameras import DepthCamera
from greenhouse_gym.scene import Scene, compile_scene

PLANS, LOOKS = 10, 4
"""How many times the agent looks for a way in an episode at most, and for what nobody has seen on its way."""

MORE = 4
"""How many times it looks for a way after that, with what its camera has shown in place of those of the scan's boxes
that it has looked at: boxes may be larger than the leaves that they stand for. In the latter half of these plans, all
unknown space is free."""

VOXELS = (0.01, 0.004)
"""Sides of the voxels that stand for what only the camera has shown, metres: the next where the one before leaves no
way of a few straight motions."""

CHECKS, ANY_GOALS, FREE = 30_000, 60, 4
"""Collision checks of RRTConnect, which is asked where there is no way of a few straight motions: for one from where
the arm is, and where it finds none, for one from the start, to which the arm goes back as it came. Once there is
nothing left to look at either, it is asked again and again, each time with so many other goals and another seed, and in
the last so many plans with all unknown space free."""

DEPTH, IMAGE = 0.05, (128, 96)
"""How deep the agent goes into unknown space where it can do with that, metres, about a voxel of what a scan saw; and
width and height of its camera's images, pixels, whose rays are 7 mm apart at half a metre: what is thinner may hang
unknown between them."""

_ANY_WAY = (Care(0.0, np.inf, unexplained=True), Care(0.0, np.inf))
_EVERY = 2  # steps between images
_MOTIONS = 30  # motions of a way at most
_TRIED = 60  # views to which it looks for a free motion
_ENOUGH, _SAME = 6, 0.05  # unknown places on a way that are worth a look; metres about those that a look did not show


class WatchfulAgent:
    """Takes ways as `CarefulAgent` does, once it has looked at what nobody has seen on them.

    It begins with a glance at the plants. While its way leads through space that neither the scan nor its camera has
    seen, it first goes where its camera can look there, if it finds such a place and has not looked `LOOKS` times, and
    looks for a way anew. What its images show where the scan has no shape is an obstacle: when one is in the rest of
    its way, it looks for another from where it is. Where no few straight motions lead to the target, it asks
    RRTConnect, and fails if OMPL is not installed. Once it has planned `PLANS` times in vain, it believes its camera
    rather than the scan's boxes, and after `MORE` plans of that kind it stays where it is.

    Args:
        margin: How far it keeps from boxes of clutter where there is room, metres: leaves reach farther than a scan
            shows, see `greenhouse_gym.motion.margins`. Where there is none, half of it has to do, and then nothing.
        unexplained: Whether it keeps out of where the scan saw a surface without a shape, if possible, and looks there
            as at what nobody has seen; see `greenhouse_gym.motion.unexplained_cells`.
        depth: How deep it goes into unknown space where it can do with that, metres.
        image: Width and height of its camera's images, pixels.
        noisy: Whether it reads its images as ones with the noise of a D435, as ``Randomization(depth_noise=True)`` has
            them, and not as perfect ones.

    Raises:
        InvalidValueError: A negative margin or depth, or an image that is not a width and a height of a pixel or more.

    Attributes:
        env_options: Has the camera's images in the observation.
        status: How many times it looked for a way in the last episode, and how deep into unknown space the last one may
            lead, metres: "inf" where unknown space is free.
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
        if not depth >= 0:
            raise InvalidValueError(f"depth must be 0 m or more, got {depth!r}")
        if len(image) != 2:
            raise InvalidValueError(f"image must be a width and a height, pixels, got {image!r}")
        self.status = ""
        self._cares = cares_with(check_margin(margin), unexplained, depth)
        self._heed_unexplained, self._noisy = unexplained, noisy
        self.env_options: Mapping[str, Any] = {"observation": DepthObservation(DepthCamera("wrist", *image))}
        self._problem: Problem | None = None
        self._episode: _Episode | None = None

    def reset(self, problem: Problem) -> None:
        """Forget what was seen."""
        self._problem, self._episode, self.status = problem, None, ""

    def act(self, observation: Any) -> npt.NDArray[np.float32]:
        """The next action, (joints,)."""
        if self._problem is None:
            raise RuntimeError("reset the agent before it acts")
        now = sensed(observation, self._problem.robot)
        if self._episode is None:
            height, width = now.depth.shape
            camera = DepthCamera(width=width, height=height)
            self._episode = _Episode(
                self._problem, now.target, camera, self._cares, self._heed_unexplained, self._noisy
            )
        action = self._episode.act(now.depth, now.joints, now.command)
        self.status = self._episode.status
        return action


class _Episode:
    """What the agent does in one episode; it begins with the first observation."""

    def __init__(
        self,
        problem: Problem,
        target: Array,
        camera: DepthCamera,
        cares: Sequence[Care],
        unexplained: bool,
        noisy: bool = False,
    ):
        self.status, self._cares, self._heed_unexplained = "", cares, unexplained
        self._problem, self._arm = problem, arm_balls(problem.robot)
        self._known = Knowledge(problem, target, camera, unexplained, noisy)
        self._depths = NOISY_DEPTHS if noisy else DEPTHS
        self._way, self._came = self._first_glance(target), [problem.start]
        self._looking, self._stuck, self._age, self._plans, self._looks = True, False, 0, 0, 0
        self._looked_at: Array = np.zeros((0, 3))
        self._random = np.random.default_rng(problem.seed)

    def _first_glance(self, target: Array) -> list[Array]:
        """Where the plants come in view before the arm moves among them; nothing where the scan has it blocked."""
        problem = self._problem
        model = planning_model(compile_scene(problem.scene, problem.robot), problem.target, 0.0)
        view = glance(self._arm, problem.robot, problem.start, FRONT * target)
        free = CollisionChecker(model, arm_reaches(problem.robot)).motion_is_free(problem.start, view, RESOLUTION)
        return [view] if free else []

    def act(self, depth: npt.NDArray[np.float32], joints: Array, command: Array) -> npt.NDArray[np.float32]:
        """The next action, (joints,)."""
        while self._way and np.abs(self._way[0] - command).max() < REACHED / 10:
            self._arrive(self._way.pop(0))
        there = self._looking and not self._way
        news = (there or self._age % _EVERY == 0) and self._known.add(depth, joints)
        blocked = news and self._way and self._known.blocked(self._ahead(command), self._plans <= PLANS)
        if there or blocked:
            self._decide(command)
        elif self._stuck:
            self._insist(command)
        self._age += 1
        if not self._way:
            return np.zeros(len(command), dtype=np.float32)
        return towards(self._way[0], command, self._problem.joint_steps).astype(np.float32)

    def _arrive(self, place: Array) -> None:
        """Keep how the arm came to a place (j,) from the start; what it went back on is forgotten."""
        before = [k for k, each in enumerate(self._came) if each is place]
        self._came = self._came[: before[0] + 1] if before else [*self._came, place]

    def _decide(self, command: Array) -> None:
        """Look for a way to the target, and if it is dark, for one to where it can be looked at."""
        self._way, self._looking, self._stuck = [], False, self._plans >= PLANS
        if self._stuck:
            return
        self._plans += 1
        scene, care = self._plan(command)
        self._tell(care)
        dark = self._known.dark(self._ahead(command)) if self._way else self._known.unlooked()
        if len(dark) and len(self._looked_at):
            dark = dark[cKDTree(self._looked_at).query(dark)[0] > _SAME]
        if len(dark) >= _ENOUGH and self._looks < LOOKS:
            self._look(scene, command, dark)
        self._stuck = not self._way

    def _insist(self, command: Array) -> None:
        """Look for any way to the target once more, where there was none and there is nothing to look at."""
        self._stuck = False
        if self._plans == PLANS + MORE:
            return
        self._plans += 1
        scene = self._known.scene(command, VOXELS[-1], boxes=self._plans <= PLANS)
        seed = self._problem.seed + self._plans
        free = PLANS - FREE < self._plans <= PLANS or self._plans > PLANS + MORE // 2
        care = self._cares[-1] if free else self._cares[-2]
        self._way = self._search(scene, command, ANY_GOALS, seed, care)
        self._tell(care)
        self._stuck = not self._way

    def _tell(self, care: Care) -> None:
        """Say how many times was planned, and how careful the way is."""
        depth = np.inf if self._problem.scene.occupancy is None else care.depth
        self.status = f"{self._plans}, {depth:g}" if self._way else f"{self._plans}, no way"

    def _plan(self, command: Array) -> tuple[Scene, Care]:
        """Look for a way to the target: the scene as it is known, and how careful the way through it is."""
        problem = self._problem
        ends = ends_of(problem, command)
        for voxel in VOXELS:
            scene = self._known.scene(command, voxel)
            ways, care = careful_ways(scene, problem.robot, ends, self._cares)
            self._way = _followed(ways, command)
            if self._way:
                return scene, care
        model = planning_model(compile_scene(scene, problem.robot), problem.target, MARGIN)
        goals = free_goals(CollisionChecker(model, arm_reaches(problem.robot)), ends, GOALS, MAX_ROUNDS)
        for care in (
            (_ANY_WAY if self._heed_unexplained and unexplained_cells(scene).any() else _ANY_WAY[1:])
            if len(goals)
            else ()
        ):
            self._way = self._search(scene, command, goals, problem.seed, care)
            if self._way:
                return scene, care
        return scene, _ANY_WAY[-1]

    def _search(self, scene: Scene, command: Array, goals: Array | int, seed: int, care: Care) -> list[Array]:
        """A way of any kind to the target, to goals (k, j) or so many others, by RRTConnect."""
        problem = self._problem
        unknown: str | float = "free" if scene.occupancy is None or np.isinf(care.depth) else care.depth
        known = with_unexplained_cells(scene, problem.robot, command) if care.unexplained else scene
        for back in ([], self._came[::-1]):
            path = plan(
                known, problem.target, problem.robot, start=back[-1] if back else command, goals=goals, time_limit=None,
                max_checks=CHECKS, seed=seed, unknown=unknown, margin=care.margin,
            ).path  # fmt: skip
            if path is not None:
                return [*back, *path[1:]]
        return []

    def _look(self, scene: Scene, command: Array, dark: Array) -> None:
        """Go where the camera sees many of places (k, 3), if there is a free motion to one."""
        problem, self._looks = self._problem, self._looks + 1
        care, robot = self._cares[0], problem.robot
        compiled = guarded(cared(scene, robot, command, care), robot, command, care.depth)
        checker = CollisionChecker(planning_model(compiled, problem.target, MARGIN), arm_reaches(problem.robot))
        found = views(self._arm, robot, command, dark, self._known.surface, self._random, self._depths)
        for view, seen in islice(found, _TRIED):
            if checker.is_free(view) and checker.inside_is_free(command, view, RESOLUTION):
                self._way, self._looking = [view], True
                self._looked_at = np.concatenate([self._looked_at, dark[seen]])
                return

    def _ahead(self, command: Array) -> Array:
        """(m, j) configurations on the rest of the way, from one (j,) on."""
        return between(self._arm.checker.reaches, np.array([command, *self._way]))


def cares_with(margin: float, unexplained: bool, depth: float) -> list[Care]:
    """How careful the ways of an agent may be, the most careful first.

    Args:
        margin: What it keeps from boxes where there is room, metres.
        unexplained: Whether it keeps out of where the scan saw a surface without a shape, before it asks for less.
        depth: How deep it goes into unknown space before it asks for more, metres.
    """
    shallow, *_, deep, free = CAREFUL_DEPTHS
    if margin:
        roomy = [Care(margin, shallow), Care(margin, deep), Care(margin / 2, deep), Care(0.0, deep), Care(0.0, free)]
        least = roomy[-2:]
    else:
        roomy = least = [Care(0.0, each) for each in ((shallow, deep, free) if unexplained else CAREFUL_DEPTHS)]
    usual = [*(care._replace(unexplained=True) for care in roomy), *least] if unexplained else roomy
    return list(dict.fromkeys([Care(margin, depth, unexplained), *usual]))


def _followed(ways: Ways, command: Array) -> list[Array]:
    """The configurations (j,) to which ways lead from one, on straight motions; none where they do not reach."""
    way: list[Array] = []
    at = command
    for _ in range(_MOTIONS):
        heading = ways.heading(at)
        if not heading.free:
            return []
        way.append(heading.waypoint)
        if heading.left == 0.0:
            return way
        at = heading.waypoint
    return []
