"""ShortcutConnect, a planner of this package: short paths from few checks.

It searches as RRTConnect does (Kuffner and LaValle: RRT-Connect, 2000), straight to the nearest goals first, shortens
what it finds by cutting corners and joints one at a time (Geraerts and Overmars: Creating High-quality Paths for Motion
Planning, 2007), and searches again where a shorter path can still be (Gammell et al.: Informed RRT*, 2014), until
several searches in a row have brought little or the budget is used up.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF, RESOLUTIONS
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.planning.planner_settings import PlannerSettings
from greenhouse_gym.planning.registered import PlanningProblem

_NEAREST = 8  # goals that are tried by a straight motion before anything is searched
_NODES = 4000  # after which a search gives up
_DRAWS = 200  # draws of 32 samples each, after which no shorter way is believed in
_GAIN = 0.01  # share of its length by which a path must get shorter for a search to have brought something


@dataclass(frozen=True)
class ShortcutConnectSettings(PlannerSettings):
    """ShortcutConnect."""

    range: float = 0.8  # longest motion by which a tree grows, radians; 0 sets no limit
    patience: int = 6  # searches in a row without gain after which it stops
    shortcuts: int = 60  # tries in a row without gain after which a path counts as short


def shortcut_connect(problem: PlanningProblem, settings: ShortcutConnectSettings) -> Array | None:
    """Search, shorten, search again; see the module."""
    rng = np.random.default_rng(problem.seed)
    distances = np.linalg.norm(problem.goals - problem.start, axis=-1)
    goals, distances = problem.goals[np.argsort(distances)], np.sort(distances)
    idle = 0
    while idle < settings.patience:
        best = np.inf if problem.best is None else path_length(problem.best)
        near = goals[distances < best]
        if not len(near):
            break
        path = _proven_path(problem, near, settings, rng, best)
        if path is not None:
            problem.tell(path)
            if problem.first_solution:
                return problem.best
            _tell_shortened(problem, path, settings, rng)
        elif problem.best is None:
            return None
        gained = problem.best is not None and path_length(problem.best) < (1 - _GAIN) * best
        idle = 0 if gained else idle + 1
    return problem.best


def _proven_path(
    problem: PlanningProblem, goals: Array, settings: ShortcutConnectSettings, rng: np.random.Generator, best: float
) -> Array | None:
    for resolution in RESOLUTIONS:
        path = _connect(problem, goals, settings.range or np.inf, rng, best, resolution)
        if path is None:
            return None
        if resolution == PROOF or problem.path_is_free(path):
            return path
    return None


def _connect(
    problem: PlanningProblem, goals: Array, step: float, rng: np.random.Generator, best: float, resolution: float
) -> Array | None:
    """A path of two trees that meet, or None; none that is sure to be longer than the best one is looked for."""
    start = problem.start
    if not np.isfinite(best):
        for goal in goals[:_NEAREST]:
            if problem.motion_is_free(start, goal, resolution):
                return np.stack([start, goal])
    trees = _Tree(start[None]), _Tree(goals)
    growing = 0
    for _ in range(_NODES):
        sample = _sample(problem, goals, rng, best)
        if sample is None:
            return None
        tree, other = trees[growing], trees[1 - growing]
        node = _extend(problem, tree, sample, step, resolution)
        if node is not None:
            reached = _reach(problem, other, tree.points[node], step, resolution)
            if reached is not None:
                halves = tree.branch(node), other.branch(reached)
                first, second = halves if growing == 0 else halves[::-1]
                return np.concatenate([first[::-1], second[1:]])
        growing = 1 - growing
    return None


def _sample(problem: PlanningProblem, goals: Array, rng: np.random.Generator, best: float) -> Array | None:
    """A random configuration through which a path can be shorter than the best; None where there seems to be none."""
    if not np.isfinite(best):
        return np.asarray(rng.uniform(problem.lower, problem.upper))
    for _ in range(_DRAWS):
        goal = goals[rng.integers(len(goals))]
        # the box around the ellipsoid of all places on a shorter way to that goal
        middle, radius = (problem.start + goal) / 2, best / 2
        low, high = np.maximum(problem.lower, middle - radius), np.minimum(problem.upper, middle + radius)
        samples = rng.uniform(low, high, (32, len(low)))
        way = np.linalg.norm(samples - problem.start, axis=-1) + np.linalg.norm(samples - goal, axis=-1)
        inside = np.flatnonzero(way < best)
        if len(inside):
            return np.asarray(samples[inside[0]])
    return None


class _Tree:
    """Configurations, each with the one it was reached from."""

    def __init__(self, roots: Array):
        self._points = np.empty((2 * _NODES + len(roots), roots.shape[1]))
        self._points[: len(roots)] = roots
        self._parents = [-1] * len(roots)

    @property
    def points(self) -> Array:
        return self._points[: len(self._parents)]

    def nearest(self, point: Array) -> int:
        gaps = self.points - point
        return int(np.argmin(np.einsum("ij,ij->i", gaps, gaps)))

    def add(self, point: Array, parent: int) -> int:
        if len(self._parents) == len(self._points):
            self._points = np.concatenate([self._points, np.empty_like(self._points)])
        self._points[len(self._parents)] = point
        self._parents.append(parent)
        return len(self._parents) - 1

    def branch(self, node: int) -> Array:
        """Configurations from a node back to its root."""
        nodes = []
        while node >= 0:
            nodes.append(node)
            node = self._parents[node]
        return np.asarray(self._points[nodes])


def _extend(problem: PlanningProblem, tree: _Tree, towards: Array, step: float, resolution: float) -> int | None:
    """Grow a tree by one motion; its new node, or None."""
    nearest = tree.nearest(towards)
    begin = tree.points[nearest]
    way = towards - begin
    length = float(np.linalg.norm(way))
    end = towards if length <= step else begin + step / length * way
    return tree.add(end, nearest) if problem.motion_is_free(begin, end, resolution) else None


def _reach(problem: PlanningProblem, tree: _Tree, goal: Array, step: float, resolution: float) -> int | None:
    """Grow a tree motion by motion to a configuration; its node there, or None."""
    while True:
        node = _extend(problem, tree, goal, step, resolution)
        if node is None or (tree.points[node] == goal).all():
            return node


def _tell_shortened(
    problem: PlanningProblem, path: Array, settings: ShortcutConnectSettings, rng: np.random.Generator
) -> None:
    """Shorten a path as coarsely as it can then still be proven, and tell of it."""
    for resolution in RESOLUTIONS:
        shortened = _shortened(problem, path, settings.shortcuts, rng, resolution)
        if problem.path_is_free(shortened):
            problem.tell(shortened)
            return


def _shortened(
    problem: PlanningProblem, path: Array, patience: int, rng: np.random.Generator, resolution: float
) -> Array:
    """A path cut short between random places, in all joints or in one."""
    failures = 0
    while failures < patience and len(path) > 2:
        first, last, pieces, shorter = _cut(path, rng)
        if shorter and all(problem.motion_is_free(a, b, resolution) for a, b in pairwise(pieces)):
            path = np.concatenate([path[: first + 1], pieces, path[last:]])
            path = path[np.concatenate([[True], np.abs(np.diff(path, axis=0)).max(axis=-1) > 1e-9])]
            failures = 0
        else:
            failures += 1
    return path


def _cut(path: Array, rng: np.random.Generator) -> tuple[int, int, Array, bool]:
    """Between two random places of a path, the motions that would replace it there, and whether they are shorter.

    The result is the corner before the first place, the one after the last, the configurations from place to place,
    and whether the cut is worth being checked.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    places = np.sort(rng.uniform(0.0, ends[-1], 2))
    first, after = (np.minimum(np.searchsorted(ends, places, side="right") - 1, len(lengths) - 1)).tolist()
    if first == after:
        return first, first + 1, path[:0], False
    shares = (places - ends[[first, after]]) / lengths[[first, after]]
    begin, end = (path[i] + share * (path[i + 1] - path[i]) for i, share in zip((first, after), shares, strict=True))
    between = np.concatenate([begin[None], path[first + 1 : after + 1], end[None]])
    if rng.uniform() < 0.5:
        pieces = np.stack([begin, end])
    else:
        joint = rng.integers(path.shape[1])
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(between, axis=0), axis=-1))]) / max(
            places[1] - places[0], 1e-12
        )
        pieces = between.copy()
        pieces[:, joint] = begin[joint] + way * (end[joint] - begin[joint])
    return first, after + 1, pieces, path_length(pieces) < path_length(between) - 1e-6
