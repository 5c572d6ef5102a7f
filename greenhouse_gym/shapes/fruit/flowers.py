"""Flowers: small groups of petals, recognized by a yellow that is absent from leaves and rare on fruit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array, Shape, Sphere
from greenhouse_gym.shapes.colors import redness
from greenhouse_gym.shapes.evidence import SHELL, nearest_shapes
from greenhouse_gym.shapes.fruit.spheres import local_maxima
from greenhouse_gym.shapes.surface_cloud import Mask, SurfaceCloud

_REDNESS, _MAX_BLUE, _MIN_BRIGHTNESS = (-0.08, 0.13), 0.18, 0.3
"""Redness of petals, their blue as a fraction of the brightest channel, and this channel.

Petals of Helios' flowers have 0.05 and 0.05, photographed ones up to 0.08 and 0.17; turning fruit has 0.2 and more of
blue. On development rows 99 % of the points of this color lie on flowers.
"""

_MIN_PETALS = 0.25  # fraction of a sphere's points that are petals in a flower; fruit has at most 0.02
_BALL = 0.75  # fraction of the points in a sphere that lie on it and face outwards, from which it is yellow fruit
_ALIGNED = 0.8  # cosine between a point's normal and the sphere's
_RADIUS = 0.012  # metres: about that of a flower
_MIN_POINTS = 10  # petals that make a flower
_APART = 0.016  # metres between two flowers


def petal_mask(colors: Array) -> Mask:
    """Return which colors (n, 3), RGB from 0 to 1, may be those of petals."""
    red, brightest = redness(colors), colors.max(axis=1, initial=0.0)
    yellow = (red > _REDNESS[0]) & (red < _REDNESS[1]) & (colors[:, 2] < _MAX_BLUE * brightest)
    return np.asarray(yellow & (brightest > _MIN_BRIGHTNESS))


def flower_mask(spheres: Sequence[Sphere], surface: SurfaceCloud) -> Mask:
    """Return which of k spheres, in the frame of the surface, lie on petals rather than on the round skin of fruit."""
    tree, petals = cKDTree(surface.points), petal_mask(surface.colors)
    flowers = np.zeros(len(spheres), dtype=np.bool_)
    for k, sphere in enumerate(spheres):
        near = np.array(tree.query_ball_point(sphere.center, sphere.radius + SHELL), dtype=np.int64)
        if petals[near].sum() <= _MIN_PETALS * len(near):
            continue
        offset = surface.points[near] - sphere.center
        distance = np.linalg.norm(offset, axis=1)
        outwards = (offset * surface.normals[near]).sum(axis=1) > _ALIGNED * distance
        flowers[k] = (outwards & (np.abs(distance - sphere.radius) < SHELL)).mean() < _BALL
    return flowers


def find_flowers(surface: SurfaceCloud, fruit: Sequence[Shape]) -> tuple[Sphere, ...]:
    """Return a ball of usual size around each group of petals on no fruit, in the frame of the surface, metres."""
    points = surface.points[petal_mask(surface.colors)]
    points = points[nearest_shapes(points, fruit, SHELL).owner < 0]
    if not len(points):
        return ()
    near = cKDTree(points).query_ball_point(points, _RADIUS)
    counts = np.array([len(rows) for rows in near])
    middles = np.array([points[rows].mean(axis=0) for rows in near])
    best = np.flatnonzero((counts >= _MIN_POINTS) & local_maxima(middles, counts, _APART))
    return tuple(Sphere(middles[k], _RADIUS) for k in best)
