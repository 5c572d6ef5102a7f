"""What the caller and the planning process send each other: a query and its answer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import mujoco

from greenhouse_gym.geometry import Array

Outcome = Literal["solved", "approximate", "no_solution", "invalid"]


@dataclass(frozen=True, eq=False)
class Query:
    """What a planner is asked. Joint positions are radians, of slides metres.

    Attributes:
        model: The model to check collisions with, as `planning_model` makes it.
        reaches: (joints,) its `joint_reaches`.
        lower: (joints,) lower limits.
        upper: (joints,) upper limits.
        start: (joints,) start configuration.
        goals: (k, joints) goal configurations, any of which will do.
        planner: Name of a planner.
        settings: The planner's settings that are not OMPL's own.
        time_limit: Seconds; inf for a search that is limited by its checks alone.
        max_checks: Number of configurations that may be checked, or None.
        optimizing: Whether the planner is to use all its time: it then checks motions at `PROOF` from the start. Else
            it stops at its first path, as far as it tells that it has one.
        seed: Seed of the planner's random numbers.
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
        tree_size: Nodes in the planner's trees or roadmap; 0 where they are not counted.
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
