"""Plans around leaves, and through as few of them as possible where there is no path around.

A path through all leaves is improved by making leaves rigid again: those that it does not brush, and half of those that
it does (a sampling relative of Hauser: The Minimum Constraint Removal Problem with Three Robotics Applications, 2014).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.leaf_contacts import LeafContacts
from greenhouse_gym.planning.result import PlanResult

LEAF_COST = 0.2
"""Length of path that brushing one more leaf is worth, radians."""

_AROUND = 1 / 4  # of the time and checks, for the search for a path around all leaves
_FEWER, _TRIALS = 1 / 8, 6  # of the remaining time and checks, for each search with fewer leaves, and number of these
_MAX_IDLE = 3  # of these searches in a row without success

Search = Callable[[str | npt.NDArray[np.int64], Array | None, float | None, int | None], PlanResult]
"""Search with leaves, goals (k, joints) or None to search for them, a time limit and a number of checks."""


def plan_brushing(
    search: Search,
    find_goals: Callable[[], Array],
    contacts: LeafContacts,
    time_limit: float | None,
    max_checks: int | None,
    seed: int,
) -> PlanResult:
    """Plan around leaves, or else through few of them.

    Args:
        search: Plans once.
        find_goals: Returns goals (k, joints) that may touch leaves.
        contacts: Finds the leaves that a path brushes.
        time_limit: Seconds of all searches together, or None.
        max_checks: Collision checks of all searches together, or None.
        seed: Seed of the choice of leaves.
    """
    budget = _Budget(search, time_limit, max_checks)
    around = budget.search("rigid", None, _AROUND)
    if around.path is not None:
        return around
    goals = find_goals()
    # goals that touch few leaves come first
    goals = goals[np.argsort([len(contacts.at(goal[None])) for goal in goals], kind="stable")]
    best = budget.search(np.arange(contacts.count), goals, 1.0)
    if best.path is None:
        return best
    rng, idle, brushed = np.random.default_rng(seed), 0, contacts.brushed(best.path)
    for _ in range(_TRIALS):
        if len(brushed) < 2 or idle == _MAX_IDLE or budget.is_used_up:
            break
        allowed = np.sort(rng.permutation(brushed)[: len(brushed) // 2])
        fewer = budget.search(allowed, goals, _FEWER)
        idle += 1
        if fewer.path is not None:
            left = contacts.brushed(fewer.path)
            if fewer.length + LEAF_COST * len(left) < best.length + LEAF_COST * len(brushed):
                best, brushed, idle = fewer, left, 0
    return best


class _Budget:
    """Searches that share a budget of time and checks."""

    def __init__(self, search: Search, time_limit: float | None, max_checks: int | None):
        self._search, self._time, self._checks = search, time_limit, max_checks

    @property
    def is_used_up(self) -> bool:
        """True once the time or the checks are used up."""
        return (self._time is not None and self._time <= 0) or (self._checks is not None and self._checks <= 0)

    def search(self, leaves: str | npt.NDArray[np.int64], goals: Array | None, fraction: float) -> PlanResult:
        """Search with a fraction of the remaining budget, at least a millisecond and one check."""
        seconds = None if self._time is None else max(self._time * fraction, 1e-3)
        checks = None if self._checks is None else max(int(self._checks * fraction), 1)
        result = self._search(leaves, goals, seconds, checks)
        self._time = None if self._time is None else self._time - result.planning_time
        self._checks = None if self._checks is None else self._checks - result.checks
        return result
