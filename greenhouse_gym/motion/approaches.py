"""Where an arm may go to reach a target, from its own kinematics alone: without knowing what stands there."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmBalls
from greenhouse_gym.motion.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, tool_state

BEFORE = 0.10
"""How far before a target the places before it are, metres."""

LOOK_BACK, LOOK_CONE = 0.28, 0.8
"""Distance of the tip from what the arm looks at, metres, and how far its tool may point away from straight ahead
there, radians."""

RESOLUTION = 0.04
"""How far any point of the arm may move between two checks for contacts with itself, metres."""

GUESSES, GOALS = 300, 120
"""First guesses of goal configurations, and how many goals are kept, those nearest to the start."""

FRONT = np.array([1.0, 0.5, 0.5])
"""Shares of the target's place that give where an arm glances at first."""

AROUND, NEARBY = 3, 0.5
"""How many places about each goal there are beside the one before it, and how far each joint is strewn, radians."""

POSTURES, SPREAD = 40, 1.2
"""Postures that are tried, and how far each joint is strewn about the start, radians."""

_IN_VIEW = 0.4  # radians from the tool's axis
_GLANCES = 25  # angles of each joint of the wrist that are tried
_ITERATIONS, _DAMPING, _TURN, _STEP = 12, 0.02, 0.3, 0.1  # as in `greenhouse_gym.motion.inverse_kinematics`
_NEAR_ENOUGH = 3e-3  # metres, and thirds of radians


class Approaches(NamedTuple):
    """Where an arm may go in an episode.

    Attributes:
        goals: (g, j) configurations that reach the target.
        before: (g, 1 + `AROUND`, j) places from which the arm may go to each: first, where the tool is drawn back along
            its axis.
        possible: (g, 1 + `AROUND`) which of those the arm can be in.
        postures: (p, j) others, over which it may go.
    """

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
    found = inverse_kinematics(arm.chain, _guesses(robot, start), target, radius, robot)
    found = found[[arm.checker.is_free(goal) for goal in found]]
    goals = found[((found - start) ** 2).sum(axis=1).argsort(kind="stable")[:GOALS]]
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
    return Approaches(goals, before, possible, postures)


def glance(arm: ArmBalls, robot: Robot, start: Array, point: Array) -> Array:
    """(j,) a configuration in which the camera has a place (3,) in view and only the wrist has moved from a start (j,).

    The tool stays back from the plants, of which nothing is known yet.
    """
    tried = np.tile(start, (_GLANCES**2, 1))
    angles = (np.linspace(robot.lower[k], robot.upper[k], _GLANCES) for k in (-3, -2))
    tried[:, [-3, -2]] = np.stack(np.meshgrid(*angles), axis=-1).reshape(-1, 2)
    state = tool_state(arm.chain, tried)
    away = point - state.point
    off = np.arccos(np.clip((away * state.axis).sum(axis=1) / np.sqrt((away**2).sum(axis=1)), -1.0, 1.0))
    costs = np.maximum(off - _IN_VIEW, 0.0) + state.point[:, 0] + 0.1 * np.abs(tried - start).max(axis=1)
    for k in costs.argsort(kind="stable"):
        if arm.checker.motion_is_free(start, tried[k], RESOLUTION):
            return np.asarray(tried[k])
    return start


def looks_at(arm: ArmBalls, robot: Robot, start: Array, point: Array) -> Array:
    """(k, j) configurations in which the tool points to a place (3,) from `LOOK_BACK` before it."""
    cone = Approach(np.array([1.0, 0.0, 0.0]), LOOK_CONE)
    return inverse_kinematics(arm.chain, _guesses(robot, start), point, LOOK_BACK, robot, cone)


def _guesses(robot: Robot, start: Array) -> Array:
    """(`GUESSES`, j) configurations about a start (j,), the same for the same start."""
    lower, upper = np.maximum(robot.lower, start - np.pi), np.minimum(robot.upper, start + np.pi)
    guesses = np.random.default_rng(0).uniform(lower, upper, (GUESSES, len(start)))
    guesses[:, -1] = start[-1]  # the tool is round
    return np.asarray(guesses)


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
