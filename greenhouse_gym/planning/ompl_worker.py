"""The process in which OMPL runs: it takes queries from a connection and answers them one by one.

Some planners hang or crash; a process of its own can be killed. The caller's process does not import this module:
`greenhouse_gym.planning.worker` starts the process and talks to it.
"""

from __future__ import annotations

import ctypes
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF, RESOLUTIONS, CollisionChecker
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.planning.ompl_binding import OmplProblem, import_ompl, planner_names, planner_parameters, set_seed
from greenhouse_gym.planning.ompl_planners import JOINING, THREADED, Ompl, Planner
from greenhouse_gym.planning.worker import Outcome, PlannerAnswer, PlannerQuery

COST_INTERVAL = 0.001
"""Seconds between two readings of the cost of the best path while it is improved."""

_CACHE_SIZE = 100_000  # configurations, about 30 MB
_PR_SET_PDEATHSIG = 1  # of Linux's prctl


def serve(handle: int, memory_limit: int, caller: int) -> None:
    """Answer queries from a connection until it is closed.

    A message is (command, argument, hard limit in seconds); the answer is (True, result) or (False, error text).

    Args:
        handle: The connection's handle.
        memory_limit: Bytes of data this process may allocate, on systems that can limit them.
        caller: Process id of the caller; this process dies with it on Linux, and elsewhere after the hard limit.
    """
    _die_with(caller)
    _limit_memory(memory_limit)
    connection = Connection(handle)
    try:
        ompl = import_ompl()
        import_module("greenhouse_gym.motion.collision_kernels")  # compiled before any time limit counts
    except Exception as error:
        connection.send((False, f"OMPL cannot be imported: {error}"))
        return
    connection.send((True, "ready"))
    commands: dict[str, Callable[[Any], Any]] = {
        "planners": lambda _: planner_names(ompl),
        "parameters": lambda name: planner_parameters(ompl, name),
        "solve": lambda query: solve(ompl, query),
        "sleep": time.sleep,  # stands in for a planner that ignores its time limit
        "fill": lambda size: len(bytearray(size)),  # stands in for a planner that takes all memory
    }
    while True:
        try:
            command, argument, hard_limit = connection.recv()
        except EOFError:
            return
        # should the caller die meanwhile, this process ends soon, too
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


def _die_with(caller: int) -> None:
    """Ask the system to kill this process when the thread that started it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGKILL), 0, 0, 0)
        if os.getppid() != caller:  # it died before
            os._exit(1)


def _limit_memory(limit: int) -> None:
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def solve(ompl: Ompl, query: PlannerQuery) -> PlannerAnswer:
    """Plan, shorten the path and prove it free, at a coarse resolution first, then at finer ones.

    All of OMPL's objects are made after the seed is set, so the same query gives the same path if the number of checks
    and not the time ends the search.
    """
    set_seed(ompl, query.seed)
    checker = search_checker(query.model, query.reaches)
    search = _Search(checker, math.inf if query.max_checks is None else query.max_checks, query.optimizing)
    try:
        return _solve(ompl, query, search)
    finally:
        search.forget()


def _solve(ompl: Ompl, query: PlannerQuery, search: _Search) -> PlannerAnswer:
    checker = search.checker
    planning_time, simplification_time, tree_size = 0.0, 0.0, 0
    status: Outcome = "no_solution"
    raw, path = None, None
    for resolution in (PROOF,) if query.optimizing else RESOLUTIONS:
        began = time.perf_counter()
        search.begin(began - planning_time, query.time_limit, resolution)
        fineness = JOINING.get(query.planner, resolution / float(np.linalg.norm(checker.reaches)))
        problem = OmplProblem(
            ompl, query.lower, query.upper, query.start, query.goals, search.is_free, search.free_fraction, fineness,
            threads=query.planner in THREADED,
        )  # fmt: skip
        planner = problem.planner(query.planner, query.settings)
        search.run(planner)
        solve_end, solve_checks = time.perf_counter(), checker.checks
        planning_time += solve_end - began
        tree_size = problem.tree_size(planner)
        approximate = problem.definition.hasApproximateSolution()
        raw = problem.take_solution()
        del planner
        if raw is None:
            if status == "no_solution" and approximate:
                status = "approximate"
            break
        search.note(solve_end, float(np.linalg.norm(np.diff(raw, axis=0), axis=-1).sum()))
        began = time.perf_counter()
        path = _simplified(problem, search, raw)
        simplification_time += time.perf_counter() - began
        checker.checks = solve_checks
        status = "invalid" if path is None else "solved"
        if path is not None:
            break
    costs = np.array(search.costs).reshape(-1, 2)
    return PlannerAnswer(status, path, raw, planning_time, simplification_time, checker.checks, tree_size, costs)


def _simplified(problem: OmplProblem, search: _Search, raw: Array) -> Array | None:
    """Return the shortened path if it is proven free, else the planner's own path if that is proven free, else None."""
    proven = search.checker.path_is_free(raw, PROOF)
    if proven:
        search.resolution = PROOF
    shortened = problem.shortened(raw)
    if search.checker.path_is_free(shortened, PROOF):
        return shortened
    return raw if proven else None


