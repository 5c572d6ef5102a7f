"""Candidate points of peduncles near fruit, and features of their surroundings.

A peduncle is thin and long, stands free, and has the color of the row's main stems. But edges of leaves are as thin,
and stems are redder than leaves in some rows, greener in others, or of the same color. No single rule covers all of
these rows, so a small network scores the surroundings of each point at two scales.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import means_by_voxel
from greenhouse_gym.shapes.evidence import SHELL, nearest_shapes, off_skin_mask
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.surface_cloud import NO_LEAF, SurfaceCloud, redness

PEDUNCLE_RADIUS = 0.0019
"""Radius of a peduncle in metres, too thin to measure; 3 to 4.5 mm in diameter are usual."""

TRUSS_REACH = 0.12
"""Metres from the center of a fruit within which the stems that hold it are searched."""

PATH_STEP = 0.004
"""Metres between the points along which peduncles are traced."""

STEM_MARGIN = 0.008
"""Metres from a main stem within which points are its own bumps, not a peduncle."""

_OWN = (
    "smaller curvature", "larger curvature", "elongation", "to leaves", "to stems", "to own", "leaves to stems",
    "leaves",
)  # fmt: skip
_FROM_FRUIT = ("skin", "skin, logarithm", "next skin", "above fruit", "main stem")
_AROUND = ("points", "linear", "planar", "width", "extent", "upright", "agree", "off center", "hues", "to hues")
_REACHES = (0.008, 0.016)  # metres

FEATURES = (*_OWN, *_FROM_FRUIT, *(f"{name}, {1e3 * reach:g} mm" for reach in _REACHES for name in _AROUND))
"""Names of the features of a candidate point.

Its own: principal curvatures and elongation; how much redder it is than leaves, main stems and its neighborhood, how
much redder leaves are than stems, and the spread of the leaves' hue. Then the distances to the skins of the nearest
fruit and the next one, its height above the nearest one's center in radii, and the distance to a main stem's axis. Of
the candidates around it: their number, how linear and planar they are, their extent across and along, how upright they
are, the agreement of their normals, the distance to their centroid, the spread of their hues, and how much redder the
point is than they.
"""

COLOR_FEATURES = tuple(k for k, name in enumerate(FEATURES) if name.startswith(("to ", "leaves", "hues")))
"""Indices of the features that depend on color and are 0 in a cloud of one color."""

_NEXT = 4  # fruits nearest by center among which the nearest skin is searched
_FAR = 0.3  # metres to a main stem, at most
_MIN_VARIANCE = 1e-7  # square metres, added to the extent of a single point


class PeduncleCandidates(NamedTuple):
    """Points (n, 3) on the axes of possible peduncles, metres, and their `FEATURES` (n, m)."""

    nodes: Array
    features: Array


def peduncle_candidates(surface: SurfaceCloud, tomatoes: tuple[Tomato, ...], main: list[Stem]) -> PeduncleCandidates:
    """Return all candidate points within reach of a fruit that lie neither on its skin nor on a main stem.

    Args:
        surface: The cloud.
        tomatoes: The fruits.
        main: The main stems.
    """
    if not tomatoes:
        return PeduncleCandidates(np.zeros((0, 3)), np.zeros((0, len(FEATURES))))
    centers, radii = np.array([t.center for t in tomatoes]), np.array([t.radius for t in tomatoes])
    distance, _ = cKDTree(centers).query(surface.points, distance_upper_bound=TRUSS_REACH)
    near = surface.select(np.isfinite(distance))
    near = near.select(off_skin_mask(near.points, near.normals, tomatoes))
    near = near.select(nearest_shapes(near.points, main, STEM_MARGIN).owner < 0)
    # only the near side is visible; the axis lies behind it
    inside = near.points - PEDUNCLE_RADIUS * near.normals
    shapes = np.column_stack([near.curvatures, np.log(np.maximum(near.elongations, 0.01))])
    colors = np.column_stack([near.hues, redness(near.colors), near.hues])  # means are taken of three columns
    (nodes, points, normals, shapes, colors), _ = means_by_voxel(
        inside, PATH_STEP, inside, near.points, near.normals, shapes, colors
    )
    if not len(nodes):
        return PeduncleCandidates(nodes, np.zeros((0, len(FEATURES))))
    on_main = nearest_shapes(surface.points, main, SHELL).owner >= 0
    own = _own_features(shapes, colors, surface, surface.hues[on_main])
    around = [_features_around(nodes, normals, colors[:, 0], reach) for reach in _REACHES]
    return PeduncleCandidates(
        nodes, np.column_stack([own, _features_from_fruit(points, centers, radii, main), *around])
    )


def _own_features(shapes: Array, colors: Array, surface: SurfaceCloud, stem_hues: Array) -> Array:
    hue, raw, _ = colors.T
    known = [] if surface.leaf_hue == NO_LEAF else [surface.leaf_hue]
    known += [float(np.median(stem_hues))] if len(stem_hues) else []
    leaf, *_, stem = [*known, *known] or 2 * [float(np.median(hue))]
    row = np.tile([leaf - stem, surface.leaf_hue_spread], (len(hue), 1))
    return np.column_stack([shapes, hue - leaf, hue - stem, raw - hue, row])


def _features_from_fruit(points: Array, centers: Array, radii: Array, main: list[Stem]) -> Array:
    nearest = cKDTree(centers).query(points, k=np.arange(1, min(_NEXT, len(centers)) + 1))[1]
    skins = np.linalg.norm(points[:, None] - centers[nearest], axis=-1) - radii[nearest]
    order = np.argsort(skins, axis=1)
    first, second = np.sort(skins, axis=1)[:, [0, min(1, skins.shape[1] - 1)]].T
    fruit = np.take_along_axis(nearest, order[:, :1], axis=1)[:, 0]
    above = (points[:, 2] - centers[fruit, 2]) / radii[fruit]
    stem = nearest_shapes(points, main, _FAR)
    to_axis = np.nan_to_num(stem.residual, nan=_FAR) + np.array([*(s.radius for s in main), 0.0])[stem.owner]
    to_main = np.minimum(to_axis, _FAR)
    return np.column_stack([first, np.log(np.maximum(first, 0.001)), second, above, to_main])


def _features_around(nodes: Array, normals: Array, hues: Array, reach: float) -> Array:
    near = Neighborhoods(nodes, reach)
    variances, axes = np.linalg.eigh(near.covariances(nodes, nodes))
    thick, wide, long = np.maximum(variances, 0.0).T
    middle, hue = near.mean(nodes), near.mean(hues[:, None])[:, 0]
    spread = np.sqrt(np.maximum(near.mean(hues[:, None] ** 2)[:, 0] - hue**2, 0.0))
    whole = long + _MIN_VARIANCE
    return np.column_stack([
        np.log(near.count), (long - wide) / whole, (wide - thick) / whole, np.sqrt(wide) / reach, np.sqrt(long) / reach,
        np.abs(axes[:, 2, 2]), np.linalg.norm(near.mean(normals), axis=1),
        np.linalg.norm(middle - nodes, axis=1) / reach, spread, hues - hue,
    ])  # fmt: skip
