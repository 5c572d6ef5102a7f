"""The process in which OMPL runs: takes queries from a connection, answers each, one at a time.

This is the one module that imports OMPL, and it is never imported by the caller's process: some planners hang or crash,
and a separate process can be killed. `greenhouse_gym.planning.worker` starts it and talks to it.
"""

from __future__ import annotations

import ctypes
import inspect
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from multiprocessing.connection import Connection
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.collision import PROOF, CollisionChecker

SEARCH = 3 * PROOF
"""Resolution at which motions are checked first, metres; `PROOF` follows where that was too coarse."""


Outcome = Literal["solved", "approximate", "no_solution", "invalid"]


@dataclass(frozen=True, eq=False)
class Query:
    """What a planner is asked. Angles are radians.

    Attributes:
        model: The model to check collisions with, as `planning_model` makes it.
        lower: (joints,) lower limits.
        upper: (joints,) upper limits.
        start: (joints,) start configuration.
        goals: (k, joints) goal configurations, any of which will do.
        planner: Name of an OMPL planner.
        time_limit: Seconds.
        max_checks: Number of configurations that may be checked, or None.
        step: Longest motion by which the planner's trees grow, or None for OMPL's own choice.
        optimizing: Whether the planner uses all its time: it then checks motions at `PROOF` from the start.
        seed: Seed of OMPL's random numbers.
    """

    model: mujoco.MjModel
    lower: Array
    upper: Array
    start: Array
    goals: Array
    planner: str
    time_limit: float
    max_checks: int | None
    step: float | None
    optimizing: bool
    seed: int


@dataclass(frozen=True, eq=False)
class Answer:
    """What a planner found.

    Attributes:
        status: "invalid" if the planner's path could not be proven free.
        path: (k, joints) the simplified path, or None.
        raw_path: (k, joints) the planner's own path, or None.
        planning_time: Seconds the planner took.
        simplification_time: Seconds for shortening the path and proving it free.
        checks: Configurations the planner checked.
    """

    status: Outcome
    path: Array | None
    raw_path: Array | None
    planning_time: float
    simplification_time: float
    checks: int


def import_ompl() -> tuple[ModuleType, ModuleType, ModuleType]:
    """Import ``ompl.base``, ``ompl.geometric`` and ``ompl.util`` with one copy of the library.

    The 1.7.0 wheel carries libompl twice and loads both, after which the interpreter dies at exit. While it is
    imported, its request for the one copy is answered with the other.
    """
    spec = find_spec("ompl")
    assert spec is not None
    assert spec.origin is not None
    vendored = sorted((Path(spec.origin).parents[1] / "ompl.libs").glob("libompl-*.so*"))
    original = ctypes.CDLL

    def load(name: Any, *args: Any, **kwargs: Any) -> ctypes.CDLL:
        if vendored and name is not None and "libompl" in Path(name).name:
            name = str(vendored[0])
        return original(name, *args, **kwargs)

    ctypes.CDLL = load  # type: ignore[assignment,misc]
    try:
        from ompl import base, geometric, util
    finally:
        ctypes.CDLL = original  # type: ignore[misc]
    util.setLogLevel(util.LOG_NONE)
    return base, geometric, util


def serve(handle: int) -> None:
    """Answer queries from the connection with this handle until it is closed.

    A message is (command, argument, hard limit in seconds); the answer is (True, result) or (False, error text).
    """
    connection = Connection(handle)
    try:
        ompl = import_ompl()
    except Exception as error:
        connection.send((False, f"OMPL cannot be imported: {error}"))
        return
    connection.send((True, "ready"))
    commands: dict[str, Callable[[Any], Any]] = {
        "planners": lambda _: planner_names(ompl),
        "solve": lambda query: solve(ompl, query),
        "sleep": time.sleep,  # stands in for a planner that ignores its time limit
    }
    while True:
        try:
            command, argument, hard_limit = connection.recv()
        except EOFError:
            return
        # should the caller die meanwhile, nothing of this process stays behind
        signal.setitimer(signal.ITIMER_REAL, hard_limit + 10.0)
        try:
            reply = (True, commands[command](argument))
        except Exception as error:
            reply = (False, f"{type(error).__name__}: {error}")
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        try:
            connection.send(reply)
        except BrokenPipeError:
            return


def planner_names(ompl: tuple[ModuleType, ModuleType, ModuleType]) -> tuple[str, ...]:
    """Names of the geometric planners of the installed OMPL."""
    base, geometric, _ = ompl
    members = inspect.getmembers(geometric, inspect.isclass)
    return tuple(sorted(name for name, kind in members if issubclass(kind, base.Planner)))


