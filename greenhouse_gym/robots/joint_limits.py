"""Limits of an arm's joints: those in its file, or defaults bounded by the force of its servos."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import FileFormatError, InvalidValueError
from greenhouse_gym.geometry import Array, numbers_of

DEFAULT_SPEED, DEFAULT_SLIDE_SPEED = 1.6, 0.4
"""Default speed limits, rad/s and m/s; a joint action of 1 requests them."""

DEFAULT_ACCELERATION, DEFAULT_SLIDE_ACCELERATION = 10.0, 2.0
"""Default acceleration limits, rad/s^2 and m/s^2."""

DAMPING_FRACTION = 0.8
"""Fraction of a servo's force that damping may use at the default speed limit; the rest is for acceleration."""


def joint_limits(model: mujoco.MjModel, start: Array) -> tuple[Array, Array]:
    """Return the limits that both joints and actuators allow; one turn around the start if neither has limits."""
    commanded = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [-np.inf, np.inf])
    allowed = np.where(model.jnt_limited[:, None], model.jnt_range, [-np.inf, np.inf])
    lower: Array = np.maximum(allowed[:, 0], commanded[:, 0])
    upper: Array = np.minimum(allowed[:, 1], commanded[:, 1])
    return (
        np.where(np.isfinite(lower), lower, np.minimum(start, upper) - np.pi),
        np.where(np.isfinite(upper), upper, np.maximum(start, lower) + np.pi),
    )


def motion_limits(path: Path, model: mujoco.MjModel, name: str, given: npt.ArrayLike | None, default: Array) -> Array:
    """Return limits (n,): the given ones, else those in the file, else the default."""
    if given is not None:
        limits = numbers_of(given)
        if limits.shape != (model.njnt,) or not (limits > 0).all():
            raise InvalidValueError(f"{name} must be {model.njnt} positive numbers, got {given!r}")
        return limits
    in_file = numeric(path, model, name, model.njnt)
    if in_file is not None and not (in_file > 0).all():
        raise FileFormatError(path, f"custom numeric {name!r} must be positive numbers, got {in_file.tolist()}")
    return default if in_file is None else in_file


def numeric(path: Path, model: mujoco.MjModel, name: str, size: int) -> Array | None:
    """Return the numbers (``size``,) of a custom numeric of a file; None if it has none of that name."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, name)
    if index < 0:
        return None
    first, count = model.numeric_adr[index], model.numeric_size[index]
    if count != size:
        raise FileFormatError(path, f"custom numeric {name!r} has {count} numbers, expected {size}")
    return np.array(model.numeric_data[first : first + count])


def attainable_speeds(model: mujoco.MjModel) -> Array:
    """Return the speeds at which damping uses `DAMPING_FRACTION` of the servos' force; inf without a limit."""
    force = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    at_joint = np.where(model.jnt_actfrclimited, model.jnt_actfrcrange[:, 1], np.inf)
    return DAMPING_FRACTION * np.minimum(force, at_joint) / np.maximum(model.dof_damping, 1e-9)


def servo_lag(model: mujoco.MjModel) -> float:
    """Return the lag of the slowest joint behind its command, seconds: its damping over its servo's stiffness."""
    damping = np.maximum(-model.actuator_biasprm[:, 2], model.dof_damping)
    return float((damping / model.actuator_gainprm[:, 0]).max())
