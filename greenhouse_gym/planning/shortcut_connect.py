"""ShortcutConnect, this package's own planner: short paths from few checks.

It searches like RRTConnect (Kuffner and LaValle: RRT-Connect, 2000), trying straight motions to the nearest goals
first; shortens the path by cutting corners, in all joints or in one (Geraerts and Overmars: Creating High-quality Paths
for Motion Planning, 2007); and searches again where a shorter path is still possible (Gammell et al.: Informed RRT*,
2014), until several searches in a row have gained little or the budget is used up.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF, RESOLUTIONS
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.planning.own_planners import PlanningProblem

_NEAREST = 8  # goals that are tried by a straight motion before the search
_NODES = 4000  # of a search before it gives up
_DRAWS = 200  # of 32 samples each, after which no shorter path is assumed to exist
_GAIN = 0.01  # relative shortening of the path below which a search counts as idle


@dataclass(frozen=True)
class ShortcutConnectSettings:
    """Settings of ShortcutConnect."""

    range: float = 0.8  # longest motion by which a tree grows, radians; 0 sets no limit
    idle_searches: int = 6  # searches in a row with little gain after which it stops
    idle_shortcuts: int = 60  # attempts in a row without gain after which a path counts as short


def shortcut_connect(problem: PlanningProblem, settings: ShortcutConnectSettings) -> Array | None:
    """Search, shorten and search again, as described in the module."""
    rng = np.random.default_rng(problem.seed)
    distances = np.linalg.norm(problem.goals - problem.start, axis=-1)
    goals, distances = problem.goals[np.argsort(distances)], np.sort(distances)
    idle = 0
    while idle < settings.idle_searches:
        best = np.inf if problem.best is None else path_length(problem.best)
        near = goals[distances < best]
        if not len(near):
            break
        path = _proven_path(problem, near, settings, rng, best)
        if path is not None:
            problem.report(path)
            if problem.first_solution:
                return problem.best
            _report_shortened(problem, path, settings, rng)
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
    """Return a path through two trees that meet, or None; skip paths that are certainly longer than the best one."""
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
    """Sample a configuration through which a path can be shorter than the best; None if none is found."""
    if not np.isfinite(best):
        return np.asarray(rng.uniform(problem.lower, problem.upper))
    for _ in range(_DRAWS):
        goal = goals[rng.integers(len(goals))]
        # box around the ellipsoid of all configurations on a shorter path to that goal
        middle, radius = (problem.start + goal) / 2, best / 2
        low, high = np.maximum(problem.lower, middle - radius), np.minimum(problem.upper, middle + radius)
        samples = rng.uniform(low, high, (32, len(low)))
        lengths = np.linalg.norm(samples - problem.start, axis=-1) + np.linalg.norm(samples - goal, axis=-1)
        inside = np.flatnonzero(lengths < best)
        if len(inside):
            return np.asarray(samples[inside[0]])
    return None


class _Tree:
    """Tree of configurations, each with the index of its parent."""

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
        """Return the configurations from a node back to its root."""
        nodes = []
        while node >= 0:
            nodes.append(node)
            node = self._parents[node]
        return np.asarray(self._points[nodes])


def _extend(problem: PlanningProblem, tree: _Tree, towards: Array, step: float, resolution: float) -> int | None:
    """Grow a tree by one motion; return its new node, or None."""
    nearest = tree.nearest(towards)
    begin = tree.points[nearest]
    motion = towards - begin
    length = float(np.linalg.norm(motion))
    end = towards if length <= step else begin + step / length * motion
    return tree.add(end, nearest) if problem.motion_is_free(begin, end, resolution) else None


def _reach(problem: PlanningProblem, tree: _Tree, goal: Array, step: float, resolution: float) -> int | None:
    """Grow a tree motion by motion to a configuration; return its node there, or None."""
    while True:
        node = _extend(problem, tree, goal, step, resolution)
        if node is None or (tree.points[node] == goal).all():
            return node


def _report_shortened(
    problem: PlanningProblem, path: Array, settings: ShortcutConnectSettings, rng: np.random.Generator
) -> None:
    """Shorten a path at the coarsest resolution whose result can be proven free, and report it."""
    for resolution in RESOLUTIONS:
        shortened = _shortened(problem, path, settings.idle_shortcuts, rng, resolution)
        if problem.path_is_free(shortened):
            problem.report(shortened)
            return


def _shortened(
    problem: PlanningProblem, path: Array, max_failures: int, rng: np.random.Generator, resolution: float
) -> Array:
    """Return a path cut short between random points, in all joints or in one."""
    failures = 0
    while failures < max_failures and len(path) > 2:
        first, last, pieces, shorter = _cut(path, rng)
        if shorter and all(problem.motion_is_free(a, b, resolution) for a, b in pairwise(pieces)):
            path = np.concatenate([path[: first + 1], pieces, path[last:]])
            path = path[np.concatenate([[True], np.abs(np.diff(path, axis=0)).max(axis=-1) > 1e-9])]
            failures = 0
        else:
            failures += 1
    return path


def _cut(path: Array, rng: np.random.Generator) -> tuple[int, int, Array, bool]:
    """Draw two points of a path and replace its motions between them.

    Returns:
        The index of the corner before the first point, that of the corner after the last, the configurations from point
        to point, and True if they are shorter than before.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=-1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    points = np.sort(rng.uniform(0.0, ends[-1], 2))
    first, after = (np.minimum(np.searchsorted(ends, points, side="right") - 1, len(lengths) - 1)).tolist()
    if first == after:
        return first, first + 1, path[:0], False
    fractions = (points - ends[[first, after]]) / lengths[[first, after]]
    begin, end = (path[i] + f * (path[i + 1] - path[i]) for i, f in zip((first, after), fractions, strict=True))
    between = np.concatenate([begin[None], path[first + 1 : after + 1], end[None]])
    if rng.uniform() < 0.5:
        pieces = np.stack([begin, end])
    else:
        joint = rng.integers(path.shape[1])
        lengths_so_far = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(between, axis=0), axis=-1))])
        pieces = between.copy()
        pieces[:, joint] = begin[joint] + lengths_so_far / max(points[1] - points[0], 1e-12) * (end - begin)[joint]
    return first, after + 1, pieces, path_length(pieces) < path_length(between) - 1e-6