@dataclass
class _Search:
    """Collision checks of a planner, with its limits of time and checks and the costs found so far."""

    checker: CollisionChecker
    max_checks: float
    optimizing: bool
    resolution: float = PROOF
    began: float = 0.0
    deadline: float = math.inf
    limited: bool = True
    planner: Planner | None = None
    best_cost: Callable[[], str] | None = None
    next_reading: float = 0.0
    costs: list[tuple[float, float]] = field(default_factory=list)
    known_free: set[tuple[float, ...]] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, began: float, time_limit: float, resolution: float) -> None:
        """Set the limits of the next run and clear the costs of the last one."""
        self.began, self.deadline, self.resolution, self.limited = began, began + time_limit, resolution, True
        self.costs.clear()

    def run(self, planner: Planner) -> None:
        """Run a planner."""
        self.planner, self.best_cost = planner, planner.best_cost()
        try:
            planner.solve(max(self.deadline - time.perf_counter(), 0.0), self.exhausted)
        finally:
            # the callbacks that the planner keeps alive must not refer to it
            self.planner, self.best_cost, self.limited = None, None, False

    def forget(self) -> None:
        """Release the model: OMPL's callbacks keep this object until the garbage is collected."""
        del self.checker
        self.known_free.clear()

    def exhausted(self) -> bool:
        """Return whether a limit is reached or the wanted path is found; stop the planner then."""
        if not self.limited:
            return False
        now = time.perf_counter()
        # read every time if the first path ends the search: otherwise the clock would decide which path it is
        if self.best_cost is not None and (now >= self.next_reading or not self.optimizing):
            self.next_reading = now + COST_INTERVAL
            self.note(now, float(self.best_cost()))
        enough = bool(self.costs) and not self.optimizing
        if self.checker.checks < self.max_checks and now < self.deadline and not enough:
            return False
        if self.planner is not None:
            self.planner.stop()
        return True

    def note(self, now: float, cost: float) -> None:
        """Append the cost of the best path so far if it is lower; OMPL reports six digits."""
        if math.isfinite(cost) and (not self.costs or cost < (1 - 1e-5) * self.costs[-1][1]):
            self.costs.append((now - self.began, cost))

    def is_free(self, configuration: Any) -> bool:
        """Return whether a configuration is free; always False once a limit is reached."""
        with self.lock:
            return not self.exhausted() and self._known_free(tuple(configuration))

    def free_fraction(self, first: Array, second: Array, whole: bool) -> float:
        """Return the fraction of a motion up to which it is free; with ``whole``, 0 for any fraction below 1."""
        if self.exhausted():
            return 0.0
        ends_free = self._known_free(tuple(second.tolist())) and self._known_free(tuple(first.tolist()))
        if ends_free and self.checker.inside_is_free(first, second, self.resolution):
            return 1.0
        return 0.0 if whole or self.exhausted() else self.checker.free_fraction(first, second, self.resolution)

    def _known_free(self, configuration: tuple[float, ...]) -> bool:
        """Return whether a configuration is free; most are cached, as ends of other motions."""
        if configuration not in self.known_free:
            if not self.checker.is_free(configuration):
                return False
            if len(self.known_free) >= _CACHE_SIZE:
                self.known_free.clear()
            self.known_free.add(configuration)
        return True
