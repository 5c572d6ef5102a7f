"""What became of a plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.goals import GoalStatistics

Status = Literal[
    "solved",  # a path was found and proven free
    "no_goal",  # no configuration reaches the target without touching something
    "start_in_collision",  # the start touches something, or nearly
    "no_solution",  # the time or the checks were used up without a path
    "approximate",  # the same, but a path that ends near a goal was found
    "timeout",  # the planner ignored its time limit and was killed
    "crashed",  # the planning process died, or the planner raised an error
    "invalid",  # the planner's path does not lead from the start to a goal, or is not free
]


@dataclass(frozen=True, eq=False)
class PlanResult:
    """What became of a plan.

    Attributes:
        status: One of `Status`.
        path: (k, joints) free joint path from the start to a goal, radians; None unless solved.
        planner: Name of the planner.
        raw_path: (k, joints) the planner's own path before it was simplified; None without one.
        raw_length: Length of ``raw_path``, radians; nan without one.
        length: Length of ``path``, radians; nan without one.
        clearance: Smallest distance of the arm to any obstacle but the target along ``path``, metres; at most
            `CLEARANCE_RANGE`; nan without a path.
        planning_time: Seconds the planner searched.
        simplification_time: Seconds for shortening the path and proving it free.
        goal_time: Seconds for the goal configurations.
        checks: Configurations the planner checked for collisions.
        tree_size: Nodes in the planner's trees or roadmap; 0 for EITstar, whose are slow to count.
        costs: (m, 2) seconds, and the length of the best path the planner had by then, radians: the first one it told
            of and every shorter one.
        goals: How the search for goal configurations went; None where they were given.
        message: What happened, where the status does not tell it all.
        unknown_length: Length of the tip's way along ``path`` while some of the arm is in space that the scan did not
            see, metres; nan without a path, or where unknown space counts as free.
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
