"""Motions of a pick: close the gap to a fruit, turn it off its pedicel, withdraw with it, and hold it above a crate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Protocol

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.inverse_kinematics import Approach, inverse_kinematics
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain
from greenhouse_gym.robots.robot import TIP_SITE

_CLOSING, _CONTACT, _REACHES = 0.12, 0.001, 24  # m/s; gap in metres at which the cup stops; actions at most
_LIFTING = 0.05  # m/s
_TURNING, _TURNS = 1.6, 18  # rad/s, and actions of turning before the fruit is also pulled
_PULLING, _PULLS = 0.06, 36  # m/s, and actions of turning and pulling at most
_RETREAT, _RETREATS = 0.05, 20  # metres by which the tip withdraws, and actions at most
_BACK, _FASTER = 0.25, 0.05  # m/s at most, and m/s by which it becomes faster per action
_BRINGS = 30  # actions at most
_YIELDING = 0.012  # m/s per N: the tip yields to what pushes the held fruit
_RAMP, _SLOWEST = 5, 0.1  # actions until a gentle motion has its full speed, and smallest fraction of it
# see _pulls: a pedicel parts at 8 N, and 2 N bend a truss too far
_ON_TRUSS, _OFF = (2.0, 12.0, 0.02), (0.5, 4.0, 0.05)
_SHRUNK, _STEP = 0.9, 0.004  # radius of a held fruit in plans over its own, and metres to which it is rounded up
_DAMPING = 0.05  # metres per radian: of the inverse kinematics
_GUESSES, _ENDS = 400, 200  # configurations from which inverse kinematics starts above the crate, and results at most
_SPREAD, _TILT = 0.07, 0.5  # metres between fruit in the crate and its middle, and radians from upright
_STILL = np.zeros(3)
_UP = np.array([0.0, 0.0, 1.0])

Twist = tuple[Array, Array]
"""Velocity (3,) of the tip, m/s, and its rotation (3,), rad/s, in the scene, during an action."""


class Hand(Protocol):
    """Tool and fruit as an agent knows them at the moment; fruit have numbers, points are in the scene.

    Attributes:
        interval: Seconds between two actions.
        held: Fruit in the cup, or -1.
        tip: Position (3,) and direction (3,) of the tool.
        force: (3,) force of the held fruit on the cup beyond its weight, N.
    """

    @property
    def interval(self) -> float: ...  # noqa: D102
    @property
    def held(self) -> int: ...  # noqa: D102
    @property
    def tip(self) -> tuple[Array, Array]: ...  # noqa: D102
    @property
    def force(self) -> Array: ...  # noqa: D102

    def center(self, fruit: int) -> Array:
        """Return the middle (3,) of a fruit, metres."""

    def radius(self, fruit: int) -> float:
        """Return the radius of a fruit, metres."""

    def joint(self, fruit: int) -> Array:
        """Return the start (3,) of a fruit's pedicel, metres."""

    def hanging(self) -> list[int]:
        """Return the fruit that hang."""


def close_gap(hand: Hand, fruit: int, speed: float = _CLOSING) -> Iterator[Twist]:
    """Bring the cup to a fruit until it holds one, at a speed, m/s, at most."""
    for _ in range(round(_REACHES * _CLOSING / speed)):
        if hand.held >= 0:
            return
        tip, axis = hand.tip
        offset = hand.center(fruit) - tip
        distance = float(np.linalg.norm(offset))
        gap = distance - hand.radius(fruit) - _CONTACT
        yield offset / distance * np.clip(gap / hand.interval, -speed, speed), 2 * np.cross(axis, offset / distance)


def feel(hand: Hand, distance: float, speed: float) -> Iterator[Twist]:
    """Move the cup on along its axis until it holds a fruit, by a distance, metres, at a speed, m/s."""
    for _ in range(round(distance / speed / hand.interval)):
        if hand.held >= 0:
            return
        yield hand.tip[1] * speed, _STILL


def back_off(hand: Hand, distance: float, speed: float) -> Iterator[Twist]:
    """Move the cup back along its axis, by a distance, metres, at a speed, m/s."""
    for _ in range(round(distance / speed / hand.interval)):
        yield -hand.tip[1] * speed, _STILL


def lift(hand: Hand, distance: float) -> Iterator[Twist]:
    """Raise a held fruit by a distance, metres, so that its truss does not jump when it comes off."""
    for _ in range(round(distance / _LIFTING / hand.interval)):
        if hand.held < 0:
            return
        yield _UP * _LIFTING, _STILL


def bring(hand: Hand, point: Array) -> Iterator[Twist]:
    """Move a held fruit until the tip is at a point (3,)."""
    for _ in range(_BRINGS):
        offset = point - hand.tip[0]
        distance = float(np.linalg.norm(offset))
        if distance < _CONTACT or hand.held < 0:
            return
        yield offset * min(1.0 / hand.interval, _BACK / distance), _STILL


def turns(hand: Hand, fruit: int) -> Iterator[Array]:
    """Yield axes (3,) to turn a held fruit about: first that of the tool, away from other fruit, then across it."""
    _, axis = hand.tip
    center = hand.center(fruit)
    hangs = center - hand.joint(fruit)
    hangs /= np.linalg.norm(hangs)
    about = axis - axis @ hangs * hangs
    across = np.cross(hangs, about if np.linalg.norm(about) > 0.3 else _UP)
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([0.0, 1.0, 0.0])
    about = np.cross(across, hangs)
    others = [hand.center(k) for k in hand.hanging() if k != fruit]
    near = [(o - center) / max(float((o - center) @ (o - center)), 1e-4) for o in others]
    crowd = np.sum([o for o in near if np.linalg.norm(o) > 1 / 0.12] or [_STILL], axis=0)
    side = -1.0 if crowd @ np.cross(about, hangs) > 0 else 1.0
    back = -1.0 if axis @ np.cross(across, hangs) > 0 else 1.0
    yield from (side * about, back * across, -side * about, -back * across)


