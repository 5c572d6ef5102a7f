"""Planners written in Python: the problem they are given, and their run in the caller's process.

They need no OMPL. A planner that checks configurations cannot overrun its budget: beyond it every check raises
`OutOfBudget`, which ends the search with the best path reported by then.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.own_code import describe
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF
from greenhouse_gym.motion.kernel_checker import search_checker
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.planning.worker import PlannerAnswer, PlannerQuery


class OutOfBudget(GreenhouseError):  # noqa: N818
    """The time or the checks of a search are used up; planners do not catch this error."""


class PlannerFailedError(GreenhouseError):
    """A planner written in Python raised an error, or the planning process died repeatedly."""


class PlanningProblem:
    """A planning problem for a planner written in Python.

    Attributes:
        start: (joints,) collision-free start configuration, radians (metres for slides).
        goals: (k, joints) collision-free goal configurations; a path may end at any of them.
        lower: (joints,) lower joint limits.
        upper: (joints,) upper joint limits.
        seed: Seed of the planner's random numbers.
        first_solution: True if the caller wants the first path and no improvement of it.
        best: (m, joints) the shortest path reported so far, or None.
        costs: Seconds and length of each reported path that was shorter than all before it.
    """

    def __init__(self, query: PlannerQuery):
        self.start, self.goals, self.seed = query.start.copy(), query.goals.copy(), query.seed
        self.lower, self.upper = query.lower.copy(), query.upper.copy()
        self.first_solution = not query.optimizing
        self.best: Array | None = None
        self.costs: list[tuple[float, float]] = []
        self._checker = search_checker(query.model, query.reaches)
        self._max_checks = math.inf if query.max_checks is None else query.max_checks
        self._began = time.perf_counter()
        self._deadline = self._began + query.time_limit

    @property
    def checks(self) -> int:
        """Number of configurations checked so far."""
        return self._checker.checks

    @property
    def checks_left(self) -> float:
        """Number of configurations that may still be checked; inf if only the time is limited."""
        return self._max_checks - self._checker.checks

    def is_free(self, configuration: npt.ArrayLike) -> bool:
        """Return whether a configuration (joints,) is collision-free.

        Raises:
            OutOfBudget: The time or the checks are used up.
        """
        self._require_budget()
        return self._checker.is_free(np.asarray(configuration, dtype=np.float64))

    def motion_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float = PROOF) -> bool:
        """Return whether the straight motion between two configurations, both included, is collision-free.

        Args:
            start: (joints,) first configuration.
            end: (joints,) last configuration.
            resolution: Largest motion of any point of the arm between two checked configurations, metres. The default
                proves the motion free; a path counts only if all its motions are free at the default.

        Raises:
            OutOfBudget: The time or the checks are used up.
        """
        self._require_budget()
        return self._checker.motion_is_free(start, end, resolution)

    def path_is_free(self, path: npt.ArrayLike) -> bool:
        """Return whether all motions of a path (m, joints) are proven free."""
        points = np.asarray(path, dtype=np.float64)
        return all(self.motion_is_free(a, b) for a, b in pairwise(points))

    def report(self, path: npt.ArrayLike) -> None:
        """Report a path (m, joints); the shortest one is the result if the budget ends before the planner does."""
        points = np.array(path, dtype=np.float64)
        length = path_length(points)
        if self.best is None or length < path_length(self.best):
            self.best = points
            self.costs.append((time.perf_counter() - self._began, length))

    def _require_budget(self) -> None:
        if self._checker.checks >= self._max_checks or time.perf_counter() >= self._deadline:
            raise OutOfBudget("the time or the checks of the search are used up")


Solve = Callable[[PlanningProblem, Any], npt.ArrayLike | None]
"""Search for a path (m, joints) from the start to one of the goals, given a problem and the planner's settings."""


def run_own_planner(solve: Solve, query: PlannerQuery) -> PlannerAnswer:
    """Run a planner in this process; the caller proves its path.

    Raises:
        PlannerFailedError: The planner raised an error or returned something other than numbers.
    """
    problem = PlanningProblem(query)
    began = time.perf_counter()
    try:
        result = solve(problem, query.settings)
        path = None if result is None else np.array(result, dtype=np.float64)
    except OutOfBudget:
        path = None
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # any error in the user's code
        raise PlannerFailedError(describe(error)) from error
    if path is None:
        path = problem.best
    elif path.ndim == 2:
        problem.report(path)
    return PlannerAnswer(
        status="no_solution" if path is None else "solved",
        path=path,
        raw_path=path,
        planning_time=time.perf_counter() - began,
        simplification_time=0.0,
        checks=problem.checks,
        tree_size=0,
        costs=np.array(problem.costs).reshape(-1, 2),
    )
