"""From where a target can be approached: how much room the tool and the wrist have on rays away from it."""

from __future__ import annotations

from itertools import product

import numpy as np

from greenhouse_gym.envs.reach_task import Float32
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.distance_field import FieldStore

AZIMUTHS, ELEVATIONS = np.radians([-80, -48, -16, 16, 48, 80]), np.radians([-50, -17, 17, 50])
"""Directions of the rays from the target toward the arm's side of the plants, radians; the first azimuth is on the
arm's right."""

NEAR, FAR = (0.05, 0.09, 0.13), (0.18, 0.24, 0.30)
"""Distances from the target's center, metres, at which the tool and the wrist would be."""

NUM_CLEARANCES = 2 * len(AZIMUTHS) * len(ELEVATIONS)
"""How many numbers `clearance_rays` gives."""


def _rays() -> Array:
    """(rays, 2, distances, 3) points around a target, metres, in the frame of the arm's base."""
    directions = np.array(
        [[-np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)] for a, e in product(AZIMUTHS, ELEVATIONS)]
    )
    return directions[:, None, None, :] * np.array([NEAR, FAR])[None, :, :, None]


_POINTS = _rays()


def clearance_rays(fields: FieldStore, slot: int, ignored: int, target: Array) -> Float32:
    """Smallest distance to an obstacle on each ray, near (tool) and far (wrist), (`NUM_CLEARANCES`,), metres.

    Args:
        fields: The distance fields.
        slot: The slot of the scene's field.
        ignored: Index of the target, which is no obstacle, or `NO_TOMATO`.
        target: (3,) the target's center in the frame of the arm's base, metres.
    """
    points = (target + _POINTS).reshape(1, -1, 3)
    distance, _ = fields.lookup(np.array([slot]), np.array([ignored]), points)
    return np.asarray(distance.reshape(_POINTS.shape[:3]).min(axis=-1).reshape(-1))
