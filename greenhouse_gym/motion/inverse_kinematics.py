"""Inverse kinematics by damped least squares (Wampler 1986), from many initial guesses at once."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array
from greenhouse_gym.robots.kinematics import Chain
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


def inverse_kinematics(
    chain: Chain,
    guesses: Array,
    point: Array,
    ahead: float,
    arm: Robot,
    approach: Approach | None = None,
    threshold: float = math.inf,
) -> tuple[Array, int]:
    """Bring the grasp point onto a point from many initial guesses, within the joint limits.

    Args:
        chain: The arm's chain.
        guesses: (m, n) configurations, radians.
        point: (3,) desired position of the grasp point, metres, world frame.
        ahead: Distance of the grasp point from the tip along the tool axis, metres.
        arm: The arm whose limits apply.
        approach: Cone that the tool axis must end up in; any direction if None.
        threshold: Guesses with the grasp point farther from the point than this are left out, metres.

    Returns:
        (k, n) the configurations that converged to `TOLERANCE`, in the order of their guesses, and the number of
        guesses that were not left out.
    """
    from greenhouse_gym.motion.kinematics_kernels import bring_onto

    q, done = np.array(guesses, dtype=np.float64, order="C"), np.empty(len(guesses), dtype=np.bool_)
    cone = np.array([0.0, 0.0, 0.0, -1.0] if approach is None else [*approach.direction, approach.half_angle])
    tried = bring_onto(
        chain.table, chain.offsets[-1, :3].reshape(12), np.array(point, dtype=np.float64), cone, arm.lower.copy(),
        arm.upper.copy(), np.array([ahead, TOLERANCE, _STEP, threshold]), np.array([_DAMPING, _TURN]), _ITERATIONS, q,
        done,
    )  # fmt: skip
    return q[done], tried
