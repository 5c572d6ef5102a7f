"""Inverse kinematics by damped least squares (Wampler 1986), from many initial guesses at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots.kinematics import Chain, tool_state
from greenhouse_gym.robots.robot import Robot

TOLERANCE = 1e-3
"""Distance of the grasp point from the target's center at which inverse kinematics has converged, metres."""

_ITERATIONS = 20
_DAMPING = 0.03  # metres per radian
_TURN = 0.3  # metres per radian: weight of the tool's direction relative to its position
_STEP = 0.2  # metres: largest correction of the grasp point per iteration


@dataclass(frozen=True, eq=False)
class Approach:
    """A cone of directions that the tool may point in.

    Attributes:
        direction: (3,) the cone's axis, of any length. (1, 0, 0) points from the aisle into the plants.
        half_angle: Largest angle between the tool axis and the cone's axis, radians.

    Raises:
        InvalidValueError: No direction, or an angle outside 0 to pi.
    """

    direction: Array
    half_angle: float

    def __post_init__(self) -> None:
        direction = np.asarray(self.direction, dtype=np.float64)
        length = float(np.linalg.norm(direction))
        if direction.shape != (3,) or not (math.isfinite(length) and length > 0):
            raise InvalidValueError(f"approach: expected a direction (x, y, z), got {self.direction!r}")
        if not 0 < self.half_angle <= math.pi:
            raise InvalidValueError(f"approach: expected a half angle above 0, up to pi, got {self.half_angle!r}")
        object.__setattr__(self, "direction", direction / length)

    def turn(self, axis: Array) -> Array:
        """Return rotation vectors (m, 3) that turn tool axes (m, 3) to the cone's edge; zero for those inside it."""
        across = np.cross(axis, self.direction)
        sine = np.linalg.norm(across, axis=-1)
        outside = np.maximum(np.arctan2(sine, axis @ self.direction) - self.half_angle, 0.0)
        return across * (outside / np.maximum(sine, 1e-9))[:, None]


def inverse_kinematics(
    chain: Chain, guesses: Array, point: Array, ahead: float, arm: Robot, approach: Approach | None = None
) -> Array:
    """Bring the grasp point onto a point from many initial guesses, within the joint limits.

    Args:
        chain: The arm's chain.
        guesses: (m, n) configurations, radians.
        point: (3,) desired position of the grasp point, metres, world frame.
        ahead: Distance of the grasp point from the tip along the tool axis, metres.
        arm: The arm whose limits apply.
        approach: Cone that the tool axis must end up in; any direction if None.

    Returns:
        (k, n) the k <= m configurations that converged to `TOLERANCE`, in the order of their guesses.
    """
    q = guesses.copy()
    done = np.zeros(len(q), dtype=bool)
    for _ in range(_ITERATIONS):
        active = np.flatnonzero(~done)
        if not len(active):
            break
        state = tool_state(chain, q[active], ahead)
        error = point - state.point
        distance = np.linalg.norm(error, axis=-1, keepdims=True)
        arrived = distance[:, 0] < TOLERANCE
        error = error * np.minimum(1.0, _STEP / np.maximum(distance, 1e-12))
        jacobian = state.jacobian
        if approach is not None:
            turn = approach.turn(state.axis)
            outside = np.any(turn != 0, axis=1)
            arrived &= ~outside
            # slightly past the edge, so that the axis counts as inside
            error = np.concatenate([error, _TURN * 1.05 * turn], axis=-1)
            jacobian = np.concatenate([jacobian, _TURN * outside[:, None, None] * state.joint_axes], axis=1)
        done[active[arrived]] = True
        active, error, jacobian = active[~arrived], error[~arrived], jacobian[~arrived]
        normal = jacobian @ np.swapaxes(jacobian, -1, -2) + _DAMPING**2 * np.eye(jacobian.shape[1])
        step = np.einsum("mij,mi->mj", jacobian, np.linalg.solve(normal, error[..., None])[..., 0])
        q[active] = np.clip(q[active] + step, arm.lower, arm.upper)
    return q[done]
