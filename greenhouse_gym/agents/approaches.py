"""Where an arm may go to reach a target, from its own kinematics alone: without knowing what stands there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.agents.arm_balls import ArmBalls
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.robots.kinematics import Chain, tool_state

BEFORE = 0.10
"""How far before a target the places before it are, metres."""

LOOK_BACK, LOOK_CONE = 0.25, 0.6
"""Distance of the tip from the target's skin where the arm looks, metres, and how far its tool may point away from
straight ahead there, radians."""

LOOKS, APART = 3, 0.2
"""From how many places the arm looks at most, and how far they are apart, metres."""

RESOLUTION = 0.04
"""How far any point of the arm may move between two checks for contacts with itself, metres."""

GUESSES, GOALS = 300, 120
"""First guesses of goal configurations, and how many goals are kept, those nearest to the first look."""

AROUND, NEARBY = 3, 0.5
"""How many places about each goal there are beside the one before it, and how far each joint is strewn, radians."""

POSTURES, SPREAD = 40, 1.2
"""Postures that are tried, and how far each joint is strewn about the start, radians."""

_SHARES = np.linspace(0.0, 1.0, 12)[:, None]
_FORWARD = 5.0  # radians that a metre farther into the plants than where the arm looks is worth
_ITERATIONS, _DAMPING, _TURN, _STEP = 12, 0.02, 0.3, 0.1  # as in `greenhouse_gym.robots.inverse_kinematics`
_NEAR_ENOUGH = 3e-3  # metres, and thirds of radians


class Approaches(NamedTuple):
    """Where an arm may go in an episode.

    Attributes:
        looks: (l, j) from where its camera sees the target; to the first the arm gets without touching itself.
        goals: (g, j) configurations that reach the target.
        before: (g, 1 + `AROUND`, j) places from which the arm may go to each: first, where the tool is drawn back along
            its axis.
        possible: (g, 1 + `AROUND`) which of those the arm can be in.
        postures: (p, j) others, over which it may go.
    """

    looks: Array
    goals: Array
    before: Array
    possible: npt.NDArray[np.bool_]
    postures: Array


def approaches(arm: ArmBalls, robot: Robot, start: Array, target: Array, radius: float) -> Approaches:
    """Where an arm may go; the same for the same arguments.

    Args:
        arm: The arm.
        robot: The same arm.
        start: (j,) where it is, radians.
        target: (3,) the target's center in the frame of the arm's base, metres.
        radius: The target's radius, metres.
    """
    lower, upper = np.maximum(robot.lower, start - np.pi), np.minimum(robot.upper, start + np.pi)
    guesses = np.random.default_rng(0).uniform(lower, upper, (GUESSES, len(start)))
    guesses[:, -1] = start[-1]  # the tool is round
    looks = _looks(arm, robot, start, target, radius, guesses)
    found = inverse_kinematics(arm.chain, guesses, target, radius, robot)
    found = found[[arm.checker.is_free(goal) for goal in found]]
    near = ((found - (looks[0] if len(looks) else start)) ** 2).sum(axis=1).argsort(kind="stable")
    goals = found[near[:GOALS]]
    axes = tool_state(arm.chain, goals).axis
    back, there = _pointing(arm.chain, goals, target - (radius + BEFORE) * axes, axes, robot)
    random = np.random.default_rng(1)
    strewn = np.zeros((len(goals), AROUND, len(start)))
    strewn[..., :-1] = NEARBY * random.normal(size=(len(goals), AROUND, len(start) - 1))
    before = np.concatenate([back[:, None], np.clip(goals[:, None] + strewn, robot.lower, robot.upper)], axis=1)
    possible = np.array([[arm.checker.is_free(place) for place in places] for places in before], dtype=bool)
    possible = possible.reshape(before.shape[:2])
    possible[:, 0] &= there
    away = np.zeros((POSTURES, len(start)))
    away[:, :-1] = SPREAD * random.normal(size=(POSTURES, len(start) - 1))
    postures = np.clip(start + away, robot.lower, robot.upper)
    postures = postures[[arm.checker.motion_is_free(start, posture, RESOLUTION) for posture in postures]]
    return Approaches(looks, goals, before, possible, postures)


def _looks(arm: ArmBalls, robot: Robot, start: Array, target: Array, radius: float, guesses: Array) -> Array:
    """(l, j) configurations that point to a place and are reached soon, without reaching farther on the way."""
    cone = Approach(np.array([1.0, 0.0, 0.0]), LOOK_CONE)
    found = inverse_kinematics(arm.chain, guesses, target, radius + LOOK_BACK, robot, cone)
    ways = start + _SHARES * (found - start)[:, None]
    ahead = tool_state(arm.chain, ways.reshape(-1, len(start))).point[:, 0].reshape(ways.shape[:2])
    farther = ahead.max(axis=1) - np.minimum(ahead[:, -1], target[0] - 0.1)
    order = (np.abs(found - start).max(axis=1) + _FORWARD * np.maximum(farther, 0.0)).argsort(kind="stable")
    places = tool_state(arm.chain, found).point
    chosen: list[int] = []
    while len(chosen) < LOOKS:
        last = found[chosen[-1]] if chosen else start
        if chosen:
            order = np.abs(found - last).max(axis=1).argsort(kind="stable")
        far = (k for k in order.tolist() if all(np.linalg.norm(places[k] - places[o]) > APART for o in chosen))
        k = next((k for k in far if arm.checker.motion_is_free(last, found[k], RESOLUTION)), None)
        if k is None:
            break
        chosen.append(k)
    return np.asarray(found[chosen])


def _pointing(
    chain: Chain, guesses: Array, tips: Array, axes: Array, robot: Robot
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Configurations (k, j) that bring the tip to places (k, 3) with the tool along axes (k, 3), and which do."""
    q = guesses.copy()
    for _ in range(_ITERATIONS):
        state = tool_state(chain, q)
        error = np.concatenate([tips - state.point, _TURN * np.cross(state.axis, axes)], axis=-1)
        size = np.sqrt((error * error).sum(axis=-1, keepdims=True))
        jacobian = np.concatenate([state.jacobian, _TURN * state.joint_axes], axis=1)
        normal = jacobian @ np.swapaxes(jacobian, -1, -2) + _DAMPING**2 * np.eye(6)
        wish = error * np.minimum(1.0, _STEP / np.maximum(size, 1e-12))
        step = np.einsum("mij,mi->mj", jacobian, np.linalg.solve(normal, wish[..., None])[..., 0])
        q = np.clip(q + step, robot.lower, robot.upper)
    state = tool_state(chain, q)
    aligned = ((state.axis - axes) ** 2).sum(axis=-1) < (_NEAR_ENOUGH / _TURN * 3) ** 2
    return q, aligned & (((state.point - tips) ** 2).sum(axis=-1) < _NEAR_ENOUGH**2)
