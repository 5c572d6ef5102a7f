"""Kernels of RRTConnect and of shortcuts; `greenhouse_gym.planning.connect` calls them.

Their first arguments are the world of `greenhouse_gym.motion.collision_kernels`, the largest motion (n,) of any point
of the arm per radian of each joint, metres, and the largest motion of these points between two checks, metres.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.motion.collision_kernels import WORLD, Array, World, free_inside, gap, memory_for

Integers = npt.NDArray[np.int64]

UNFINISHED, MET, FULL = range(3)
"""Results of `grow_trees`: the samples or the checks are used up, the trees have met, or there is no room for nodes."""

_TURN, _CHECKS, _GOALS, _FIRST, _SECOND, _SAMPLES = range(6)  # entries of the state of a search


@inlined
def _copy(source, target):
    for j in range(len(target)):
        target[j] = source[j]


@inlined
def _grow(world, reaches, resolution, points, parents, size, towards, step, state, memory):
    """Grow a tree of ``size`` nodes by one motion; return 0 if it is not free, 1 if it is, 2 if it also arrives."""
    nearest, smallest = 0, np.inf
    for k in range(size):
        squared = 0.0
        for j in range(len(towards)):
            squared += (points[k, j] - towards[j]) ** 2
        if squared < smallest:
            nearest, smallest = k, squared
    arrives, new = smallest <= step * step, points[size]
    for j in range(len(towards)):
        start = points[nearest, j]
        new[j] = towards[j] if arrives else start + step / math.sqrt(smallest) * (towards[j] - start)
    state[_CHECKS] += 1
    _copy(new, memory[0])
    if gap(world, 0.0, memory) < 0.0:
        return 0
    checks = free_inside(world, reaches, resolution, points[nearest], new, memory)
    state[_CHECKS] += abs(checks)
    if checks < 0:
        return 0
    parents[size] = nearest
    return 2 if arrives else 1


@kernel(
    f"i8({WORLD}, f8[::1], f8, f8, i8, f8[:, ::1], f8[:, ::1], f8[:, :, ::1], i8[:, ::1], i8[::1], i8[::1])",
    writes=("goals", "samples", "points", "parents", "sizes", "state"),
)
def grow_trees(
    world: World,
    reaches: Array,
    resolution: float,
    step: float,
    max_checks: int,
    goals: Array,
    samples: Array,
    points: Array,
    parents: Integers,
    sizes: Integers,
    state: Integers,
) -> int:
    """Grow two trees towards random configurations and each other; see `greenhouse_gym.planning.connect`.

    Args:
        world: The arm and the scene.
        reaches: Largest motions per radian.
        resolution: Metres between two checks.
        step: Longest motion by which a tree grows, radians.
        max_checks: Number of checks after which the search ends.
        goals: (g, n) free goals.
        samples: (s, n) random configurations.
        points: (2, capacity, n) nodes of the tree from the start, which it has, and of the tree from the goals.
        parents: (2, capacity) their parents; -1 for roots.
        sizes: (2,) numbers of nodes.
        state: (6,) which tree grows next, checks, goals in the second tree, the nodes where the trees have met, and
            samples used.

    Returns:
        `UNFINISHED`, `MET` or `FULL`.
    """
    memory, x = memory_for(world, True, np.empty(0, np.bool_)), np.empty(points.shape[2])
    room = parents.shape[1] - 2
    while state[_SAMPLES] < len(samples) and state[_CHECKS] < max_checks:
        turn = state[_TURN]
        if sizes[0] >= room or sizes[1] >= room:
            return FULL
        if state[_GOALS] < len(goals) and (sizes[1] == 0 or state[_GOALS] < sizes[1] // 2):
            _copy(goals[state[_GOALS]], points[1, sizes[1]])
            parents[1, sizes[1]] = -1
            state[_GOALS] += 1
            sizes[1] += 1
        _copy(samples[state[_SAMPLES]], x)
        other = 1 - turn
        state[_TURN], state[_SAMPLES] = other, state[_SAMPLES] + 1
        a, b = points[turn], points[other]
        if not _grow(world, reaches, resolution, a, parents[turn], sizes[turn], x, step, state, memory):
            continue
        _copy(a[sizes[turn]], x)
        sizes[turn] += 1
        grown = 1
        while grown == 1 and state[_CHECKS] < max_checks:
            if sizes[other] >= room:
                return FULL
            grown = _grow(world, reaches, resolution, b, parents[other], sizes[other], x, step, state, memory)
            if grown:
                sizes[other] += 1
        if grown == 2:
            state[_FIRST + turn], state[_FIRST + other] = sizes[turn] - 1, sizes[other] - 1
            return MET
    return UNFINISHED


@inlined
def _length(a, b):
    squared = 0.0
    for j in range(len(a)):
        squared += (a[j] - b[j]) ** 2
    return math.sqrt(squared)


@inlined
def _without_detours(world, reaches, resolution, path, count, memory):
    """Drop corners between which a straight motion is free; return the number of corners left."""
    first = 0
    while first + 2 < count:
        for last in range(count - 1, first + 1, -1):
            if free_inside(world, reaches, resolution, path[first], path[last], memory) >= 0:
                dropped = last - first - 1
                for k in range(last, count):
                    _copy(path[k], path[k - dropped])
                count -= dropped
                break
        first += 1
    return count


@kernel(f"i8({WORLD}, f8[::1], f8, f8[:, ::1], i8, f8[:, ::1], i8)", writes=("path",))
def shorten(world: World, reaches: Array, resolution: float, draws: Array, idle: int, path: Array, count: int) -> int:
    """Shorten a path by straight motions between its corners, then between random points of it.

    Args:
        world: The arm and the scene.
        reaches: Largest motions per radian.
        resolution: Metres between two checks.
        draws: (d, 2) random numbers from 0 to 1.
        idle: Number of attempts in a row without a shorter path after which it ends.
        path: (capacity, n) the path, with room for one more corner for each draw.
        count: Number of its corners.

    Returns:
        The new number of corners.
    """
    memory, ends = memory_for(world, True, np.empty(0, np.bool_)), np.empty(len(path))
    a, b = np.empty(path.shape[1]), np.empty(path.shape[1])
    count = _without_detours(world, reaches, resolution, path, count, memory)
    failures, k = 0, 0
    while k < len(draws) and failures < idle and count > 2:
        ends[0] = 0.0
        for i in range(1, count):
            ends[i] = ends[i - 1] + _length(path[i - 1], path[i])
        low, high = min(draws[k, 0], draws[k, 1]) * ends[count - 1], max(draws[k, 0], draws[k, 1]) * ends[count - 1]
        k += 1
        failures += 1
        first, last = 0, count - 2
        while first < count - 2 and ends[first + 1] <= low:
            first += 1
        while last > 0 and ends[last] > high:
            last -= 1
        if first >= last:
            continue
        f = (low - ends[first]) / (ends[first + 1] - ends[first])
        g = (high - ends[last]) / (ends[last + 1] - ends[last])
        for j in range(len(a)):
            a[j] = path[first, j] + f * (path[first + 1, j] - path[first, j])
            b[j] = path[last, j] + g * (path[last + 1, j] - path[last, j])
        if _length(a, b) > high - low - 1e-6:
            continue
        free = True
        for end in (a, b):
            _copy(end, memory[0])
            free = free and gap(world, 0.0, memory) >= 0.0
        if not free or free_inside(world, reaches, resolution, a, b, memory) < 0:
            continue
        shift = first + 2 - last  # corners from first + 1 to last become two
        if shift > 0:
            for i in range(count - 1, last, -1):
                _copy(path[i], path[i + shift])
        elif shift < 0:
            for i in range(last + 1, count):
                _copy(path[i], path[i + shift])
        _copy(a, path[first + 1])
        _copy(b, path[first + 2])
        count += shift
        failures = 0
    return _without_detours(world, reaches, resolution, path, count, memory)
