"""RRTConnect (Kuffner and LaValle: RRT-Connect, 2000), compiled, for arms that `kernel_world` can compute.

It searches as OMPL's does, with one exception: the tree from the goals begins with all of them, which halves the number
of checks. OMPL's begins with one and gets the next whenever its number of nodes has doubled; so does this one with
`PlannerQuery.gradual_goals`, and then needs as many checks as OMPL's.
"""

from __future__ import annotations

import math
import time
from importlib import import_module

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF, RESOLUTIONS, CollisionChecker
from greenhouse_gym.motion.kernel_checker import KernelChecker
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.planning.worker import Outcome, PlannerAnswer, PlannerQuery

_BATCH = 256  # random configurations between two looks at the clock, some milliseconds
_NODES = 1024  # for which the trees have room at first
_DRAWS, _IDLE = 80, 30  # attempts to shorten a path, and those in a row without success after which it ends


def compiled_checker(query: PlannerQuery, checker: CollisionChecker) -> KernelChecker | None:
    """Return the checker if `rrt_connect` can answer a query; None if the planner, settings or arm need OMPL."""
    if query.planner != "RRTConnect" or query.settings.get("intermediate_states"):
        return None
    return checker if isinstance(checker, KernelChecker) else None


def rrt_connect(query: PlannerQuery, checker: KernelChecker) -> PlannerAnswer:
    """Search, shorten and prove a path, at a coarse resolution first, then at finer ones; ``range`` is its setting."""
    import_module("greenhouse_gym.planning.connect_kernels")  # compiled before any time limit counts
    rng, began = np.random.default_rng(query.seed), time.perf_counter()
    status: Outcome = "no_solution"
    checks, nodes, planning_time, shortening_time = 0, 0, 0.0, 0.0
    raw: Array | None = None
    path: Array | None = None
    for resolution in RESOLUTIONS:
        start = time.perf_counter()
        left = math.inf if query.max_checks is None else query.max_checks - checks
        deadline = start + query.time_limit - planning_time
        raw, used, nodes = _search(query, checker, resolution, left, deadline, rng)
        checks += used
        found = time.perf_counter()
        planning_time += found - start
        if raw is None:
            break
        path = _shortened(query, checker, raw, rng)
        shortening_time += time.perf_counter() - found
        status = "invalid" if path is None else "solved"
        if path is not None:
            break
    costs = [] if raw is None else [(found - began, path_length(raw))]
    costs_found = np.array(costs).reshape(-1, 2)
    return PlannerAnswer(status, path, raw, planning_time, shortening_time, checks, nodes, costs_found)


def _search(
    query: PlannerQuery, checker: KernelChecker, resolution: float, max_checks: float, deadline: float,
    rng: np.random.Generator,
) -> tuple[Array | None, int, int]:  # fmt: skip
    """Search for a path (k, joints); return it, or None, and the numbers of checks and nodes."""
    from greenhouse_gym.planning.connect_kernels import FULL, MET, grow_trees

    step = float(query.settings["range"]) or math.inf
    given = 0 if query.gradual_goals else len(query.goals)
    points = np.empty((2, _NODES + given, len(query.start)))
    parents = np.full(points.shape[:2], -1)
    points[0, 0], points[1, :given] = query.start, query.goals[:given]
    sizes, state = np.array([1, given]), np.array([0, 0, given, 0, 0, 0])
    limit, samples = int(min(max_checks, 1 << 62)), np.empty((0, len(query.start)))
    result = 0
    while result != MET and state[1] < limit and time.perf_counter() < deadline:
        if result == FULL:
            points, parents = np.concatenate([points] * 2, axis=1), np.concatenate([parents] * 2, axis=1)
        elif state[5] == len(samples):
            samples, state[5] = rng.uniform(query.lower, query.upper, (_BATCH, len(query.start))), 0
        result = grow_trees(
            checker.world, query.reaches, resolution, step, limit, query.goals, samples, points, parents, sizes, state
        )
    path = None
    if result == MET:
        first, second = (_branch(points[k], parents[k], int(state[3 + k])) for k in range(2))
        path = np.concatenate([first[::-1], second[1:]])
    return path, int(state[1]), int(sizes.sum())


def _shortened(query: PlannerQuery, checker: KernelChecker, raw: Array, rng: np.random.Generator) -> Array | None:
    """Return a path shortened at the coarsest resolution at which it stays free, or itself if it is free, or None."""
    from greenhouse_gym.planning.connect_kernels import shorten

    draws = rng.uniform(size=(_DRAWS, 2))
    for resolution in RESOLUTIONS:
        path = np.concatenate([raw, np.empty((_DRAWS, raw.shape[1]))])
        count = shorten(checker.world, query.reaches, resolution, draws, _IDLE, path, len(raw))
        if checker.path_is_free(path[:count], PROOF):
            return path[:count].copy()
    return raw if checker.path_is_free(raw, PROOF) else None


def _branch(points: Array, parents: Array, node: int) -> Array:
    """Return the configurations (k, joints) from a node of a tree to its root."""
    nodes = []
    while node >= 0:
        nodes.append(node)
        node = int(parents[node])
    return points[nodes]
