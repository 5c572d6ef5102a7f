"""Success criterion of reaching, shared by the environment and the planners' audit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array

SUCCESS_RADIUS = 0.02
"""Default maximum distance of the grasp point from the target's center, metres."""


def is_reached(distance: Array | float, radius: float = SUCCESS_RADIUS) -> npt.NDArray[np.bool_]:
    """Return whether targets are reached, given distances (...) from the grasp point to their centers, metres."""
    return distance < radius  # type: ignore[return-value]
