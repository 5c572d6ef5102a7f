"""The process in which OMPL runs: takes queries from a connection, answers each, one at a time.

The caller's process does not import this module: some planners hang or crash, and a separate process can be killed.
`greenhouse_gym.planning.worker` starts it and talks to it, in the terms of `greenhouse_gym.planning.exchange`.
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
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF, RESOLUTIONS, CollisionChecker
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.planning.exchange import Answer, Outcome, Query
from greenhouse_gym.planning.ompl_binding import (
    Ompl,
    OmplProblem,
    Planner,
    import_ompl,
    planner_names,
    planner_parameters,
    set_seed,
)
from greenhouse_gym.planning.ompl_unbound import JOINING, THREADED

LOOK = 0.001
"""Seconds between two looks at the cost of the best path so far, while it is improved."""

_REMEMBERED = 100_000  # configurations, some 30 MB
_PR_SET_PDEATHSIG = 1  # of Linux's prctl


def serve(handle: int, memory_limit: int, caller: int) -> None:
    """Answer queries from a connection until it is closed.

    A message is (command, argument, hard limit in seconds); the answer is (True, result) or (False, error text).

    Args:
        handle: The connection's handle.
        memory_limit: Bytes of data this process may hold, where the system can limit them.
        caller: Process id of the caller; this process dies with it on Linux, and elsewhere after the hard limit.
    """
    _die_with(caller)
    _limit_memory(memory_limit)
    connection = Connection(handle)
    try:
        ompl = import_ompl()
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
        # should the caller die meanwhile, nothing of this process stays behind for long
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
    """Have the system kill this process when the thread that started it ends."""
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


def solve(ompl: Ompl, query: Query) -> Answer:
    """Plan, shorten the path, and prove it free; at a coarse resolution first, then at finer ones.

    Everything of OMPL is built anew after the seed is set, so the same query gives the same path as long as the number
    of checks and not the time ends the search.
    """
    set_seed(ompl, query.seed)
    checker = ProvingChecker(query.model, query.reaches)
    search = _Search(checker, math.inf if query.max_checks is None else query.max_checks, query.optimizing)
    try:
        return _solved(ompl, query, search)
    finally:
        search.forget()


def _solved(ompl: Ompl, query: Query, search: _Search) -> Answer:
    checker = search.checker
    planning_time, simplification_time, tree_size = 0.0, 0.0, 0
    status: Outcome = "no_solution"
    raw, path = None, None
    for resolution in (PROOF,) if query.optimizing else RESOLUTIONS:
        began = time.perf_counter()
        search.begin(began - planning_time, query.time_limit, resolution)
        fineness = JOINING.get(query.planner, resolution / float(np.linalg.norm(checker.reaches)))
        problem = OmplProblem(
            ompl, query.lower, query.upper, query.start, query.goals, search.is_free, search.free_share, fineness,
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
    return Answer(status, path, raw, planning_time, simplification_time, checker.checks, tree_size, costs)


def _simplified(problem: OmplProblem, search: _Search, raw: Array) -> Array | None:
    """The path shortened and proven free; the planner's own path if only that can be proven, or None."""
    proven = search.checker.path_is_free(raw, PROOF)
    if proven:
        search.resolution = PROOF
    shortened = problem.shortened(raw)
    if search.checker.path_is_free(shortened, PROOF):
        return shortened
    return raw if proven else None


@dataclass
class _Search:
    """The collision checks of a planner, with its limits on time and checks and its progress."""

    checker: CollisionChecker
    max_checks: float
    optimizing: bool
    resolution: float = PROOF
    began: float = 0.0
    deadline: float = math.inf
    limited: bool = True
    planner: Planner | None = None
    best_cost: Callable[[], str] | None = None
    next_look: float = 0.0
    costs: list[tuple[float, float]] = field(default_factory=list)
    known_free: set[tuple[float, ...]] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def begin(self, began: float, time_limit: float, resolution: float) -> None:
        """Set the limits of the next run, and forget the costs of the last one."""
        self.began, self.deadline, self.resolution, self.limited = began, began + time_limit, resolution, True
        self.costs.clear()

    def run(self, planner: Planner) -> None:
        """Have a planner search."""
        self.planner, self.best_cost = planner, planner.best_cost()
        try:
            planner.solve(max(self.deadline - time.perf_counter(), 0.0), self.exhausted)
        finally:
            # the planner must not be reachable from the callbacks that it keeps alive
            self.planner, self.best_cost, self.limited = None, None, False

    def forget(self) -> None:
        """Let go of the model: what OMPL called keeps this object until the garbage is collected."""
        del self.checker
        self.known_free.clear()

    def exhausted(self) -> bool:
        """Whether a limit is reached, or the path that was asked for."""
        if not self.limited:
            return False
        now = time.perf_counter()
        # always before a search that ends at its first path, or the clock would decide on the path
        if self.best_cost is not None and (now >= self.next_look or not self.optimizing):
            self.next_look = now + LOOK
            self.note(now, float(self.best_cost()))
        enough = bool(self.costs) and not self.optimizing
        if self.checker.checks < self.max_checks and now < self.deadline and not enough:
            return False
        if self.planner is not None:
            self.planner.stop()
        return True

    def note(self, now: float, cost: float) -> None:
        """Note the cost of the best path so far; OMPL tells it with six digits."""
        if math.isfinite(cost) and (not self.costs or cost < (1 - 1e-5) * self.costs[-1][1]):
            self.costs.append((now - self.began, cost))

    def is_free(self, configuration: Any) -> bool:
        """Whether a configuration is free; nothing is once a limit is reached."""
        with self.lock:
            return not self.exhausted() and self._known_free(tuple(configuration))

    def free_share(self, first: Array, second: Array, whole: bool) -> float:
        """The share of a motion up to which it is free; 0 for all that are not free as a whole if that will do."""
        if self.exhausted():
            return 0.0
        ends_free = self._known_free(tuple(second.tolist())) and self._known_free(tuple(first.tolist()))
        if ends_free and self.checker.inside_is_free(first, second, self.resolution):
            return 1.0
        return 0.0 if whole or self.exhausted() else self.checker.free_share(first, second, self.resolution)

    def _known_free(self, configuration: tuple[float, ...]) -> bool:
        """Whether a configuration is free; most have been checked before, as an end of another motion."""
        if configuration not in self.known_free:
            if not self.checker.is_free(configuration):
                return False
            if len(self.known_free) >= _REMEMBERED:
                self.known_free.clear()
            self.known_free.add(configuration)
        return True
