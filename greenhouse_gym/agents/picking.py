"""Motions of a pick in a rehearsal: close the gap to a fruit, turn it off its pedicel, and withdraw with it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import mujoco
import numpy as np

from greenhouse_gym.agents.rehearsal import Rehearsal
from greenhouse_gym.geometry import Array
from greenhouse_gym.plants.live import HANGING
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.robot import TIP_SITE

_CLOSING, _CONTACT, _REACHES = 0.12, 0.001, 24  # m/s; gap in metres at which the cup stops; actions at most
_TURNING, _TURNS = 1.6, 18  # rad/s, and actions of turning before the fruit is also pulled
_PULLING, _PULLS = 0.06, 36  # m/s, and actions of turning and pulling at most
_RETREAT, _RETREATS = 0.05, 20  # metres by which the tip withdraws, and actions at most
_BACK, _FASTER = 0.25, 0.05  # m/s at most, and m/s by which it becomes faster per action
_YIELDING = 0.012  # m/s per N: the tip yields to what pushes the held fruit
_SHRUNK, _STEP = 0.9, 0.004  # radius of a held fruit in plans over its own, and metres to which it is rounded up
_STILL = np.zeros(3)
_UP = np.array([0.0, 0.0, 1.0])


def close_gap(trial: Rehearsal, fruit: int) -> None:
    """Bring the cup to a fruit until it holds one."""
    plants = trial.plants
    for _ in range(_REACHES):
        if plants.held >= 0:
            return
        tip, axis = trial.tip
        offset = plants.center(fruit) - tip
        distance = float(np.linalg.norm(offset))
        gap = distance - plants.radius(fruit) - _CONTACT
        speed = np.clip(gap / trial.interval, -_CLOSING, _CLOSING)
        trial.twist(offset / distance * speed, 2 * np.cross(axis, offset / distance), True)


def turns(trial: Rehearsal, fruit: int) -> Iterator[Array]:
    """Yield axes (3,) to turn a held fruit about: first that of the tool, away from other fruit, then across it."""
    plants = trial.plants
    _, axis = trial.tip
    center = plants.center(fruit)
    hanging = center - plants.joint_of(fruit)
    hanging /= np.linalg.norm(hanging)
    about = axis - axis @ hanging * hanging
    across = np.cross(hanging, about if np.linalg.norm(about) > 0.3 else _UP)
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array([0.0, 1.0, 0.0])
    about = np.cross(across, hanging)
    others = [plants.center(k) for k in np.flatnonzero(plants.state == HANGING).tolist() if k != fruit]
    near = [(o - center) / max(float((o - center) @ (o - center)), 1e-4) for o in others]
    crowd = np.sum([o for o in near if np.linalg.norm(o) > 1 / 0.12] or [_STILL], axis=0)
    side = -1.0 if crowd @ np.cross(about, hanging) > 0 else 1.0
    back = -1.0 if axis @ np.cross(across, hanging) > 0 else 1.0
    yield from (side * about, back * across, -side * about, -back * across)


def part(trial: Rehearsal, fruit: int, axis: Array) -> None:
    """Turn a held fruit about the joint of its pedicel, and at last pull as well, until it comes off."""
    plants = trial.plants
    for step in range(_PULLS):
        if plants.held != fruit or plants.state[fruit] != HANGING:
            return
        tip, tool = trial.tip
        spin = axis * _TURNING if step < _TURNS else _STILL
        pull = _STILL if step < _TURNS // 2 else -tool * _PULLING
        trial.twist(np.cross(spin, tip - plants.joint_of(fruit)) + pull, spin, True)


def retreats(trial: Rehearsal) -> tuple[Array, ...]:
    """Return directions (3,) to withdraw in: straight back, and back and up or down."""
    _, axis = trial.tip
    directions = (-axis, _UP * 0.7 - axis, -_UP * 0.7 - axis)
    return tuple(direction / max(float(np.linalg.norm(direction)), 1e-9) for direction in directions)


def withdraw(trial: Rehearsal, direction: Array) -> None:
    """Move the tip in a direction until its fruit is clear of the truss, and yield to whatever blocks it."""
    start, _ = trial.tip
    clear = _RETREAT + 2 * trial.plants.radius(max(trial.plants.held, 0))
    for step in range(1, _RETREATS + 1):
        if (trial.tip[0] - start) @ direction > clear or trial.plants.held < 0:
            return
        trial.twist(direction * min(_BACK, _FASTER * step) + _YIELDING * trial.force, _STILL, True)


def with_fruit(robot: Robot, radius: float) -> Robot:
    """Return an arm with a fruit at its cup, for planning."""
    return _with_fruit(robot, _STEP * float(np.ceil(_SHRUNK * radius / _STEP)))


@lru_cache(maxsize=16)
def _with_fruit(robot: Robot, radius: float) -> Robot:
    spec = robot.spec()
    tip = spec.site(TIP_SITE)
    middle = np.empty(3)
    mujoco.mju_rotVecQuat(middle, np.array([0.0, 0.0, radius]), np.array(tip.quat))
    tip.parent.add_geom(
        name="held_fruit", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], pos=tip.pos + middle,
        mass=0, contype=1, conaffinity=3,
    )  # fmt: skip
    return replace(robot, specification=spec)
