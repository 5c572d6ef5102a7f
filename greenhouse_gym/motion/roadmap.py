"""A roadmap for one episode: goals, and nodes from which a few straight motions lead to them.

A tree grows from free goals until the start sees one of its nodes, directly or from a posture near the start. The
search is a small relative of the probabilistic roadmap (Kavraki et al., 1996) with the lazy order of Bohlin and Kavraki
(2000): of all candidate paths, the shortest is checked first. From then on one rule, in which nothing is learned, gives
the next waypoint: of the nodes that are visible (the straight motion to them is free), the one on the shortest path.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from greenhouse_gym.errors import require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import LEAVES, CollisionChecker, planning_model
from greenhouse_gym.motion.goals import GoalSampler, nearest_free_goals
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import CompiledScene

ROADMAP_MARGIN = 0.004
"""Distance kept from obstacles, metres."""

RESOLUTION = 0.04
"""Largest motion of any point of the arm between two collision checks, metres."""

REACHED = 0.01
"""Largest joint error at which a node counts as reached, radians."""

POSTURES, SPREAD = 96, 1.2
"""Postures sampled around the start, and the standard deviation of each of their joints, radians."""

GROWTH = ((300, 0.6), (300, 0.6), (300, 0.8), (300, 0.8), (300, 0.8))
"""Generations of the tree: nodes tried around the latest ones, and the largest standard deviation of a joint, radians.
Growth ends as soon as enough paths are found."""

MAX_TRIES, ENOUGH_PATHS = 1500, 4
"""Motions checked after each generation, those of the shortest paths first, and paths that end the search."""

NEAREST = 8
"""Number of goals nearest to the start that are kept even if no path leads to them."""

_CACHE_SIZE = 256  # roadmaps kept per scene, about 6 KB each; random starts make a new one in every episode
_MAX_MOTIONS = 30  # of a path
_TRIED_AT_ONCE = 100  # motions


class RoadmapNodes(NamedTuple):
    """Arrays of the nodes of a roadmap.

    Attributes:
        configurations: (k, j) goals first, then nodes on paths to them, radians.
        costs: (k,) cost to go: length of the path from each node to its goal, radians; zero for goals.
        connected: Whether they hold a path from the start to a goal.
    """

    configurations: Array
    costs: Array
    connected: bool


class Waypoint(NamedTuple):
    """Next straight motion on a roadmap.

    Attributes:
        configuration: (j,) its end, radians.
        cost_to_go: Length of the path from there to the goal, radians.
        free: Whether the straight motion is known to be free; if not, the configuration is an arbitrary node.
    """

    configuration: Array
    cost_to_go: float
    free: bool


class Roadmap:
    """Free paths to one target from anywhere near the start of an episode.

    Args:
        nodes: The nodes.
        checker: Checks motions to them.
        start: (j,) start of the episode, the waypoint if there are no nodes, radians.
    """

    def __init__(self, nodes: RoadmapNodes, checker: CollisionChecker, start: Array):
        self.nodes = nodes
        self._checker, self._start = checker, start

    def waypoint(self, joints: Array) -> Waypoint:
        """Return the visible node on the shortest path from joint positions (j,), radians."""
        configurations, costs, _ = self.nodes
        if not len(costs):
            return Waypoint(self._start, 0.0, False)
        distances = np.sqrt(((configurations - joints) ** 2).sum(axis=-1))
        distances[(distances < REACHED) & (costs > 0)] = np.inf
        order = (distances + costs).argsort(kind="stable")
        if self._checker.is_free(joints):
            for k in order:
                if np.isfinite(distances[k]) and self._checker.motion_is_free(joints, configurations[k], RESOLUTION):
                    return Waypoint(configurations[k], float(costs[k]), True)
        return Waypoint(configurations[order[0]], float(costs[order[0]]), False)

    def path(self, joints: Array) -> list[Array]:
        """Return the waypoints (j,) from joint positions (j,) to a goal; empty if none is reached."""
        waypoints: list[Array] = []
        for _ in range(_MAX_MOTIONS):
            waypoint = self.waypoint(waypoints[-1] if waypoints else joints)
            if not waypoint.free:
                return []
            waypoints.append(waypoint.configuration)
            if waypoint.cost_to_go == 0.0:
                return waypoints
        return []


class SceneRoadmaps:
    """Roadmaps of one scene; each is searched once.

    Args:
        compiled: The scene.
        leaves: "rigid"; or "brush" to search through leaves where no path leads around them.
    """

    def __init__(self, compiled: CompiledScene, leaves: str = LEAVES[0]):
        self.compiled, self._leaves = compiled, LEAVES[: LEAVES.index(require_choice("leaves", leaves, LEAVES)) + 1]
        self._postures: dict[bytes, Array] = {}  # by treatment of leaves and start
        self._nodes: dict[bytes, RoadmapNodes] = {}  # likewise, and by target and its center

    def roadmap(self, goals: GoalSampler) -> Roadmap:
        """Return the roadmap from the start of a sampler to the goals that it samples."""
        roadmap = self._searched(goals, self._leaves[0])
        for leaves in self._leaves[1:]:
            if not roadmap.nodes.connected:
                roadmap = self._searched(goals, leaves)
        return roadmap

    def _searched(self, goals: GoalSampler, leaves: str) -> Roadmap:
        model = planning_model(self.compiled, goals.target, ROADMAP_MARGIN, leaves=leaves)
        checker = search_checker(model, arm_reaches(self.compiled.robot))
        key = leaves.encode() + np.concatenate([[goals.target], goals.center, goals.start]).tobytes()
        if key not in self._nodes:
            if len(self._nodes) >= _CACHE_SIZE:
                self._nodes.clear()
                self._postures.clear()
            free, postures = nearest_free_goals(checker, goals), self._postures_around(checker, goals.start, leaves)
            self._nodes[key] = search_nodes(checker, free, postures, goals.start, self.compiled.robot)
        return Roadmap(self._nodes[key], checker, goals.start)

    def _postures_around(self, checker: CollisionChecker, start: Array, leaves: str) -> Array:
        """Return postures (k, j) that a free straight motion leads to from the start, in random order."""
        key = leaves.encode() + start.tobytes()
        if key not in self._postures:
            robot = self.compiled.robot
            samples = start + SPREAD * np.random.default_rng(0).normal(size=(POSTURES, len(start)))
            robot.keep_tool_roll(samples, start)
            samples = np.clip(samples, robot.lower, robot.upper)
            starts = np.broadcast_to(start, samples.shape)
            self._postures[key] = samples[checker.motions_are_free(starts, samples, RESOLUTION)]
        return self._postures[key]


@dataclass(frozen=True, eq=False)
class _Node:
    """A configuration (j,), its cost to go in radians, and the next node on its path; None at a goal."""

    configuration: Array
    cost: float
    next: _Node | None = None

    def preceded_by(self, configuration: Array) -> _Node:
        """Return a node whose path begins with the motion to this one."""
        return _Node(configuration, self.cost + float(np.linalg.norm(configuration - self.configuration)), self)


def search_nodes(checker: CollisionChecker, goals: Array, postures: Array, start: Array, robot: Robot) -> RoadmapNodes:
    """Search for a few short paths from a start to goals; return their nodes and the nearest goals.

    Args:
        checker: Checks motions.
        goals: (g, j) free goals, those nearest to the start first, radians.
        postures: (p, j) configurations that a free straight motion leads to from the start.
        start: (j,) configuration.
        robot: The arm whose limits apply.
    """
    if not len(goals) or not checker.is_free(start):
        return RoadmapNodes(goals[:NEAREST], np.zeros(len(goals[:NEAREST])), False)
    rng = np.random.default_rng(0)
    tree = [_Node(goal, 0.0) for goal in goals]
    nearest = tree[:NEAREST]
    visible = checker.motions_are_free(np.broadcast_to(start, goals.shape), goals, RESOLUTION, inside=True)
    paths = [tree[k] for k in np.flatnonzero(visible)[:ENOUGH_PATHS]]
    origins, latest = np.concatenate([start[None], postures]), tree
    linked: set[int] = set()
    for generation, (count, spread) in enumerate(GROWTH):
        if len(paths) == ENOUGH_PATHS or not latest:
            break
        latest = list(_grown(checker, latest, count, spread, robot, rng))
        new = latest if generation else tree + latest  # motions from postures to the goals were not checked yet
        for origin, node in _free_by_length(checker, origins, new):
            if origin in linked:
                continue
            linked.add(origin)
            paths.append(node.preceded_by(origins[origin]) if origin else node)
            if len(paths) == ENOUGH_PATHS:
                break
    return _nodes(nearest + paths, bool(paths))


def _grown(
    checker: CollisionChecker, nodes: Sequence[_Node], count: int, spread: float, robot: Robot, rng: np.random.Generator
) -> Iterator[_Node]:
    """Yield new nodes with a free motion to one of the given nodes."""
    chosen = [nodes[k] for k in rng.integers(len(nodes), size=count)]
    before = np.array([node.configuration for node in chosen])
    steps = [spread * rng.uniform(0.3, 1.0) * rng.normal(size=before.shape[1]) for _ in chosen]
    after = np.clip(before + steps, robot.lower, robot.upper)
    robot.keep_tool_roll(after, before)
    for k in np.flatnonzero(checker.motions_are_free(before, after, RESOLUTION)):
        yield chosen[k].preceded_by(after[k])


def _free_by_length(checker: CollisionChecker, origins: Array, nodes: Sequence[_Node]) -> Iterator[tuple[int, _Node]]:
    """Yield pairs of an origin (index into (p, j), the start first) and a node it sees, shortest paths first."""
    configurations = np.reshape([node.configuration for node in nodes], (len(nodes), origins.shape[1]))
    lengths = np.sqrt(((origins - origins[0]) ** 2).sum(axis=-1))[:, None] + [node.cost for node in nodes]
    lengths += np.sqrt(((configurations - origins[:, None]) ** 2).sum(axis=-1))
    order = lengths.argsort(axis=None, kind="stable")[:MAX_TRIES]
    for first in range(0, len(order), _TRIED_AT_ONCE):
        origin, node = np.divmod(order[first : first + _TRIED_AT_ONCE], len(nodes))
        free = checker.motions_are_free(origins[origin], configurations[node], RESOLUTION, inside=True)
        yield from ((int(origin[k]), nodes[node[k]]) for k in np.flatnonzero(free))


def _nodes(ends: Iterable[_Node], connected: bool) -> RoadmapNodes:
    """Collect some nodes and all that follow on their paths."""
    found: dict[int, _Node] = {}
    for end in ends:
        node: _Node | None = end
        while node is not None:
            found[id(node)] = node
            node = node.next
    ordered = sorted(found.values(), key=lambda node: node.cost > 0)
    configurations = np.array([node.configuration for node in ordered])
    return RoadmapNodes(configurations, np.array([node.cost for node in ordered]), connected)
