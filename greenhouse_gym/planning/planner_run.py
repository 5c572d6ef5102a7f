"""Run a planner from a configuration to free goal configurations, and prove the path that it returns."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, check_whole, is_number, require_seed
from greenhouse_gym.geometry import Array, numbers_of
from greenhouse_gym.motion.collision import COARSE, PROOF
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.proof import ProvingChecker
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
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene.mjcf import CompiledScene

_SLACK = 5.0  # seconds: time of a planner that is to be ended by its checks, apart from these
_SLOWEST = 0.001  # seconds: upper bound of the time for a check, a hundred times the usual
_LONGEST = 1e6  # seconds; longer limits are cut to this because they exceed the range of system clocks

GRACE = 5.0
"""Seconds after the time limit at which a planner that does not return is killed."""


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
    chosen = info.with_settings(settings or {})
    seed = require_seed(seed)
    seconds = search_seconds(time_limit, max_checks)
    arm = compiled.robot
    origin = check_configurations("start", [arm.configuration(start)], arm)[0]
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


def search_seconds(time_limit: float | None, max_checks: int | None) -> float:
    """Return the limit on time; without one, a limit that the checks never reach."""
    if max_checks is not None:
        check_whole("max_checks", max_checks, 1)
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


def check_configurations(name: str, values: Any, arm: Robot) -> Array:
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
