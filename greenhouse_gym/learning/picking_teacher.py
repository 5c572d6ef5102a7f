"""Teacher for picking: a feedback rule from the true state to motions of the tip.

It knows the fruit, its pedicel and the crate, but neither plans nor avoids obstacles. A policy that imitates it sees
more, such as distances to obstacles, and PPO can then improve on it.
"""

from __future__ import annotations

import numpy as np

from greenhouse_gym.envs.actions import TIP_SPEED, TIP_TURN
from greenhouse_gym.envs.simulation import Simulation
from greenhouse_gym.envs.state import Bools, State
from greenhouse_gym.geometry import Array

_REACHING, _APPROACH, _CREEP = 0.45, 3.0, 0.01  # m/s at most, 1/s times the gap to the skin, and m/s at the skin
_TURNING = 2.5  # 1/s: how fast the tool turns to the fruit
_ABOVE, _STRAIGHT = 0.4, 0.15  # slope of a path from above, and metres from the fruit at which it becomes straight
_NEAR, _ASKEW = 0.08, 0.9  # metres from the skin at which a tool of a smaller cosine to the fruit draws back
_ON = 0.015  # metres from the skin at which the vacuum is switched on; farther away it would catch a neighbor
_SPIN, _PULL = 0.8, 0.06  # rad/s about the joint of the pedicel, and m/s along the tool
_LIGHT, _FIRM, _SLOWEST, _YIELDING = 1.5, 6.0, 0.1, 0.012  # N, N, fraction of the pace, and m/s per N
_CLEAR, _BACK = 0.08, 0.25  # metres from its joint within which a fruit is near its truss, and m/s away from it
_PLANTS, _DEPTH = 0.36, 0.1  # metres: x from which a fruit is among plants, and over which that sets in
_AWAY, _ASIDE = 0.36, 0.6  # metres from the arm's axis at which fruit swing around it, and radians from the crate
_LIFT, _RISE = 0.1, 0.15  # metres over the rim at which fruit are carried, and below that over which they only rise
_SWING = 1.2  # rad/s around the arm
_OVER, _INSIDE, _LET_GO = 0.06, 0.02, 0.03  # metres from the crate's middle, below its rim, and above that
_UP = np.array([0.0, 0.0, 1.0])


def picking_labels(simulation: Simulation) -> Array:
    """Return the actions (n, 7) of the rule in each simulation."""
    assert simulation.state is not None
    return picking_rule(simulation.state)


def picking_rule(state: State) -> Array:
    """Return actions (n, 7), motions of the tip and the vacuum, that bring the fruit in work into the crate."""
    plants = state.plants
    held, idle = plants["held"][:, None] > 0, plants["work"][:, None] < 0
    apart = _length(plants["fruit"] - plants["joint"]) - plants["radius"][:, None]
    force = _length(plants["force"])
    ease = np.clip((_FIRM - force) / (_FIRM - _LIGHT), _SLOWEST, 1.0)
    back = np.concatenate([-_BACK * ease * state.axis, np.zeros_like(state.axis)], axis=1)
    carry, let_go = _carry(state)
    near = _length(plants["fruit"] - state.tip) - plants["radius"][:, None] < _ON
    motion = np.select(
        [idle, ~held, plants["hangs"][:, None] > 0, apart < _CLEAR],
        [np.zeros_like(back), _reach(state), _part(state, ease), back],
        carry,
    ) / np.repeat([TIP_SPEED, TIP_TURN], 3)
    motion /= np.maximum(np.abs(motion).max(axis=1, keepdims=True), 1.0)
    return np.concatenate([motion, np.where(np.where(held, ~let_go, near & ~idle), 1.0, -1.0)], axis=1)


def _reach(state: State) -> Array:
    """Return twists (n, 6) of the tip to the fruit, with the tool turning toward it."""
    offset = state.plants["fruit"] - state.tip
    direction = offset / np.maximum(_length(offset), 1e-9)
    gap = _length(offset) - state.plants["radius"][:, None]
    cosine = (state.axis * direction).sum(axis=1, keepdims=True)
    speed = np.clip(_APPROACH * gap + _CREEP, 0.0, _REACHING) * np.clip((cosine - 0.2) / 0.6, 0.15, 1.0)
    speed = np.where((gap < _NEAR) & (cosine < _ASKEW), -0.1, speed)
    # a folded arm that first went down would meet itself
    above = offset + _UP * _ABOVE * np.maximum(0.0, _length(offset[:, :2]) - _STRAIGHT)
    velocity = speed * above / np.maximum(_length(above), 1e-9)
    return np.concatenate([velocity, _TURNING * np.cross(state.axis, direction)], axis=1)


def _part(state: State, ease: Array) -> Array:
    """Return twists (n, 6) of the tip that turn a fruit about the joint of its pedicel, pull, and yield to forces."""
    plants, axis = state.plants, state.axis
    hang = plants["fruit"] - plants["joint"]
    hang = hang / np.maximum(_length(hang), 1e-9)
    about = axis - (axis * hang).sum(axis=1, keepdims=True) * hang
    spin = _SPIN * ease * about / np.maximum(_length(about), 1e-9)
    force = plants["force"]
    give = _YIELDING * np.maximum(0.0, 1.0 - _LIGHT / np.maximum(_length(force), 1e-9)) * force
    velocity = np.cross(spin, state.tip - plants["joint"]) - _PULL * ease * axis + give
    return np.concatenate([velocity, spin], axis=1)


def _carry(state: State) -> tuple[Array, Bools]:
    """Return twists (n, 6) out of the plants, around the arm and into the crate, and whether the fruit is there."""
    fruit, crate = state.plants["fruit"], state.plants["crate"]
    height = fruit[:, 2:] - crate[:, 2:]
    high = _LIFT + state.plants["radius"][:, None] - height
    among = np.clip((fruit[:, :1] - _PLANTS) / _DEPTH, 0.0, 1.0)
    free = 1 - np.maximum(0.9 * np.clip(high / _RISE, 0.0, 1.0), 0.95 * among)
    distance, bearing = _length(fruit[:, :2]), np.arctan2(fruit[:, 1], fruit[:, 0])
    around = np.arctan2(crate[:, 1], crate[:, 0]) - bearing
    around = ((around + np.pi) % (2 * np.pi) - np.pi)[:, None]
    swing = np.clip(4 * around, -_SWING, _SWING) * free
    outward = np.stack([np.cos(bearing), np.sin(bearing), np.zeros_like(bearing)], axis=1)
    goal = np.where(np.abs(around) < _ASIDE, _length(crate[:, :2]), _AWAY)
    velocity = outward * np.clip(3 * (goal - distance), -0.4, 0.4) * free
    velocity += np.cross(_UP, outward) * swing * distance + _UP * np.clip(4 * high, -0.3, 0.4) * (1 - among)
    velocity[:, :1] -= 0.35 * among
    aside = (crate - fruit) * [1.0, 1.0, 0.0]
    down = 4 * aside * np.minimum(1.0, 0.05 / np.maximum(_length(aside), 1e-9))
    down += _UP * np.clip(-4 * (height + _INSIDE), -0.25, 0.25)
    over = _length(aside) < _OVER
    velocity = np.where(over, down, velocity)
    spin = np.clip(2 * np.cross(state.axis, -_UP), -0.8, 0.8) + _UP * swing
    return np.concatenate([velocity, spin], axis=1), np.asarray(over & (height < _LET_GO - _INSIDE))


def _length(vectors: Array) -> Array:
    return np.asarray(np.sqrt((vectors * vectors).sum(axis=1, keepdims=True)))
