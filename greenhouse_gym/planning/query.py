"""`plan`: a collision-free joint path from a scene and a target, by any planner."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, check_flag, check_whole, is_number, require_choice, require_seed
from greenhouse_gym.geometry import Array, numbers_of
from greenhouse_gym.motion.caution import with_margin, with_unexplained_cells
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import (
    COARSE,
    COLLISION_PAIRS,
    LEAVES,
    PROOF,
    Leaves,
)
from greenhouse_gym.motion.goals import Goals, goal_configurations, sample_budget, search_goals
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.proof import ProvingChecker, checker_of
from greenhouse_gym.motion.unknown_space import depths_of, guarded, occupancy_of, unknown_length
from greenhouse_gym.planning.brushing import plan_brushing
from greenhouse_gym.planning.connect import compiled_checker, rrt_connect
from greenhouse_gym.planning.own_planners import PlannerFailedError, run_own_planner
from greenhouse_gym.planning.parameters import Value
from greenhouse_gym.planning.planners import PLANNERS, PlannerInfo
from greenhouse_gym.planning.result import PlanResult, Status
from greenhouse_gym.planning.worker import (
    PlannerAnswer,
    PlannerQuery,
    WorkerCrashedError,
    WorkerFailedError,
    WorkerTimeoutError,
    shared_worker,
)
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene

_POOL = 240  # goal configurations, from which those outside unknown space are chosen
_FRACTION = 1 / 8  # of the remaining time and checks, for each attempt to avoid unknown space except the last
_SLACK = 5.0  # seconds: time of a planner that is to be ended by its checks, apart from these
_SLOWEST = 0.001  # seconds: upper bound of the time for a check, a hundred times the usual
_MAX_CHECKS = 10**15  # which take years
_LONGEST = 1e6  # seconds; longer limits are cut to this because they exceed the range of system clocks

GRACE = 5.0
"""Seconds after the time limit at which a planner that does not return is killed."""


def plan(
    scene: Scene,
    target: int,
    robot: str | Robot = "ur5e",
    planner: str = "RRTConnect",
    time_limit: float | None = 5.0,
    max_checks: int | None = None,
    goals: int | Goals | npt.ArrayLike = 60,
    seed: int = 0,
    start: str | npt.ArrayLike | None = None,
    settings: Mapping[str, Value] | None = None,
    first_solution: bool = False,
    pairs: Collection[str] = COLLISION_PAIRS,
    unknown: str | float = "free",
    margin: float = 0.0,
    unexplained: bool = False,
    leaves: Leaves = LEAVES[0],
) -> PlanResult:
    """Plan a path that brings the tool to a tomato without touching anything else.

    OMPL's planners run in a process of its own; any failure there ends in a status. RRTConnect is compiled and runs in
    the caller's process if the arm is made of capsules and spheres. The paths of all these are shortened; the path of a
    planner of `register_planner` is not. A path counts only after every motion has been proven free in the caller's
    process.

    Args:
        scene: The scene.
        target: Index of the tomato in the scene.
        robot: Name or file of the arm, or a `Robot`.
        planner: A name in `PLANNERS`.
        time_limit: Seconds the planner may search; with None, ``max_checks`` alone ends the search.
        max_checks: Number of collision checks after which the search ends. If this and not the time ends it, the same
            seed gives the same path (for planners that are reproducible, such as RRTConnect).
        goals: Number of goal configurations to find, or the configurations (k, joints) themselves, radians; RRTConnect
            takes up given ones one by one, in their order.
        seed: Seed of the goal search and of the planner.
        start: (joints,) start configuration, radians, or its name in `Robot.starts`; None for the arm's own.
        settings: Parameters to change, such as ``{"range": 0.5}``; ``PLANNERS[planner].parameters`` lists them with
            their valid values.
        first_solution: Stop planners that improve their path at their first one. They then search at coarse resolutions
            first, which is fastest. CForest, LBTRRT, LazyLBTRRT and PRMstar do not report a first path and still use
            all of their time; so does LazyPRMstar mostly, because it can be stopped only when it checks something.
        pairs: Obstacles that the arm is checked against, of `COLLISION_PAIRS`; all by default.
        unknown: How to treat space that the scan did not see: "free" as empty; "forbid" as occupied, except where the
            arm and its cart stand; a number as a limit in metres on how deep a path may enter it; "avoid" as forbidden
            first, then with each limit of `greenhouse_gym.motion.unknown_space.DEPTHS`, and finally as free. Each
            attempt gets an eighth of the remaining time and checks, the last one all of them. Unless it is "free", the
            result reports the length of the path through unknown space.
        margin: Distance to keep from boxes of clutter, metres, except from those next to the start: leaves extend
            beyond their scan, see `greenhouse_gym.motion.caution`.
        unexplained: True to avoid cells where the scan saw a surface that no shape explains, see
            `greenhouse_gym.motion.caution`.
        leaves: "rigid" for leaves as obstacles; "brush" to plan around them and, where that fails, through few of them,
            see `greenhouse_gym.planning.brushing`; or indices (k,) into `Shapes.leaves` of those that may be brushed.

    Raises:
        UnknownNameError: No such planner, parameter, arm, collision pair or treatment of leaves.
        InvalidValueError: No such tomato; a limit that is not positive and finite, or no limit; a negative seed or
            margin; an invalid parameter; a start or goals outside the limits; a scene without an occupancy grid where
            ``unknown`` or ``unexplained`` needs one.
        MissingDependencyError: OMPL is not installed.
    """
    if not isinstance(scene, Scene):
        raise InvalidValueError(f"scene must be a Scene, got {scene!r}")
    if isinstance(pairs, str | np.ndarray) or not isinstance(pairs, Collection):
        raise InvalidValueError(f"pairs must be some of {', '.join(COLLISION_PAIRS)}, got {pairs!r}")
    seed = require_seed(seed)
    if isinstance(leaves, str):
        require_choice("leaves", leaves, LEAVES)
    arm, depths = get_robot(robot), depths_of(unknown)
    everywhere = isinstance(unknown, str) and unknown == "free"
    if check_flag("unexplained", unexplained) or not everywhere:
        occupancy_of(scene)
    _seconds(time_limit, max_checks)  # raises before anything is searched
    origin = _configurations("start", [arm.configuration(start)], arm)[0]
    if isinstance(leaves, str) and leaves == "brush":

        def search(passable: Leaves, ends: Array | None, seconds: float | None, checks: int | None) -> PlanResult:
            return plan(
                scene, target, arm, planner, seconds, checks, goals if ends is None else ends, seed, origin, settings,
                first_solution, pairs, unknown, margin, unexplained, passable,
            )  # fmt: skip

        def find_goals() -> Array:
            if not isinstance(goals, int | np.integer):
                return _given_goals(goals, arm)
            pool = max(int(goals), _POOL)
            return goal_configurations(
                scene, target, arm, pool, seed=seed, unknown=depths[-1], leaves="brush"
            ).configurations

        contacts = LeafContacts(guarded(scene, arm, origin, math.inf))
        return plan_brushing(search, find_goals, contacts, time_limit, max_checks, seed)
    treatment = "rigid" if isinstance(leaves, str) else "brush"
    scene = with_margin(scene, arm, origin, margin, treatment)
    scene = with_unexplained_cells(scene, arm, origin) if unexplained else scene
    began = time.perf_counter()
    statistics, goal_checker = None, None
    if isinstance(goals, int | np.integer):
        count, widest = check_whole("count of goals", goals, 1), guarded(scene, arm, origin, depths[-1])
        goal_checker = checker_of(widest, target, pairs, leaves)
        pool = max(count, _POOL) if len(depths) > 1 else count
        searched = search_goals(widest, goal_checker, target, pool, seed=seed, budget=sample_budget(depths[-1]))
        ends, statistics = searched.configurations, searched.statistics
    else:
        ends = _given_goals(goals, arm)
        count = len(ends)
    goal_time = time.perf_counter() - began
    for depth in depths:
        around = guarded(scene, arm, origin, depth)
        if goal_checker is not None and depth == depths[-1]:
            checker, free = goal_checker, ends[:count]
        else:
            checker = checker_of(around, target, pairs, leaves)
            free = ends[[checker.is_free(end) for end in ends]][:count]
        fraction = 1.0 if depth == depths[-1] else _FRACTION
        seconds = None if time_limit is None else time_limit * fraction
        checks = None if max_checks is None else max(1, int(max_checks * fraction))
        result = plan_with(
            around, checker, free, planner, seconds, checks, seed, origin, settings, first_solution,
            gradual_goals=goal_checker is None or treatment == "brush",  # those that touch few leaves come first
        )  # fmt: skip
        if result.path is not None:
            break
        time_limit = None if time_limit is None else time_limit - min(time_limit / 2, result.planning_time)
        max_checks = None if max_checks is None else max(1, max_checks - result.checks)
    result = replace(result, goal_time=goal_time, goals=statistics)
    path = result.path
    if path is None:
        return result
    known = guarded(scene, arm, origin, math.inf)
    result = replace(result, clearance=path_clearance(known, target, path, treatment))
    if treatment == "brush":
        result = replace(result, brushed_leaves=len(LeafContacts(known).brushed(path)))
    if everywhere:
        return result
    length = unknown_length(scene, arm, path)
    message = f"the path leads {length:.2f} m through unknown space" if length > 0 else ""
    return replace(result, unknown_length=length, message=message)


def plan_with(
    compiled: CompiledScene,
    checker: ProvingChecker,
    goals: Array,
    planner: str = "RRTConnect",
    time_limit: float | None = 5.0,
    max_checks: int | None = None,
    seed: int = 0,
    start: str | npt.ArrayLike | None = None,
    settings: Mapping[str, Value] | None = None,
    first_solution: bool = False,
    gradual_goals: bool = False,
) -> PlanResult:
    """Plan to collision-free goals (k, joints) with a compiled scene and its checker, as `plan` does.

    The path's clearance is not measured. With ``gradual_goals``, RRTConnect needs as many checks as OMPL's, see
    `PlannerQuery`.
    """
    info = PLANNERS[planner]
    chosen = info.with_settings({} if settings is None else settings)
    check_flag("first_solution", first_solution)
    seed = require_seed(seed)
    seconds = _seconds(time_limit, max_checks)
    arm = compiled.robot
    origin = _configurations("start", [arm.configuration(start)], arm)[0]
    if not checker.is_free(origin):
        pairs = [[compiled.geom_name(geom) for geom in pair] for pair in checker.contacts(origin)]
        touching = ", ".join(f"{a} with {b}" for a, b in pairs)
        return PlanResult("start_in_collision", None, planner, message=f"at the start: {touching}")
    if not len(goals):
        return PlanResult("no_goal", None, planner)
    if info.single_goal:
        # the motion back to the start is free for longest: cheaper to reach than the nearest goal or a random one
        goals = goals[np.argmax([checker.free_fraction(end, origin, COARSE) for end in goals])][None]
    query = PlannerQuery(
        model=checker.model,
        reaches=checker.reaches,
        lower=arm.lower,
        upper=arm.upper,
        start=origin,
        goals=goals,
        planner=planner,
        settings=chosen,
        time_limit=seconds,
        max_checks=max_checks,
        optimizing=info.optimizing and not first_solution,
        seed=seed,
        gradual_goals=gradual_goals,
    )
    return _run_planner(info, checker, query)


def _seconds(time_limit: float | None, max_checks: int | None) -> float:
    """Return the limit on time; without one, a limit that the checks never reach."""
    if max_checks is not None:
        check_whole("max_checks", max_checks, 1, _MAX_CHECKS)
    if time_limit is None:
        if max_checks is None:
            raise InvalidValueError("time_limit is None: give max_checks, otherwise nothing ends the search")
        return min(_SLACK + _SLOWEST * max_checks, _LONGEST)
    if not (is_number(time_limit) and time_limit > 0):
        raise InvalidValueError(f"time_limit must be a positive, finite number of seconds, or None, got {time_limit!r}")
    return min(float(time_limit), _LONGEST)


def _run_planner(info: PlannerInfo, checker: ProvingChecker, query: PlannerQuery) -> PlanResult:
    """Run a planner, here or in the planning process, and verify its path."""
    began = time.perf_counter()

    def failed(status: Status, error: Exception) -> PlanResult:
        return PlanResult(
            status, None, query.planner, planning_time=time.perf_counter() - began, message=f"{query.planner}: {error}"
        )

    answer: PlannerAnswer
    try:
        search = compiled_checker(query, checker.search)
        if info.solve is not None:
            answer = run_own_planner(info.solve, query)
        elif search is not None:
            answer = rrt_connect(query, search)
        else:
            answer = shared_worker().call("solve", query, query.time_limit + GRACE)
    except WorkerTimeoutError as error:
        return failed("timeout", error)
    except (WorkerCrashedError, WorkerFailedError, PlannerFailedError) as error:
        return failed("crashed", error)
    status: Status = answer.status
    path, message = answer.path, "the planner's path is not free" if answer.status == "invalid" else ""
    if path is not None:
        message = _flaw(checker, query, path)
        if message:
            status, path = "invalid", None
    return PlanResult(
        status,
        path,
        query.planner,
        raw_path=answer.raw_path,
        raw_length=math.nan if answer.raw_path is None else path_length(answer.raw_path),
        length=math.nan if path is None else path_length(path),
        planning_time=answer.planning_time,
        simplification_time=answer.simplification_time,
        checks=answer.checks,
        tree_size=answer.tree_size,
        costs=answer.costs,
        message=message,
    )


def _flaw(checker: ProvingChecker, query: PlannerQuery, path: Array) -> str:
    """Return a description of a path's first flaw, or an empty text."""
    if path.ndim != 2 or path.shape[1:] != query.start.shape or not len(path) or not np.isfinite(path).all():
        return f"{query.planner}: the path has the shape {path.shape} or entries that are not numbers"
    if not np.array_equal(path[0], query.start):
        return f"{query.planner}: the path starts at {path[0].tolist()}, not at {query.start.tolist()}"
    if not (path[-1] == query.goals).all(-1).any():
        return f"{query.planner}: the path ends at {path[-1].tolist()}, which is none of the goals"
    if ((path < query.lower) | (path > query.upper)).any():
        return f"{query.planner}: the path leaves the joint limits"
    if not checker.path_is_free(path, PROOF):
        return f"{query.planner}: the path is not free"
    return ""


def _given_goals(goals: Goals | npt.ArrayLike, arm: Robot) -> Array:
    return _configurations("goals", goals.configurations if isinstance(goals, Goals) else goals, arm)


def _configurations(name: str, values: Any, arm: Robot) -> Array:
    """Return configurations (k, joints) of an arm after checking their shape and limits."""
    joints = len(arm.joints)
    array = numbers_of(values)
    if array.ndim != 2 or array.shape[1] != joints:
        raise InvalidValueError(f"{name}: {arm.name} takes {joints} joint angles, got an array of shape {array.shape}")
    outside = ~((array >= arm.lower) & (array <= arm.upper))
    if outside.any():
        row, joint = np.argwhere(outside)[0]
        raise InvalidValueError(
            f"{name}: joint {arm.joints[joint]!r} at {array[row, joint]:.5f} rad is outside its limits, "
            f"{arm.lower[joint]:.5f} to {arm.upper[joint]:.5f}"
        )
    return array
