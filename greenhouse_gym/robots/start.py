"""Search for a start that is collision-free before any row: the arm upright over its base, away from the plants."""

from __future__ import annotations

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
            spread = _spread(model, data) + _BEND_WEIGHT * float(np.abs(candidate - middle).sum())
            if spread < lowest:
                mujoco.mj_collision(model, data)
                if data.ncon == 0:
                    best, lowest = candidate, spread

    consider(rng.uniform(lower, upper, (_SAMPLES, len(lower))).round(4))
    for width in np.geomspace(0.3, 0.01, _ROUNDS):
        near = best + width * rng.standard_normal((_PER_ROUND, len(lower)))
        consider(np.clip(near.round(4), lower, upper))
    if not np.isfinite(lowest):
        raise InvalidValueError("no upright start: the arm touches itself or its cart in all sampled configurations")
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


def _spread(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    points = np.concatenate([data.xanchor, data.geom_xpos[model.geom_bodyid > 0], data.site_xpos])
    offset = points[:, :2] - data.xpos[1, :2]
    tip = float(data.site_xpos[model.site("tip").id, 2])
    return float(np.sqrt((offset * offset).sum(axis=-1).max())) - _HEIGHT_WEIGHT * tip
