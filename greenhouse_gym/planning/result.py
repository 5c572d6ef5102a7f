"""The result of a plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.goals import GoalStatistics

Status = Literal[
    "solved",  # a path was found and proven free
    "no_goal",  # no collision-free configuration reaches the target
    "start_in_collision",  # the start touches something, or nearly
    "no_solution",  # the time or the checks were used up without a path
    "approximate",  # the same, but a path that ends near a goal was found
    "timeout",  # the planner ignored its time limit and was killed
    "crashed",  # the planning process died, or the planner raised an error
    "invalid",  # the planner's path does not lead from the start to a goal, or is not free
]


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Result of `greenhouse_gym.planning.plan`.

    Attributes:
        status: One of `Status`.
        path: (k, joints) collision-free path from the start to a goal, radians; None unless solved.
        planner: Name of the planner.
        raw_path: (k, joints) the planner's own path before it was simplified; None without one.
        raw_length: Length of ``raw_path``, radians; nan without one.
        length: Length of ``path``, radians; nan without one.
        clearance: Smallest distance along ``path`` between the arm and any obstacle except the target, metres; at most
            `CLEARANCE_RANGE`; nan without a path.
        planning_time: Seconds the planner searched.
        simplification_time: Seconds for shortening the path and proving it free.
        goal_time: Seconds for finding goal configurations.
        checks: Number of configurations the planner checked for collisions.
        tree_size: Number of nodes in the planner's trees or roadmap; 0 for EITstar, where counting is slow.
        costs: (m, 2) seconds and length of the planner's best path at that time, radians: the first path it reported
            and each shorter one.
        goals: Statistics of the search for goal configurations; None if they were given.
        message: Details that the status does not give.
        unknown_length: Length of the tip's path while part of the arm is in unknown space, metres; nan without a path,
            or if unknown space counts as free.
        brushed_leaves: Number of shapes of leaves that the path brushes; 0 if leaves are rigid.
    """

    status: Status
    path: Array | None
    planner: str
    raw_path: Array | None = None
    raw_length: float = math.nan
    length: float = math.nan
    clearance: float = math.nan
    planning_time: float = 0.0
    simplification_time: float = 0.0
    goal_time: float = 0.0
    checks: int = 0
    tree_size: int = 0
    costs: Array = field(default_factory=lambda: np.empty((0, 2)))
    goals: GoalStatistics | None = None
    message: str = ""
    unknown_length: float = math.nan
    brushed_leaves: int = 0

    def __repr__(self) -> str:
        path = "" if self.path is None else (
            f", {len(self.path)} waypoints, {self.length:.2f} rad, clearance {1000 * self.clearance:.1f} mm"
        )  # fmt: skip
        said = f", {self.message}" if self.message else ""
        return (
            f"PlanResult({self.planner!r}, {self.status}{path}, {self.checks} checks, {self.planning_time:.2f} s{said})"
        )
