"""Clearances of the tool and the wrist on rays from a target, which show how it can be approached."""

from __future__ import annotations

from itertools import product

import numpy as np

from greenhouse_gym.envs.state import Float32
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import FieldStore

AZIMUTHS, ELEVATIONS = np.radians([-80, -48, -16, 16, 48, 80]), np.radians([-50, -17, 17, 50])
"""Directions of the rays from the target toward the arm's side of the plants, radians; the first azimuth is on the
arm's right."""

NEAR, FAR = (0.05, 0.09, 0.13), (0.18, 0.24, 0.30)
"""Distances from the target's center that the tool and the wrist would have, metres."""

NUM_CLEARANCES = 2 * len(AZIMUTHS) * len(ELEVATIONS)
"""Number of clearances that `clearance_rays` returns."""


def _rays() -> Array:
    """Return points (rays, 2, distances, 3) around a target, metres, in the base frame."""
    directions = np.array(
        [[-np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)] for a, e in product(AZIMUTHS, ELEVATIONS)]
    )
    return directions[:, None, None, :] * np.array([NEAR, FAR])[None, :, :, None]


_POINTS = _rays()


def clearance_rays(fields: FieldStore, slot: int, ignored: int, target: Array) -> Float32:
    """Return the smallest obstacle distances (`NUM_CLEARANCES`,) on each ray, near (tool) and far (wrist), metres.

    Args:
        fields: The distance fields.
        slot: Slot of the scene's field.
        ignored: Index of the target, which is not an obstacle, or `NO_TOMATO`.
        target: (3,) center of the target in the base frame, metres.
    """
    points = (target + _POINTS).reshape(1, -1, 3)
    distance, _ = fields.lookup(np.array([slot]), np.array([ignored]), points)
    return np.asarray(distance.reshape(_POINTS.shape[:3]).min(axis=-1).reshape(-1))