def part(hand: Hand, fruit: int, axis: Array) -> Iterator[Twist]:
    """Turn a held fruit about the joint of its pedicel, and at last pull as well, until it comes off."""
    for step in range(_PULLS):
        if hand.held != fruit or fruit not in hand.hanging():
            return
        tip, tool = hand.tip
        spin = axis * _TURNING if step < _TURNS else _STILL
        pull = _STILL if step < _TURNS // 2 else -tool * _PULLING
        yield np.cross(spin, tip - hand.joint(fruit)) + pull, spin


def retreats(hand: Hand) -> tuple[Array, ...]:
    """Return directions (3,) to withdraw in: straight back, and back and up or down."""
    _, axis = hand.tip
    directions = (-axis, _UP * 0.7 - axis, -_UP * 0.7 - axis)
    return tuple(direction / max(float(np.linalg.norm(direction)), 1e-9) for direction in directions)


def withdraw(hand: Hand, direction: Array) -> Iterator[Twist]:
    """Move the tip in a direction until its fruit is clear of the truss, and yield to whatever blocks it."""
    start, _ = hand.tip
    clear = _RETREAT + 2 * hand.radius(max(hand.held, 0))
    for step in range(1, _RETREATS + 1):
        if (hand.tip[0] - start) @ direction > clear or hand.held < 0:
            return
        yield direction * min(_BACK, _FASTER * step) + _YIELDING * hand.force, _STILL


def gently(hand: Hand, twists: Iterable[Twist]) -> Iterator[Twist]:
    """Begin motions slowly, slow them down as something pulls at the held fruit, and yield to what pulls firmly."""
    for step, (velocity, spin) in enumerate(twists, 1):
        fraction = min(step / _RAMP, ease(hand))
        yield velocity * fraction + yielding(hand), spin * fraction


def ease(hand: Hand) -> float:
    """Return the fraction of its pace, up to 1, at which the tip may move while something pulls at the held fruit."""
    light, firm, _ = _pulls(hand)
    return float(np.clip((firm - np.linalg.norm(hand.force)) / (firm - light), _SLOWEST, 1.0))


def yielding(hand: Hand) -> Array:
    """Return the velocity (3,) at which the tip yields to what pulls at the held fruit, m/s."""
    light, _, speed = _pulls(hand)
    return np.asarray(speed * max(0.0, 1.0 - light / max(float(np.linalg.norm(hand.force)), 1e-9)) * hand.force)


def _pulls(hand: Hand) -> tuple[float, float, float]:
    """Return the pulls from which a gentle motion slows down and is slowest, N, and m/s per N it yields."""
    return _ON_TRUSS if hand.held in hand.hanging() else _OFF


def joint_change(jacobian: Array, twist: Twist, interval: float, steps: Array) -> Array:
    """Return the change (j,) of the joints' commands in an action for a motion of the tip.

    Args:
        jacobian: (6, j) derivatives of the tip's position and rotation, metres and radians per radian.
        twist: The motion. It is slowed down as a whole if an action cannot reach so far.
        interval: Seconds between two actions.
        steps: (j,) largest change in an action.
    """
    wanted = np.concatenate(twist) * interval
    change = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + _DAMPING**2 * np.eye(6), wanted)
    return np.asarray(change / max(1.0, float((np.abs(change) / steps).max())))


def spot(picked: int) -> Array:
    """Return where in a crate (2,) to lay down a fruit after a number of them, from its middle, metres."""
    around = 2.4 * picked
    return _SPREAD * np.array([np.cos(around), np.sin(around)])


def pointing_down(chain: Chain, robot: Robot, command: Array, point: Array, seed: int) -> Array:
    """Return configurations (k, j) with the tip at a point (3,) and the tool pointing down, nearest first."""
    return pointing(-_UP, chain, robot, command, point, seed)


def pointing(direction: Array, chain: Chain, robot: Robot, command: Array, point: Array, seed: int) -> Array:
    """Return configurations (k, j) with the tip at a point (3,) and the tool in a direction (3,), nearest first."""
    rng = np.random.default_rng(seed)
    guesses = rng.uniform(robot.lower, robot.upper, (_GUESSES, len(command)))
    cone = Approach(direction, _TILT)
    found, _ = inverse_kinematics(chain, np.vstack([command, guesses]), point, 0.0, robot, cone)
    near = np.argsort(np.abs(found - command).max(axis=1), kind="stable")
    robot.keep_tool_roll(found, command)
    return np.clip(found[near[:_ENDS]], robot.lower, robot.upper)


def with_fruit(robot: Robot, radius: float) -> Robot:
    """Return an arm with a fruit at its cup, for planning."""
    radius = _STEP * float(np.ceil(_SHRUNK * radius / _STEP))
    return with_load(robot, ((0.0, 0.0, radius, radius),))


@lru_cache(maxsize=16)
def with_load(robot: Robot, spheres: tuple[tuple[float, float, float, float], ...]) -> Robot:
    """Return an arm that holds spheres, for planning: middles in the frame of the tip and radii, metres."""
    spec = robot.spec()
    tip = spec.site(TIP_SITE)
    for k, (*local, radius) in enumerate(spheres):
        middle = np.empty(3)
        mujoco.mju_rotVecQuat(middle, np.array(local), np.array(tip.quat))
        tip.parent.add_geom(
            name=f"held_fruit_{k}", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=tip.pos + middle,
            mass=0, contype=1, conaffinity=3,
        )  # fmt: skip
    return replace(robot, specification=spec)
