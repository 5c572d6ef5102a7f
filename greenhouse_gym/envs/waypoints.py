"""Where an arm can go straight: to goal configurations, and to nodes of ways of a few straight motions to them.

All that is used is known to whoever knows the scene. The nodes of an episode, goal configurations by inverse kinematics
and a tree about them, are found at its beginning; from then on one rule, in which nothing is learned, says to which of
them the arm goes: of those to which the straight motion is free, to the one with the shortest way.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.worlds import World
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker, planning_model
from greenhouse_gym.motion.inverse_kinematics import inverse_kinematics
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.motion.roadmap import RESOLUTION, Nodes, search_nodes
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import tool_chain
from greenhouse_gym.scene import CompiledScene, compile_scene

EVERY = 8
"""Steps after which the way is looked for anew; it is also when its end is reached."""

MARGIN = 0.004
"""Distance to obstacles that is kept, metres."""

GUESSES, FEW, GOALS = 300, 20, 60
"""First guesses of goal configurations, few of these, for which more is guessed, and how many goals, those nearest to
the start, are looked at."""

ROUNDS, MAX_ROUNDS = 4, 24
"""How often is guessed at most while few goals are found, and while none is."""

POSTURES, SPREAD = 96, 1.2
"""Postures that are tried, and how far each joint is strewn about the start, radians."""

REACHED = 0.01
"""How near a posture counts as reached, radians."""

_REMEMBERED = 10_000


class Heading(NamedTuple):
    """Where to go straight from somewhere.

    Attributes:
        waypoint: (j,) radians.
        left: The way from there to the goal, radians.
        free: Whether the straight motion is known to be free.
    """

    waypoint: Array
    left: float
    free: bool


class Ways:
    """The ways of one episode.

    Args:
        place: Where.
        ends: What reaches the target from there, whatever is in the way.

    Attributes:
        nodes: Where the arm may go.
    """

    def __init__(self, place: Place, ends: Ends):
        self._checker = CollisionChecker(planning_model(place.compiled, ends.target, MARGIN), arm_reaches(place.robot))
        self.nodes = place.nodes(self._checker, ends)
        self._start = ends.start

    def heading(self, joints: Array) -> Heading:
        """Where to go from (j,) joint positions, radians."""
        configurations, costs, _ = self.nodes
        if not len(costs):
            return Heading(self._start, 0.0, False)
        ways = np.sqrt(((configurations - joints) ** 2).sum(axis=-1))
        ways[(ways < REACHED) & (costs > 0)] = np.inf
        order = (ways + costs).argsort(kind="stable")
        if self._checker.is_free(joints):
            for k in order:
                if np.isfinite(ways[k]) and self._checker.motion_is_free(joints, configurations[k], RESOLUTION):
                    return Heading(configurations[k], float(costs[k]), True)
        return Heading(configurations[order[0]], float(costs[order[0]]), False)


class Headings:
    """Where n simulations go; each looks anew from time to time, and when it has arrived.

    Args:
        count: Number of simulations n.
        joints: Number of joints j.

    Attributes:
        waypoint: (n, j) where each goes straight, radians.
        way: (n, 2) the way from there to the goal, radians, and whether the straight motion is known to be free.
    """

    def __init__(self, count: int, joints: int):
        self.waypoint, self.way = np.zeros((count, joints)), np.zeros((count, 2))
        self._ways: list[Ways | None] = [None] * count

    def __deepcopy__(self, memo: dict[int, Any]) -> Headings:
        """Headings to go on from independently; ways are never changed, and shared."""
        twin = memo[id(self)] = object.__new__(Headings)
        twin.waypoint, twin.way, twin._ways = self.waypoint.copy(), self.way.copy(), self._ways.copy()
        return twin

    def begin(self, i: int, ways: Ways) -> None:
        """Begin an episode of simulation ``i``."""
        self._ways[i] = ways

    def look(self, ids: npt.NDArray[np.int64], command: Array, steps: npt.NDArray[np.int64]) -> None:
        """Look anew where that is due.

        Args:
            ids: Indices of k simulations.
            command: (k, j) their commanded joint positions, radians.
            steps: (k,) steps of their episodes so far.
        """
        arrived = (np.abs(self.waypoint[ids] - command).max(axis=1) < REACHED) & (self.way[ids, 0] > 0)
        for k in np.flatnonzero(arrived | (steps % EVERY == 0)):
            i, ways = ids[k], self._ways[ids[k]]
            assert ways is not None
            heading = ways.heading(command[k])
            # in the middle of a free motion, an obstacle may be nearer than the margin, which is checked at places
            if heading.free or arrived[k] or not self.way[i, 1] or steps[k] == 0:
                self.waypoint[i], self.way[i] = heading.waypoint, (heading.left, heading.free)


class Ends:
    """Configurations that reach a target, whatever they touch, round by round; each round is computed once.

    Args:
        compiled: The scene.
        target: Index of the target in it.
        center: (3,) where it is told to be in the scene, metres.
        start: (j,) radians.
    """

    def __init__(self, compiled: CompiledScene, target: int, center: Array, start: Array):
        self.target, self.center, self.start = target, center, start
        self._robot, self._radius = compiled.robot, compiled.scene.tomatoes[target].radius
        self._chain = tool_chain(compiled.model, compiled.tip_site)
        self._random = np.random.default_rng(0)
        self._rounds: list[Array] = []

    def __getitem__(self, k: int) -> Array:
        """(n, j) those of round k, radians."""
        while len(self._rounds) <= k:
            self._rounds.append(self._next())
        return self._rounds[k]

    def _next(self) -> Array:
        robot, start = self._robot, self.start
        lower, upper = np.maximum(robot.lower, start - np.pi), np.minimum(robot.upper, start + np.pi)
        guesses = self._random.uniform(lower, upper, (GUESSES, len(start)))
        guesses[:, -1] = start[-1]  # the tool is round
        return inverse_kinematics(self._chain, guesses, self.center, self._radius, robot)


@dataclass(frozen=True, eq=False)
class Place:
    """A scene as it is known, with what was found in it so far.

    Attributes:
        compiled: The scene.
        postures: Those of each start.
        known: The nodes of each episode.
    """

    compiled: CompiledScene
    postures: dict[bytes, Array] = field(default_factory=dict)  # by the start
    known: dict[bytes, Nodes] = field(default_factory=dict)  # by target, center and start

    @property
    def robot(self) -> Robot:
        """The arm."""
        return self.compiled.robot

    def nodes(self, checker: CollisionChecker, ends: Ends) -> Nodes:
        """The nodes of an episode, found once."""
        key = np.concatenate([[ends.target], ends.center, ends.start]).tobytes()
        if key not in self.known:
            if len(self.known) >= _REMEMBERED:
                self.known.clear()
            goals, postures = free_goals(checker, ends), self._postures(checker, ends.start)
            self.known[key] = search_nodes(checker, goals, postures, ends.start, self.robot)
        return self.known[key]

    def _postures(self, checker: CollisionChecker, start: Array) -> Array:
        """(k, j) postures to which the way from the start is free, in no order."""
        key = start.tobytes()
        if key not in self.postures:
            strewn = start + SPREAD * np.random.default_rng(0).normal(size=(POSTURES, len(start)))
            strewn[:, -1] = start[-1]
            tried = np.clip(strewn, self.robot.lower, self.robot.upper)
            free = tried[[checker.motion_is_free(start, posture, RESOLUTION) for posture in tried]]
            self.postures[key] = free.reshape(-1, len(start))
        return self.postures[key]


def free_goals(checker: CollisionChecker, ends: Ends, few: int = FEW, rounds: int = ROUNDS) -> Array:
    """(k, j) free goal configurations, `GOALS` at most, those near the start first, radians.

    Args:
        checker: Says which are free.
        ends: What reaches the target.
        few: As long as there are fewer, more is guessed,
        rounds: this often at most, but `MAX_ROUNDS` times while there is none.
    """
    free: list[Array] = []
    for k in range(MAX_ROUNDS):
        free += [end for end in ends[k] if checker.is_free(end)]
        if len(free) >= few or (free and k + 1 >= rounds) or not len(ends[k]):
            break
    goals = np.array(free).reshape(-1, len(ends.start))
    return goals[((goals - ends.start) ** 2).sum(axis=-1).argsort(kind="stable")[:GOALS]]


_PLACES: WeakKeyDictionary[World, Place] = WeakKeyDictionary()


def place_of(world: World, robot: Robot) -> Place:
    """A world's scene as it is known, kept for as long as the world lives."""
    known = world.before or world
    if known not in _PLACES:
        _PLACES[known] = Place(compile_scene(known.scene, robot))
    return _PLACES[known]
