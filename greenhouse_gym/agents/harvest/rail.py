"""Stops of an arm on a rail along the row, and the drive between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from greenhouse_gym.agents.agent import Problem
from greenhouse_gym.agents.harvest.rehearsal import Action, Rehearsal
from greenhouse_gym.robots import Robot

SPACING = 0.5
"""Largest distance between two stops, metres."""

_PLAY = 0.002  # metres by which a parked arm may move: planners need a range
_SETTLES = 10  # actions until the arm is at rest after a drive
_SEEDS = 3  # plans back to the start
_NEAR = 0.02  # radians from the start at which no plan is needed


def stops_of(robot: Robot) -> list[float]:
    """Return the stops along the rail of an arm, metres; 0 alone without a rail."""
    if not robot.on_rail:
        return [0.0]
    low, high = float(robot.lower[0]), float(robot.upper[0])
    return [float(stop) for stop in np.linspace(low, high, 1 + int(np.ceil((high - low) / SPACING - 1e-9)))]


@lru_cache(maxsize=32)
def parked_at(robot: Robot, stop: float) -> Robot:
    """Return an arm that cannot leave its stop on the rail, for planning; one without a rail is returned unchanged."""
    if not robot.on_rail:
        return robot
    lower, upper = robot.lower.copy(), robot.upper.copy()
    lower[0], upper[0] = max(stop - _PLAY, lower[0]), min(stop + _PLAY, upper[0])
    return replace(robot, lower=lower, upper=upper)


def drive(problem: Problem, planner: str, stop: float) -> Iterator[Action]:
    """Yield the actions that bring the arm to its start over the aisle and the cart to a stop.

    Without a path to the start the cart stays.
    """
    trial = Rehearsal(problem)
    start = problem.robot.start.copy()
    start[0] = trial.command[0]
    if np.abs(trial.command - start).max() > _NEAR:
        scene, _ = trial.scene(leaves=True)
        far = max(
            range(len(scene.tomatoes)), key=lambda k: float(np.linalg.norm(scene.tomatoes[k].center - trial.tip[0]))
        )
        arm = parked_at(problem.robot, float(np.round(start[0], 3)))
        if all(trial.follow(scene, far, planner, arm, start[None], seed) for seed in range(_SEEDS)):
            return
    yield from trial.actions
    done = len(trial.actions)
    while abs(trial.command[0] - stop) > 1e-6:
        change = np.zeros(len(start))
        change[0] = stop - trial.command[0]
        trial.step(change, False)
    for _ in range(_SETTLES):
        trial.step(np.zeros(len(start)), False)
    yield from trial.actions[done:]
