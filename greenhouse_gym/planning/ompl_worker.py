"""The process in which OMPL runs: takes queries from a connection, answers each, one at a time.

It is never imported by the caller's process: some planners hang or crash, and a separate process can be killed.
`greenhouse_gym.planning.worker` starts it and talks to it.
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Literal

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.planning.collision import PROOF, CollisionChecker
from greenhouse_gym.planning.ompl_binding import (
    Ompl,
    Planner,
    Problem,
    import_ompl,
    planner_names,
    planner_parameters,
    set_seed,
)
from greenhouse_gym.planning.ompl_unbound import JOINING, THREADED
from greenhouse_gym.planning.proof import ProvingChecker

RESOLUTIONS = (6 * PROOF, 3 * PROOF, PROOF)
"""Resolutions at which motions are checked, metres: each follows where a path of the one before cannot be proven free.

The first misses something in one search of thirty, and needs half the checks of one that would miss nothing.
"""

LOOK = 0.001
"""Seconds between two looks at the cost of the best path so far, while it is improved."""

_REMEMBERED = 100_000  # configurations, some 30 MB

Outcome = Literal["solved", "approximate", "no_solution", "invalid"]


@dataclass(frozen=True, eq=False)
class Query:
    """What a planner is asked. Angles are radians.

    Attributes:
        model: The model to check collisions with, as `planning_model` makes it.
        reaches: (joints,) its `joint_reaches`.
        lower: (joints,) lower limits.
        upper: (joints,) upper limits.
        start: (joints,) start configuration.
        goals: (k, joints) goal configurations, any of which will do.
        planner: Name of an OMPL planner.
        settings: The planner's settings that are not OMPL's own.
        time_limit: Seconds.
        max_checks: Number of configurations that may be checked, or None.
        optimizing: Whether the planner is to use all its time: it then checks motions at `PROOF` from the start. Else
            it stops at its first path, as far as it tells that it has one.
        seed: Seed of OMPL's random numbers.
    """

    model: mujoco.MjModel
    reaches: Array
    lower: Array
    upper: Array
    start: Array
    goals: Array
    planner: str
    settings: dict[str, Any]
    time_limit: float
    max_checks: int | None
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
        tree_size: Nodes in the planner's trees or roadmap; 0 for EITstar, whose are slow to count.
        costs: (m, 2) seconds and length of the best path by then, radians: as it was found and as it got shorter.
    """

    status: Outcome
    path: Array | None
    raw_path: Array | None
    planning_time: float
    simplification_time: float
    checks: int
    tree_size: int
    costs: Array


def _limit_memory(size: int) -> None:
    """Let this process hold so many bytes of data at most, where the system can do that."""
    try:
        import resource
    except ImportError:  # Windows
        return
    resource.setrlimit(resource.RLIMIT_DATA, (size, size))


def serve(handle: int, memory_limit: int) -> None:
    """Answer queries from the connection with this handle until it is closed, with at most so many bytes of data.

    A message is (command, argument, hard limit in seconds); the answer is (True, result) or (False, error text).
    """
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
        "fill": lambda size: len(bytearray(size)),  # and for one that takes all memory
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


def solve(ompl: Ompl, query: Query) -> Answer:
    """Plan, shorten the path, and prove it free; at a coarse resolution first, then at finer ones.

    Everything of OMPL is built anew after the seed is set, so the same query gives the same path as long as the number
    of checks and not the time ends the search.
    """
    set_seed(ompl, query.seed)
    checker = ProvingChecker(query.model, query.reaches)
    search = _Search(checker, math.inf if query.max_checks is None else query.max_checks, query.optimizing)
    planning_time, simplification_time, tree_size = 0.0, 0.0, 0
    status: Outcome = "no_solution"
    raw, path = None, None
    for resolution in (PROOF,) if query.optimizing else RESOLUTIONS:
        began = time.perf_counter()
        search.begin(began - planning_time, query.time_limit, resolution)
        fineness = JOINING.get(query.planner, resolution / float(np.linalg.norm(checker.reaches)))
        problem = Problem(
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


def _simplified(problem: Problem, search: _Search, raw: Array) -> Array | None:
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
