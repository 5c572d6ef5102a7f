"""`plan`: a collision-free joint path from a scene and a target, by any planner; and commands along the path."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, check_flag, check_whole, require_choice, require_seed
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.caution import with_margin, with_unexplained_cells
from greenhouse_gym.motion.clearance import path_clearance
from greenhouse_gym.motion.collision import COLLISION_PAIRS, LEAVES, MARGIN, CollisionChecker, Leaves, planning_model
from greenhouse_gym.motion.goals import Goals, goal_configurations, sample_budget, search_goals
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.motion.path import CORNER_TOLERANCE, follow_path
from greenhouse_gym.motion.proof import checker_of
from greenhouse_gym.motion.unknown_space import depths_of, guarded, occupancy_of, unknown_length
from greenhouse_gym.planning.brushing import plan_brushing
from greenhouse_gym.planning.parameters import Value
from greenhouse_gym.planning.planner_run import check_configurations, plan_with, search_seconds
from greenhouse_gym.planning.result import PlanResult
from greenhouse_gym.robots import Robot, get_robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import CompiledScene

_POOL = 240  # goal configurations, from which those outside unknown space are chosen
_FRACTION = 1 / 8  # of the remaining time and checks, for each attempt to avoid unknown space except the last

_MAX_HALVINGS = 4  # of the corner tolerance


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
    search_seconds(time_limit, max_checks)  # raises before anything is searched
    origin = check_configurations("start", [arm.configuration(start)], arm)[0]
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


def _given_goals(goals: Goals | npt.ArrayLike, arm: Robot) -> Array:
    return check_configurations("goals", goals.configurations if isinstance(goals, Goals) else goals, arm)


def free_commands(
    compiled: CompiledScene,
    target: int,
    path: npt.ArrayLike,
    velocity_limits: npt.ArrayLike,
    acceleration_limits: npt.ArrayLike,
    interval: float,
    leaves: str = LEAVES[0],
) -> Array:
    """Return commands at equal intervals along a path such that the straight motions between them are free.

    They keep half of the planner's margin. If a motion that cuts a corner does not, all corners are passed more slowly
    and closer to the path.

    Args:
        compiled: The scene the path was planned in.
        target: Index of the tomato.
        path: (k, n) configurations, radians, proven free.
        velocity_limits: (n,) rad/s.
        acceleration_limits: (n,) rad/s^2.
        interval: Seconds from one command to the next.
        leaves: "brush" if the path may touch leaves.

    Returns:
        (m, n) commands of `follow_path`; the slowest ones if even those are not free.
    """
    start, lag = np.asarray(path, dtype=np.float64)[:1], compiled.robot.lag
    checker = CollisionChecker(planning_model(compiled, target, margin=MARGIN / 2, leaves=leaves))
    for halving in range(_MAX_HALVINGS + 1):
        tolerance = CORNER_TOLERANCE / 2**halving
        commands = follow_path(path, velocity_limits, acceleration_limits, interval, tolerance, lag)
        if checker.path_is_free(np.concatenate([start, commands]), MARGIN):
            break
    return commands
