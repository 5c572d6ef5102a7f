"""Search for starts that are collision-free before any row: upright over the base, or ready in front of the plants."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import mujoco
import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array

CART_HALF_WIDTH = 0.12
"""Half width of the cart that an arm stands on, metres."""

CART_GAP, FOOT_GAP = 0.03, 0.02
"""Distance of the cart's top below the arm's base, and smallest distance below the arm's foot, metres."""

_CLEARANCE = 0.006  # metres, of the arm from itself and the cart
_SAMPLES, _ROUNDS, _PER_ROUND = 3000, 10, 300
_BEND_WEIGHT = 0.003  # metres from the axis per radian away from the middle of a joint's limits
_HEIGHT_WEIGHT = 0.1  # metres towards the axis per metre of height of the tip
_MAX_TOOL_ANGLE = np.pi / 6  # radians from forward
_MAX_AHEAD, _LEAN = 0.25, 0.2  # metres ahead of the base, less per metre of height above it
_MIN_TIP_AHEAD, _MAX_TIP_ASIDE = 0.1, 0.12  # metres from the base
_EXCESS_WEIGHT, _ANGLE_WEIGHT = 3.0, 0.1  # singular value per radian or metre beyond these limits, per radian within
_TURN_LENGTH = 0.3  # metres that count as much as a radian in a Jacobian


def cart_drop(foot: float) -> float:
    """Return the depth of the cart's top below an arm's base, metres, given the depth of the arm's foot."""
    return max(CART_GAP, foot + FOOT_GAP)


def upright_start(spec: mujoco.MjSpec, lower: Array, upper: Array, foot: float, seed: int = 0) -> Array:
    """Return the sampled configuration in which the arm stays closest to the vertical through its base.

    Args:
        spec: The prepared arm.
        lower: (n,) lower joint limits, radians or metres.
        upper: (n,) upper joint limits.
        foot: Depth of the arm below the origin of its base, metres.
        seed: Same seed, same start.

    Raises:
        InvalidValueError: All sampled configurations are in self-collision.
    """
    return _search(spec, lower, upper, foot, _spread, seed)


def ready_start(spec: mujoco.MjSpec, lower: Array, upper: Array, foot: float, seed: int = 0) -> Array:
    """Return the sampled configuration from which the tool can best move in any direction and faces the plants.

    The tool points forward, within 30 degrees, from a tip at least 0.1 m ahead of the base and at most 0.12 m aside.
    The arm stays over its aisle: at most 0.25 m ahead of its base at the base's height, 5 cm less at 0.25 m above,
    since leaves hang out of a row. Among these configurations, the least singular one is chosen, which bends elbow and
    wrist. Arguments and errors are those of `upright_start`.
    """
    return _search(spec, lower, upper, foot, _unreadiness, seed)


SEARCHES: Mapping[str, Callable[[mujoco.MjSpec, Array, Array, float], Array]] = MappingProxyType(
    {"ready": ready_start, "upright": upright_start}
)
"""Searches for a start by its name."""


def _search(
    spec: mujoco.MjSpec,
    lower: Array,
    upper: Array,
    foot: float,
    cost: Callable[[mujoco.MjModel, mujoco.MjData], float],
    seed: int,
) -> Array:
    """Return the collision-free configuration of the lowest cost, which is at most one turn from the middle."""
    tried = spec.copy()
    base = tried.worldbody.first_body()
    tried.worldbody.add_geom(
        name="cart below", type=mujoco.mjtGeom.mjGEOM_BOX, size=[CART_HALF_WIDTH, CART_HALF_WIDTH, 0.25],
        pos=np.asarray(base.pos) - [0.0, 0.0, cart_drop(foot) + 0.25], contype=3, conaffinity=3,
    )  # fmt: skip
    model = tried.compile()
    model.geom_margin += _CLEARANCE / 2
    model.body_margin += _CLEARANCE / 2
    data = mujoco.MjData(model)
    rng = np.random.default_rng(seed)
    middle = best = (lower + upper) / 2
    lowest = np.inf
    # at most one turn of each joint
    lower, upper = np.maximum(lower, middle - np.pi), np.minimum(upper, middle + np.pi)

    def consider(candidates: Array) -> None:
        nonlocal best, lowest
        for candidate in candidates:
            data.qpos[:] = candidate
            mujoco.mj_kinematics(model, data)
            found = cost(model, data) + _BEND_WEIGHT * float(np.abs(candidate - middle).sum())
            if found < lowest:
                mujoco.mj_collision(model, data)
                if data.ncon == 0:
                    best, lowest = candidate, found

    consider(rng.uniform(lower, upper, (_SAMPLES, len(lower))).round(4))
    for width in np.geomspace(0.3, 0.01, _ROUNDS):
        near = best + width * rng.standard_normal((_PER_ROUND, len(lower)))
        consider(np.clip(near.round(4), lower, upper))
    if not np.isfinite(lowest):
        raise InvalidValueError("no start: the arm touches itself or its cart in all sampled configurations")
    return best


def ahead_of_base(model: mujoco.MjModel, configuration: Array) -> float:
    """Return the largest distance (along x) of the arm's joints and sites ahead of its base's axis, metres."""
    data = mujoco.MjData(model)
    data.qpos[:] = configuration
    mujoco.mj_kinematics(model, data)
    return float(max(data.xanchor[:, 0].max(), data.site_xpos[:, 0].max()) - data.xpos[1, 0])


def foot_depth(model: mujoco.MjModel) -> float:
    """Return the depth of the base and first link of an arm below the base's origin, metres, at least 0."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    first_link = int(model.jnt_bodyid[0])
    lowest = 0.0
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        collides = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        if collides and (body == first_link or model.body_weldid[body] == 0):
            center, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            turn = data.geom_xmat[geom].reshape(3, 3)
            bottom = data.geom_xpos[geom, 2] + turn[2] @ center - np.abs(turn[2]) @ half
            lowest = max(lowest, float(data.xpos[1, 2] - bottom))
    return lowest


def _points(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Return the positions (k, 3) of an arm's joints, moving geoms and sites relative to its base, metres."""
    points = np.concatenate([data.xanchor, data.geom_xpos[model.geom_bodyid > 0], data.site_xpos])
    return points - data.xpos[1]


def _spread(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    offset = _points(model, data)[:, :2]
    tip = float(data.site_xpos[model.site("tip").id, 2])
    return float(np.sqrt((offset * offset).sum(axis=-1).max())) - _HEIGHT_WEIGHT * tip


def _unreadiness(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return the cost of a start: the excess over the limits, less the arm's smallest singular value."""
    site = model.site("tip").id
    points, tip = _points(model, data), data.site_xpos[site] - data.xpos[1]
    angle = np.arccos(np.clip(data.site_xmat[site, 2], -1.0, 1.0))
    ahead = (points[:, 0] + _LEAN * np.maximum(points[:, 2], 0.0)).max()
    excess = max(angle - _MAX_TOOL_ANGLE, 0.0) + max(ahead - _MAX_AHEAD, 0.0)
    excess += max(_MIN_TIP_AHEAD - tip[0], 0.0) + max(abs(tip[1]) - _MAX_TIP_ASIDE, 0.0)
    jacobian = np.empty((6, model.nv))
    mujoco.mj_comPos(model, data)
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
    jacobian[3:] *= _TURN_LENGTH
    dexterity = np.linalg.svd(jacobian, compute_uv=False)[-1]
    return float(_EXCESS_WEIGHT * excess + _ANGLE_WEIGHT * angle - dexterity)
