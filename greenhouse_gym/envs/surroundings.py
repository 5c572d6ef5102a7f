"""Distances to obstacles around a target, which show how it can be approached: on rays from it, and on a grid."""

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
"""Number of clearances on rays."""

FORWARD, ACROSS = np.linspace(-0.5, 0.0, 5), np.linspace(-0.375, 0.375, 7)
"""Nodes of the grid from the target's center along x, and along y and z, metres."""

NUM_NODES = len(FORWARD) * len(ACROSS) ** 2
"""Number of nodes of the grid."""


def _points() -> Array:
    """Return three points (numbers, 3, 3) around a target for each number, metres, in the base frame."""
    directions = np.array(
        [[-np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)] for a, e in product(AZIMUTHS, ELEVATIONS)]
    )
    rays = directions[:, None, None, :] * np.array([NEAR, FAR])[None, :, :, None]
    nodes = np.array(list(product(FORWARD, ACROSS, ACROSS)))
    return np.concatenate([rays.reshape(-1, 3, 3), nodes[:, None].repeat(3, axis=1)])


POINTS = _points()
"""Three points (`NUM_CLEARANCES` + `NUM_NODES`, 3, 3) from the target's center for each number, of which the one
nearest to an obstacle counts, metres; those of a node of the grid are equal."""


def surroundings(fields: FieldStore, slot: int, ignored: int, target: Array) -> Float32:
    """Return the distances (`NUM_CLEARANCES` + `NUM_NODES`,) to the nearest obstacle around a target, metres.

    The first are the smallest on each ray, near (tool) and far (wrist); the others are those at the grid's nodes.

    Args:
        fields: The distance fields.
        slot: Slot of the scene's field.
        ignored: Index of the target, which is not an obstacle, or `NO_TOMATO`.
        target: (3,) center of the target in the base frame, metres.
    """
    distance, _ = fields.lookup(np.array([slot]), np.array([ignored]), (target + POINTS).reshape(1, -1, 3))
    return np.asarray(distance.reshape(POINTS.shape[:2]).min(axis=1))
