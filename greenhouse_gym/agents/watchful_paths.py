"""Paths of an agent that observes its surroundings as it moves: planned ones, or those of a rehearsed policy."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np

from greenhouse_gym.agents.agent import Agent, Problem
from greenhouse_gym.agents.rehearsal import rehearse
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.caution import (
    CautionLevel,
    apply_caution,
    at_highest_level,
    cautious_roadmap,
    unexplained_cells,
    with_unexplained_cells,
)
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.goals import MAX_BATCHES, MAX_GOALS, GoalSampler, nearest_free_goals
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.roadmap import ROADMAP_MARGIN
from greenhouse_gym.motion.unknown_space import guarded
from greenhouse_gym.planning import plan
from greenhouse_gym.scene import CompiledScene, Scene

VOXELS = (0.01, 0.004)
"""Sides of the voxels that cover observed points, metres: the next is tried if there is no path with the one before."""

MAX_CHECKS, NUM_GOALS = 30_000, 60
"""Collision checks of RRTConnect, and the goals that are sampled for each retry."""

REHEARSED_STEPS = 100
"""Number of actions in which a rehearsal must reach the target."""

_NO_CAUTION = (CautionLevel(0.0, np.inf, unexplained=True), CautionLevel(0.0, np.inf))


class Found(NamedTuple):
    """Outcome of a search.

    Attributes:
        path: Configurations (j,) to be passed; none if no path was found.
        scene: The scene as it is known by now.
        level: Caution level of the path.
    """

    path: list[Array]
    scene: Scene
    level: CautionLevel


class Paths(Protocol):
    """Search for paths to the target of an episode."""

    def find(self, scene_with: Callable[[float], Scene], command: Array, back: list[Array]) -> Found:
        """Find a path in the scene as it is known by now.

        Args:
            scene_with: Returns that scene, given the side of the voxels that cover observed points.
            command: (j,) current configuration, radians.
            back: Configurations (j,) on the way back to the start.
        """

    def find_again(
        self, scene: Scene, command: Array, back: list[Array], seed: int, level: CautionLevel
    ) -> list[Array]:
        """Return a path by another search, where `find` found none; empty without one."""


class PlannedPaths:
    """Paths by the roadmap; where it has none, by RRTConnect, from the current configuration or else from the start.

    Args:
        problem: The episode.
        levels: Caution levels to try, the most cautious first.
        unexplained: Whether unexplained occupied cells are avoided if possible.
    """

    def __init__(self, problem: Problem, levels: Sequence[CautionLevel], unexplained: bool):
        self._problem, self._levels, self._heed_unexplained = problem, levels, unexplained

    def find(self, scene_with: Callable[[float], Scene], command: Array, back: list[Array]) -> Found:
        """See `Paths.find`."""
        problem = self._problem
        goals = GoalSampler(compiled_for(problem, problem.scene), problem.target, command)
        for voxel in VOXELS:
            scene = scene_with(voxel)
            roadmap, level = cautious_roadmap(scene, problem.robot, goals, self._levels)
            if path := roadmap.path(command):
                return Found(path, scene, level)
        checker = checker_for(problem, compiled_for(problem, scene), ROADMAP_MARGIN)
        free = nearest_free_goals(checker, goals, MAX_GOALS, MAX_BATCHES)
        avoid_surfaces = self._heed_unexplained and bool(unexplained_cells(scene).any())
        for level in (_NO_CAUTION if avoid_surfaces else _NO_CAUTION[1:]) if len(free) else ():
            if path := self._search(scene, command, back, problem.seed, level, free):
                return Found(path, scene, level)
        return Found([], scene, _NO_CAUTION[-1])

    def find_again(
        self, scene: Scene, command: Array, back: list[Array], seed: int, level: CautionLevel
    ) -> list[Array]:
        """See `Paths.find_again`; other goals are sampled."""
        return self._search(scene, command, back, seed, level, NUM_GOALS)

    def _search(
        self, scene: Scene, command: Array, back: list[Array], seed: int, level: CautionLevel, goals: Array | int
    ) -> list[Array]:
        """Search with RRTConnect for a path to goals (k, j), or to a number of goals that it samples."""
        problem = self._problem
        unknown: str | float = "free" if scene.occupancy is None or np.isinf(level.depth) else level.depth
        known = with_unexplained_cells(scene, problem.robot, command) if level.unexplained else scene
        for before in ([], back):
            path = plan(
                known, problem.target, problem.robot, start=before[-1] if before else command, goals=goals,
                time_limit=None, max_checks=MAX_CHECKS, seed=seed, unknown=unknown, margin=level.margin,
            ).path  # fmt: skip
            if path is not None:
                return [*before, *path[1:]]
        return []


class RehearsedPaths:
    """Paths that an agent takes in a rehearsal: from the current configuration, or from the start.

    Args:
        problem: The episode.
        levels: Caution levels to try, the most cautious first.
        agent: The agent, with joint actions on the observation "state".
    """

    def __init__(self, problem: Problem, levels: Sequence[CautionLevel], agent: Agent):
        self._problem, self._levels, self._agent = replace(problem, step_limit=REHEARSED_STEPS), levels, agent

    def find(self, scene_with: Callable[[float], Scene], command: Array, back: list[Array]) -> Found:
        """See `Paths.find`."""
        for voxel in VOXELS:
            scene = scene_with(voxel)
            search = partial(self._search, scene, command, back, self._problem.seed)
            path, level = at_highest_level(search, bool, scene, self._levels)
            if path:
                return Found(path, scene, level)
        return Found([], scene, self._levels[-1])

    def find_again(
        self, scene: Scene, command: Array, back: list[Array], seed: int, level: CautionLevel
    ) -> list[Array]:
        """See `Paths.find_again`; the agent makes other random choices."""
        return self._search(scene, command, back, seed, level)

    def _search(self, scene: Scene, command: Array, back: list[Array], seed: int, level: CautionLevel) -> list[Array]:
        for before in ([], back):
            start = before[-1] if before else command
            known = apply_caution(scene, self._problem.robot, start, level)
            rehearsed = rehearse(self._agent, replace(self._problem, seed=seed).later(known, start))
            if rehearsed is not None:
                return [*before, *rehearsed]
        return []


def compiled_for(problem: Problem, scene: Scene) -> CompiledScene:
    """Return a scene in which all unknown space is free; the last ones are cached."""
    return guarded(scene, problem.robot, problem.start, np.inf)


def checker_for(problem: Problem, compiled: CompiledScene, margin: float = ROADMAP_MARGIN) -> CollisionChecker:
    """Return the checker for a problem's arm and target in a scene, with a margin in metres."""
    return search_checker(planning_model(compiled, problem.target, margin), arm_reaches(compiled.robot))
