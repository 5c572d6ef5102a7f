"""`plan`: from a scene and a target to a collision-free joint path, with any planner of OMPL."""

from __future__ import annotations

import math
import time
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import (
    COARSE,
    COLLISION_PAIRS,
    PROOF,
    CollisionChecker,
    checker_of,
    path_clearance,
)
from greenhouse_gym.motion.goals import Goals, sample_budget, search_goals
from greenhouse_gym.motion.margins import with_margin
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.unexplained_cells import with_unexplained_cells
from greenhouse_gym.motion.unknown_space import depths_of, guarded, occupancy_of, unknown_length
from greenhouse_gym.planning.exchange import Answer, Query
from greenhouse_gym.planning.planner_settings import PlannerSettings
from greenhouse_gym.planning.planners import PLANNERS, PlannerInfo
from greenhouse_gym.planning.registered import PlannerFailedError, run_registered
from greenhouse_gym.planning.result import PlanResult, Status
from greenhouse_gym.planning.worker import WorkerCrashedError, WorkerFailedError, WorkerTimeoutError, shared_worker
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene

_POOL = 240  # goal configurations of which those that keep out of unknown space are chosen
_CANDIDATES = (
    4  # solutions of inverse kinematics looked at for each goal configuration, where unknown space is in the way
)
_SHARE = 1 / 8  # of the time and checks left, for each try to keep out of unknown space but the last
_SLOWEST = 0.001  # seconds that a check never takes, a hundred times what it does
_LONGEST = 1e6  # seconds; what comes near the range of the system's clocks is cut to this

GRACE = 5.0
"""Seconds beyond the time limit after which a planner that does not return is killed."""


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
    settings: PlannerSettings | None = None,
    first_solution: bool = False,
    pairs: Collection[str] = COLLISION_PAIRS,
    unknown: str | float = "free",
    margin: float = 0.0,
    unexplained: bool = False,
) -> PlanResult:
    """Plan a path that brings the tool to a tomato and touches nothing else.

    OMPL's planners run in a process of their own; whatever happens there ends in a status. Their path is shortened;
    that of a planner of `register_planner` is taken as it is. It counts only after every motion has been proven free
    in this process.

    Args:
        scene: The scene.
        target: Index of the tomato in the scene.
        robot: Name or file of the arm, or a `Robot`.
        planner: A name in `PLANNERS`.
        time_limit: Seconds the planner may search; None has ``max_checks`` alone end the search.
        max_checks: Number of collision checks after which the search ends. As long as this and not the time ends it,
            the same seed gives the same path (for planners that are themselves reproducible, such as RRTConnect).
        goals: How many goal configurations to find, or the configurations (k, joints) themselves, radians.
        seed: Seed of the goal search and of the planner.
        start: (joints,) start configuration, radians, or its name in `Robot.starts`; the arm's own when left out.
        settings: The planner's settings, as ``PLANNERS[planner].with_settings(...)`` makes them; its usual ones when
            left out.
        first_solution: Have planners that go on improving their path stop at the first one. They are then as fast as
            they can be: only paths that are to be improved are searched at the fine resolution of the proof. CForest,
            LBTRRT, LazyLBTRRT and PRMstar, which do not tell when they have one, use their time up all the same, and
            so does LazyPRMstar in most cases, which is asked only when it checks something.
        pairs: What the arm is checked against, of `COLLISION_PAIRS`; all of it unless less is asked for.
        unknown: What space that the scan did not see is: "free", as if it were empty; "forbid", as if it were full, but
            where the arm and its cart stand; a number, entered no deeper than that many metres; "avoid", first
            forbidden, then entered no deeper than each of `greenhouse_gym.motion.unknown_space.DEPTHS`, at last free.
            Each of those tries gets an eighth of the time and checks that are left, the last all of them. Unless it is
            "free", the result says how long the way through unknown space is.
        margin: How far the arm keeps from boxes of clutter, metres, but from those beside its start: leaves reach
            farther than a scan shows, see `greenhouse_gym.motion.margins`.
        unexplained: Whether the arm keeps out of where the scan saw a surface without a shape, see
            `greenhouse_gym.motion.unexplained_cells`.

    Raises:
        UnknownNameError: No such planner, arm or collision pair.
        InvalidValueError: No such tomato; a limit that is not positive and finite, or none at all; a negative seed or
            margin; a start or goals outside the limits; a scene that does not say what was seen where that is asked.
        MissingDependencyError: OMPL is not installed.
    """
    arm, depths = get_robot(robot), depths_of(unknown)
    if unknown != "free" or unexplained:
        occupancy_of(scene)
    _seconds(time_limit, max_checks)  # refuses limits that make no sense before anything is searched
    origin = arm.configuration(start)
    scene = with_margin(scene, arm, origin, margin)
    scene = with_unexplained_cells(scene, arm, origin) if unexplained else scene
    began = time.perf_counter()
    statistics = None
    if isinstance(goals, int | np.integer):
        count, widest = int(goals), guarded(scene, arm, origin, depths[-1])
        checker = checker_of(widest, target, pairs)
        pool = max(count, _POOL) if len(depths) > 1 else count
        searched = search_goals(widest, checker, target, pool, seed=seed, budget=sample_budget(depths[-1]))
        ends, statistics = searched.configurations, searched.statistics
    else:
        ends = _configurations("goals", goals.configurations if isinstance(goals, Goals) else goals, arm)
        count = len(ends)
    goal_time = time.perf_counter() - began
    for depth in depths:
        around = guarded(scene, arm, origin, depth)
        checker = checker_of(around, target, pairs)
        free = ends[[checker.is_free(end) for end in ends]][:count]
        share = 1.0 if depth == depths[-1] else _SHARE
        seconds = None if time_limit is None else time_limit * share
        checks = None if max_checks is None else max(1, int(max_checks * share))
        result = plan_with(
            around, checker, target, planner, seconds, checks, free, seed, origin, settings, first_solution
        )
        if result.path is not None:
            break
        time_limit = None if time_limit is None else time_limit - min(time_limit / 2, result.planning_time)
        max_checks = None if max_checks is None else max(1, max_checks - result.checks)
    result = replace(result, goal_time=goal_time + result.goal_time, goals=statistics)
    path = result.path
    if path is None:
        return result
    result = replace(result, clearance=path_clearance(guarded(scene, arm, origin, math.inf), target, path))
    if unknown == "free":
        return result
    way = unknown_length(scene, arm, path)
    message = f"the path must leave the seen space for {way:.2f} m" if way > 0 else ""
    return replace(result, unknown_length=way, message=message)


