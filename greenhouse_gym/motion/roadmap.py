"""A few straight motions from a start to a goal: a tree grows from the goals until it is seen from somewhere.

The search is a small cousin of a probabilistic roadmap (Kavraki et al., 1996) with the lazy order of Bohlin and Kavraki
(2000): of all ways that its nodes could make, the shortest is checked first.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.robots import Robot

RESOLUTION = 0.04
"""How far any point of the arm may move between two checks, metres."""

GROWTH = ((300, 0.6), (300, 0.6), (300, 0.8), (300, 0.8), (300, 0.8))
"""How many nodes are tried about the latest ones, and how far each joint is strewn at most, radians; one growth after
the other, until there are ways enough."""

TRIES, ENOUGH = 1500, 4
"""Motions to new nodes that are tried after each growth, the shortest ways first, and ways that are enough."""

NEAREST = 8
"""Goals, those nearest to the start, that are kept whether there is a way to them or not."""


class Nodes(NamedTuple):
    """Where an arm may go in an episode.

    Attributes:
        configurations: (k, j) goals, then nodes of ways to them, radians.
        costs: (k,) the way from each to its goal, radians: zero for goals.
        reach: Whether a way from the start to a goal is among them.
    """

    configurations: Array
    costs: Array
    reach: bool


@dataclass(frozen=True, eq=False)
class _Node:
    """A configuration (j,), the way from it to a goal, radians, and the node to which it goes first: none at a goal."""

    configuration: Array
    cost: float
    towards: _Node | None = None

    def before(self, configuration: Array) -> _Node:
        """A node that goes here first."""
        return _Node(configuration, self.cost + float(np.linalg.norm(configuration - self.configuration)), self)


def search_nodes(checker: CollisionChecker, goals: Array, postures: Array, start: Array, robot: Robot) -> Nodes:
    """Nodes of some short ways from a start to goals, and the nearest goals.

    Args:
        checker: Says which motions are free.
        goals: (g, j) free goal configurations, those nearest to the start first, radians.
        postures: (p, j) configurations to which the motion from the start is free.
        start: (j,) configuration.
        robot: Its limits hold.
    """
    if not len(goals) or not checker.is_free(start):
        return Nodes(goals[:NEAREST], np.zeros(len(goals[:NEAREST])), False)
    random = np.random.default_rng(0)
    tree = [_Node(goal, 0.0) for goal in goals]
    kept = tree[:NEAREST]
    in_sight = (node for node in tree if checker.inside_is_free(start, node.configuration, RESOLUTION))
    ways = list(islice(in_sight, ENOUGH))
    places, latest = np.concatenate([start[None], postures]), tree
    linked: set[int] = set()
    for generation, (count, spread) in enumerate(GROWTH):
        if len(ways) == ENOUGH or not latest:
            break
        latest = list(_grown(checker, latest, count, spread, robot, random))
        new = latest if generation else tree + latest  # no posture has looked for the goals themselves yet
        for place, node in _by_length(places, new):
            if place in linked or not checker.inside_is_free(places[place], node.configuration, RESOLUTION):
                continue
            linked.add(place)
            ways.append(node.before(places[place]) if place else node)
            if len(ways) == ENOUGH:
                break
    return _nodes(kept + ways, bool(ways))


def _grown(
    checker: CollisionChecker,
    nodes: Sequence[_Node],
    count: int,
    spread: float,
    robot: Robot,
    random: np.random.Generator,
) -> Iterator[_Node]:
    """New nodes, from which the motion to one of some nodes is free."""
    for k in random.integers(len(nodes), size=count):
        node = nodes[k]
        strewn = spread * random.uniform(0.3, 1.0) * random.normal(size=len(node.configuration))
        strewn[-1] = 0.0  # the tool is round
        configuration = np.clip(node.configuration + strewn, robot.lower, robot.upper)
        if checker.motion_is_free(node.configuration, configuration, RESOLUTION):
            yield node.before(configuration)


def _by_length(places: Array, nodes: Sequence[_Node]) -> Iterator[tuple[int, _Node]]:
    """Pairs of a place (index into (p, j), the start first) and a node, those of the shortest ways first."""
    configurations = np.reshape([node.configuration for node in nodes], (len(nodes), places.shape[1]))
    ways = np.sqrt(((places - places[0]) ** 2).sum(axis=-1))[:, None] + [node.cost for node in nodes]
    ways += np.sqrt(((configurations - places[:, None]) ** 2).sum(axis=-1))
    for k in ways.argsort(axis=None, kind="stable")[:TRIES].tolist():
        yield k // len(nodes), nodes[k % len(nodes)]


def _nodes(ends: Iterable[_Node], reach: bool) -> Nodes:
    """Some nodes, and those that follow on their ways."""
    found: dict[int, _Node] = {}
    for end in ends:
        node: _Node | None = end
        while node is not None:
            found[id(node)] = node
            node = node.towards
    ordered = sorted(found.values(), key=lambda node: node.cost > 0)
    configurations = np.array([node.configuration for node in ordered])
    return Nodes(configurations, np.array([node.cost for node in ordered]), reach)