def solve(ompl: tuple[ModuleType, ModuleType, ModuleType], query: Query) -> Answer:
    """Plan, shorten the path, and prove it free; at the search resolution first, then at the proving one.

    Everything of OMPL is built anew after the seed is set, so the same query gives the same path as long as the number
    of checks and not the time ends the search.
    """
    base, geometric, util = ompl
    util.RNG.setSeed(query.seed % (2**31) + 1)  # 0 is not allowed
    checker = CollisionChecker(query.model)
    began = time.perf_counter()
    simplification_time = 0.0
    status: Outcome = "no_solution"
    raw, path = None, None
    for resolution in (PROOF,) if query.optimizing else (SEARCH, PROOF):
        problem = _Problem(base, query, checker, resolution, began + query.time_limit + simplification_time)
        planner = getattr(geometric, query.planner)(problem.information)
        planner.setProblemDefinition(problem.definition)
        if query.step is not None:
            planner.params().setParam("range", str(query.step))
        planner.setup()
        planner.solve(problem.termination)
        solved = problem.definition.hasExactSolution()
        if not solved:
            if status == "no_solution" and problem.definition.hasApproximateSolution():
                status = "approximate"
            break
        solve_end, solve_checks = time.perf_counter(), checker.checks
        found = problem.definition.getSolutionPath()
        raw = _to_array(found, len(query.start))
        path = _simplified(geometric, problem, checker, found, raw)
        simplification_time += time.perf_counter() - solve_end
        checker.checks = solve_checks
        status = "invalid" if path is None else "solved"
        if path is not None:
            break
    total = time.perf_counter() - began
    return Answer(status, path, raw, total - simplification_time, simplification_time, checker.checks)


def _simplified(
    geometric: ModuleType, problem: _Problem, checker: CollisionChecker, found: Any, raw: Array
) -> Array | None:
    """The path shortened and proven free; the planner's own path if only that can be proven, or None."""
    proven = checker.path_is_free(raw, PROOF)
    problem.limits.hold = False
    if proven:
        problem.limits.resolution = PROOF
    simplifier = geometric.PathSimplifier(problem.information)
    simplifier.reduceVertices(found)
    simplifier.partialShortcutPath(found)
    simplifier.reduceVertices(found)
    simplifier.collapseCloseVertices(found)
    shortened = _to_array(found, raw.shape[1])
    if checker.path_is_free(shortened, PROOF):
        return shortened
    return raw if proven else None


def _to_array(path: Any, joints: int) -> Array:
    return np.array([[state[j] for j in range(joints)] for state in path.getStates()])


@dataclass
class _Limits:
    """At which resolution motions are checked, and whether the limits on time and checks hold."""

    resolution: float
    hold: bool = True


class _Problem:
    """A query as OMPL's objects, with limits on time and checks."""

    def __init__(self, base: ModuleType, query: Query, checker: CollisionChecker, resolution: float, deadline: float):
        joints = len(query.start)
        # what the callbacks share; they must not know this object, or C++ and Python would keep each other alive
        limits = self.limits = _Limits(resolution)
        max_checks = float("inf") if query.max_checks is None else query.max_checks

        def exhausted() -> bool:
            return limits.hold and (checker.checks >= max_checks or time.perf_counter() >= deadline)

        def is_free(state: Any) -> bool:
            return not exhausted() and checker.is_free([state[j] for j in range(joints)])

        class Motions(base.MotionValidator):  # type: ignore[misc,name-defined]
            """Whole motions per call from C++, checked exactly as the finished path will be."""

            def checkMotion(self, first: Any, second: Any, last_valid: Any = None) -> bool:  # noqa: N802
                a = np.array([first[j] for j in range(joints)])
                b = np.array([second[j] for j in range(joints)])
                free = not exhausted() and checker.motion_is_free(a, b, limits.resolution)
                if last_valid is not None and not free:
                    # the state that receives the last free configuration may be the motion's end itself
                    share = 0.0 if exhausted() else checker.free_share(a, b, limits.resolution)
                    last_valid.second = share
                    if last_valid.first is not None:
                        for j, angle in enumerate(a + share * (b - a)):
                            last_valid.first[j] = float(angle)
                return free

        bounds = base.RealVectorBounds(joints)
        for j in range(joints):
            bounds.setLow(j, float(query.lower[j]))
            bounds.setHigh(j, float(query.upper[j]))
        self._space = base.RealVectorStateSpace(joints)
        self._space.setBounds(bounds)
        self.information = base.SpaceInformation(self._space)
        self._checker = base.StateValidityCheckerFn(is_free)
        self.information.setStateValidityChecker(self._checker)
        self._motions = Motions(self.information)
        self.information.setMotionValidator(self._motions)
        # for the planners that check states along a motion on their own
        finest = resolution / float(np.linalg.norm(checker.reaches))
        self.information.setStateValidityCheckingResolution(finest / self._space.getMaximumExtent())
        self.information.setup()
        self.definition = base.ProblemDefinition(self.information)
        self.definition.addStartState(self._state(base, query.start))
        goals = base.GoalStates(self.information)
        for goal in query.goals:
            goals.addState(self._state(base, goal))
        self.definition.setGoal(goals)
        self.termination = base.PlannerTerminationCondition(base.PlannerTerminationConditionFn(exhausted))

    def _state(self, base: ModuleType, configuration: Array) -> Any:
        state = base.State(self._space)
        for j, angle in enumerate(configuration):
            state[j] = float(angle)
        return state
