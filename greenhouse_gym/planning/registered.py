"""Planners that are not OMPL's: what they are given, and how they are run.

They run in the caller's process, so they need no OMPL. A planner cannot overrun its budget as long as it checks
anything: beyond it every check raises `OutOfBudget`, which ends the search with the best path told by then.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import PROOF
from greenhouse_gym.motion.path import path_length
from greenhouse_gym.motion.proof import ProvingChecker
from greenhouse_gym.planning.exchange import Answer, Query


class OutOfBudget(GreenhouseError):  # noqa: N818
    """The search has used up its time or its checks; a planner lets this error pass."""


class PlannerFailedError(GreenhouseError):
    """A registered planner raised an error, or the planning process died again and again."""


class PlanningProblem:
    """A planning problem, as a planner sees it.

    Attributes:
        start: (joints,) start configuration, radians (metres for slides); it is free.
        goals: (k, joints) goal configurations, all free; any of them will do.
        lower: (joints,) lower joint limits.
        upper: (joints,) upper joint limits.
        seed: Seed for whatever is random.
        first_solution: Whether the first path is wanted, and not a better one.
        best: (m, joints) the shortest path told so far, or None.
        costs: Seconds and length of the paths told, as they got shorter.
    """

    def __init__(self, query: Query):
        self.start, self.goals, self.seed = query.start.copy(), query.goals.copy(), query.seed
        self.lower, self.upper = query.lower.copy(), query.upper.copy()
        self.first_solution = not query.optimizing
        self.best: Array | None = None
        self.costs: list[tuple[float, float]] = []
        self._checker = ProvingChecker(query.model, query.reaches)
        self._max_checks = math.inf if query.max_checks is None else query.max_checks
        self._began = time.perf_counter()
        self._deadline = self._began + query.time_limit

    @property
    def checks(self) -> int:
        """Configurations checked so far."""
        return self._checker.checks

    @property
    def checks_left(self) -> float:
        """Configurations that may still be checked; inf where only the time is limited."""
        return self._max_checks - self._checker.checks

    def is_free(self, configuration: npt.ArrayLike) -> bool:
        """Whether nothing is touched in a configuration (joints,).

        Raises:
            OutOfBudget: The time or the checks are used up.
        """
        self._within_budget()
        return self._checker.is_free(np.asarray(configuration, dtype=np.float64))

    def motion_is_free(self, start: npt.ArrayLike, end: npt.ArrayLike, resolution: float = PROOF) -> bool:
        """Whether the straight motion between two configurations, both included, is free.

        Args:
            start: (joints,) one end.
            end: (joints,) the other.
            resolution: No point of the arm moves farther between two configurations that are looked at, metres. At
                the usual one the motion is proven free; a path counts if all of its motions are, at that one.

        Raises:
            OutOfBudget: The time or the checks are used up.
        """
        self._within_budget()
        return self._checker.motion_is_free(start, end, resolution)

    def path_is_free(self, path: npt.ArrayLike) -> bool:
        """Whether all motions of a path (m, joints) are proven free."""
        points = np.asarray(path, dtype=np.float64)
        return all(self.motion_is_free(a, b) for a, b in pairwise(points))

    def tell(self, path: npt.ArrayLike) -> None:
        """Tell of a path (m, joints): the shortest one told counts if the budget ends before the planner does."""
        points = np.array(path, dtype=np.float64)
        length = path_length(points)
        if self.best is None or length < path_length(self.best):
            self.best = points
            self.costs.append((time.perf_counter() - self._began, length))

    def _within_budget(self) -> None:
        if self._checker.checks >= self._max_checks or time.perf_counter() >= self._deadline:
            raise OutOfBudget("the search has used up its time or its checks")


Solve = Callable[[PlanningProblem, Any], npt.ArrayLike | None]
"""A planner: from a problem and the planner's settings to a path (m, joints) from the start to one of the goals."""


def run_registered(solve: Solve, settings: Any, query: Query) -> Answer:
    """Have a planner search in this process; whether its path is one is for the caller to prove.

    Raises:
        PlannerFailedError: The planner raised an error, or what it returned are no numbers.
    """
    problem = PlanningProblem(query)
    began = time.perf_counter()
    try:
        result = solve(problem, settings)
        path = None if result is None else np.array(result, dtype=np.float64)
    except OutOfBudget:
        path = None
    except Exception as error:
        raise PlannerFailedError(f"{type(error).__name__}: {error}") from error
    if path is None:
        path = problem.best
    elif path.ndim == 2:
        problem.tell(path)
    return Answer(
        status="no_solution" if path is None else "solved",
        path=path,
        raw_path=path,
        planning_time=time.perf_counter() - began,
        simplification_time=0.0,
        checks=problem.checks,
        tree_size=0,
        costs=np.array(problem.costs).reshape(-1, 2),
    )