def plan_with(
    compiled: CompiledScene,
    checker: CollisionChecker,
    target: int,
    planner: str = "RRTConnect",
    time_limit: float | None = 5.0,
    max_checks: int | None = None,
    goals: int | Goals | npt.ArrayLike = 60,
    seed: int = 0,
    start: str | npt.ArrayLike | None = None,
    settings: PlannerSettings | None = None,
    first_solution: bool = False,
) -> PlanResult:
    """As `plan`, for a scene compiled and a checker made already; the path's clearance is not measured."""
    info = PLANNERS[planner]
    chosen = info.settings if settings is None else settings
    if type(chosen) is not type(info.settings):
        raise InvalidValueError(
            f"settings: {planner} takes {type(info.settings).__name__}, got {type(chosen).__name__}"
        )
    require_seed(seed)
    seconds = _seconds(time_limit, max_checks)
    arm = compiled.robot
    origin = _configurations("start", np.asarray(arm.configuration(start))[None], arm)[0]
    if not checker.is_free(origin):
        touching = ", ".join(f"{a} with {b}" for a, b in checker.contacts(origin))
        return PlanResult("start_in_collision", None, planner, message=f"at the start: {touching}")
    began = time.perf_counter()
    statistics = None
    if isinstance(goals, int | np.integer):
        searched = search_goals(compiled, checker, target, count=int(goals), seed=seed)
        ends, statistics = searched.configurations, searched.statistics
    else:
        given = goals.configurations if isinstance(goals, Goals) else np.asarray(goals, dtype=np.float64)
        ends = _configurations("goals", given, arm)
        ends = ends[[checker.is_free(end) for end in ends]]
    if info.single_goal and len(ends):
        # the way back to the start is free the longest: cheaper to reach than the nearest, and than a random one
        ends = ends[np.argmax([checker.free_share(end, origin, COARSE) for end in ends])][None]
    goal_time = time.perf_counter() - began
    if not len(ends):
        return PlanResult("no_goal", None, planner, goal_time=goal_time, goals=statistics)
    query = Query(
        model=checker.model,
        reaches=checker.reaches,
        lower=arm.lower,
        upper=arm.upper,
        start=origin,
        goals=ends,
        planner=planner,
        settings=chosen.changed(),
        time_limit=seconds,
        max_checks=max_checks,
        optimizing=info.optimizing and not first_solution,
        seed=seed,
    )
    return replace(_ask(info, chosen, checker, query), goal_time=goal_time, goals=statistics)


def _seconds(time_limit: float | None, max_checks: int | None) -> float:
    """The limit on time, one that the checks never come near where there is none."""
    if max_checks is not None and max_checks < 1:
        raise InvalidValueError(f"max_checks must be at least 1 or None, got {max_checks!r}")
    if time_limit is None:
        if max_checks is None:
            raise InvalidValueError("time_limit is None: give max_checks, or nothing would end the search")
        return min(60.0 + _SLOWEST * max_checks, _LONGEST)
    if not (math.isfinite(time_limit) and time_limit > 0):
        raise InvalidValueError(f"time_limit must be a positive, finite number of seconds, or None, got {time_limit!r}")
    return min(time_limit, _LONGEST)


def _ask(info: PlannerInfo, settings: PlannerSettings, checker: CollisionChecker, query: Query) -> PlanResult:
    """Have the planner answer, OMPL's in the planning process, and believe nothing it says about the path."""
    began = time.perf_counter()

    def failed(status: Status, error: Exception) -> PlanResult:
        return PlanResult(
            status, None, query.planner, planning_time=time.perf_counter() - began, message=f"{query.planner}: {error}"
        )

    answer: Answer
    try:
        if info.solve is not None:
            answer = run_registered(info.solve, settings, query)
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


def _flaw(checker: CollisionChecker, query: Query, path: Array) -> str:
    """What is wrong with a path, or nothing."""
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


def _configurations(what: str, values: npt.ArrayLike, arm: Robot) -> Array:
    """Configurations (k, joints) of an arm, within its limits."""
    array = np.asarray(values, dtype=np.float64)
    joints = len(arm.joints)
    if array.ndim != 2 or array.shape[1] != joints:
        raise InvalidValueError(f"{what}: {arm.name} takes {joints} joint angles, got an array of shape {array.shape}")
    outside = ~((array >= arm.lower) & (array <= arm.upper))
    if outside.any():
        row, joint = np.argwhere(outside)[0]
        raise InvalidValueError(
            f"{what}: joint {arm.joints[joint]!r} at {array[row, joint]:.5f} rad is outside its limits, "
            f"{arm.lower[joint]:.5f} to {arm.upper[joint]:.5f}"
        )
    return array
