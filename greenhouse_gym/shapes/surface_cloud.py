"""Curvature of a cloud's surfaces, the color of its leaves, and which points may be fruit, stem or pipe.

Leaves are flat or curved in one direction, stems are strongly curved in one direction, and fruit is equally curved in
both. The color of leaves differs between cultivars and with the light, so it is estimated from the flat parts of the
cloud itself. Points that are curved like fruit or a stem may be such whatever their color, and so may points redder
than the leaves.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.settings import ShapeSettings

_MIN_SATURATION = 0.15  # fruit and stems exceed this; gutters and strings are white

Mask = npt.NDArray[np.bool_]

NO_LEAF = -1.0
"""Hue of the leaves in a cloud without flat parts: every point is redder."""

_CELL = 0.005  # metres: size of the surface pieces that are measured
_REACH = 0.011  # metres: radius of the neighborhood of a piece
_MIN_VARIANCE = 3e-6  # square metres, added to the extent of a piece so that a speck has no curvature
_FLAT = 10.0  # 1/m: a piece is flat if both curvatures are smaller
_THIN = 0.04  # ratio of the variances across and along a piece below which its plane shows its normal
_FLATTEST = 0.1  # fraction of the pieces that are taken as flat whatever the noise
_PART = 0.25  # metres: size of the parts of a cloud whose noise is judged on its own
_MIN_FLAT = 200  # flat pieces needed to estimate the color of leaves
_MAX_HUE_SPREAD = 0.06  # of leaves: that between reflected and transmitted light
_LEAF_CONTRAST = 0.07  # points redder than leaves by this are no leaf
_FRUIT_CURVATURE = 6.0  # 1/m in both directions, above which a point may be fruit
_STEM_CURVATURE = 25.0  # 1/m in one direction, above which a point may lie on a main stem
_STEM_ELONGATION = 4.0  # ratio of variances along and across, above which a point may lie on a main stem


def colorful_mask(colors: Array) -> npt.NDArray[np.bool_]:
    """Return which colors (n, 3) are not white, gray or black; all of them if none is.

    Strings and gutters are white or gray.
    """
    saturation = 1.0 - colors.min(axis=1, initial=1.0) / np.maximum(colors.max(axis=1, initial=0.0), 1e-6)
    colorful = np.asarray(saturation > _MIN_SATURATION)
    return colorful | ~colorful.any()


def redness(colors: Array) -> Array:
    """Return (R - G) / (R + G) of colors (n, 3), which shading does not change."""
    red, green = colors[:, 0], colors[:, 1]
    return np.asarray((red - green) / np.maximum(red + green, 1e-6))


@dataclass(frozen=True, eq=False)
class SurfaceCloud(Cloud):
    """A cloud with measures of the surface around each point.

    Attributes:
        curvatures: (n, 2) principal curvatures in 1/m, the smaller first; positive where the surface bulges.
        elongations: (n,) ratio of the variances along and across the local surface.
        hues: (n,) redness, smoothed over neighbors.
        noises: (n,) `noise` of the part of the cloud around each point, m; it often grows with the distance.
        leaf_hue: Median redness of the leaves, or `NO_LEAF`.
        leaf_hue_spread: Standard deviation of the leaves' redness, estimated from its quartiles.
        noise: Median over the cloud of the points' root mean square distance from a plane through a neighborhood, m.
        coherence: Median length of the mean of the unit normals in a neighborhood: 1 on a flat surface without noise.
        alignment: Median cosine between the normals of flat pieces and those of the planes through their points.
        density: Median number of surface pieces in a neighborhood.
    """

    curvatures: Array
    elongations: Array
    hues: Array
    noises: Array
    leaf_hue: float
    leaf_hue_spread: float
    noise: float = 0.0
    coherence: float = 1.0
    alignment: float = 1.0
    density: float = np.inf

    def select(self, rows: npt.NDArray[np.generic]) -> SurfaceCloud:
        """Return the points at ``rows``: indices or a mask."""
        names = ("points", "colors", "normals", "curvatures", "elongations", "hues", "noises")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})


def measure_surface(cloud: Cloud) -> SurfaceCloud:
    """Measure the surface of a cloud that has one point per voxel of ``ShapeSettings.voxel``."""
    if not len(cloud):
        none = np.zeros(0)
        return SurfaceCloud(cloud.points, cloud.colors, cloud.normals, np.zeros((0, 2)), none, none, none, NO_LEAF, 0.0)
    cells, cell = voxel_means(cloud, _CELL)
    near = Neighborhoods(cells.points, _REACH)
    # normals change linearly over a curved surface: least squares for the shape operator within the tangent plane
    _, axes = np.linalg.eigh(near.moments(cells.normals, cells.normals))
    tangent = axes[:, :, :2]
    spread = near.covariances(cells.points, cells.points)
    variances, own_axes = np.linalg.eigh(spread)
    cosines = np.abs((own_axes[:, :, 0] * cells.normals).sum(axis=1))
    cosines /= np.maximum(np.linalg.norm(cells.normals, axis=1), 1e-9)
    thin = variances[:, 0] < _THIN * variances[:, 1]
    extent = _project(tangent, spread) + _MIN_VARIANCE * np.eye(2)
    operator = np.linalg.solve(extent, _project(tangent, near.covariances(cells.points, cells.normals)))
    symmetric = (operator + operator.transpose(0, 2, 1)) / 2
    curvatures = np.asarray(np.linalg.eigvalsh(symmetric), dtype=np.float64)
    hues = near.mean(redness(cells.colors)[:, None])[:, 0]
    bent = np.abs(curvatures).max(axis=1)
    flat = (bent < max(_FLAT, np.quantile(bent, _FLATTEST))) & colorful_mask(cells.colors)
    elongations = variances[:, 2] / (variances[:, 1] + _MIN_VARIANCE)
    noise = np.sqrt(np.maximum(variances[:, 0], 0.0))
    return SurfaceCloud(
        cloud.points,
        cloud.colors,
        cloud.normals,
        curvatures[cell],
        elongations[cell],
        hues[cell],
        _local_medians(cells, noise)[cell],
        *_leaf_hue(hues[flat]),
        noise=float(np.median(noise)),
        coherence=float(np.median(np.linalg.norm(near.mean(cells.normals), axis=1))),
        alignment=float(np.median(cosines[thin])) if thin.any() else 1.0,
        density=float(np.median(near.count)),
    )


def transfer_surface(surface: SurfaceCloud, fine: Cloud, settings: ShapeSettings) -> SurfaceCloud:
    """Transfer surface measures to the points of a finer cloud, dropping points far from the surface.

    Points of the finer cloud that have no normals get those of the surface.
    """
    if not len(surface) or not len(fine):
        return surface
    distance, nearest = cKDTree(surface.points).query(fine.points, distance_upper_bound=2 * settings.voxel)
    near = np.isfinite(distance)
    fine, own = fine.select(near), surface.select(nearest[near])
    missing = np.linalg.norm(fine.normals, axis=1) < 0.5
    normals = np.where(missing[:, None], own.normals, fine.normals)
    return replace(own, points=fine.points, colors=fine.colors, normals=normals)


def fine_surface(whole: Cloud, surface: SurfaceCloud, settings: ShapeSettings) -> SurfaceCloud:
    """Return the surface of a whole cloud with a point per voxel of ``settings.fine_voxel``.

    It is empty if the whole cloud has no normals, since estimated ones do not resolve the curvature of small fruit.
    """
    fine = transfer_surface(surface, voxel_means(whole, settings.fine_voxel)[0], settings)
    measured = bool((np.linalg.norm(whole.normals, axis=1) > 0.5).any())
    return fine.select(np.full(len(fine), measured))


def fruit_mask(cloud: SurfaceCloud) -> Mask:
    """Return which points (n,) may be skin of a tomato: redder than leaves, or curved in both directions."""
    return colorful_mask(cloud.colors) & (_redder_than_leaves(cloud) | (cloud.curvatures[:, 0] > _FRUIT_CURVATURE))


def stem_mask(cloud: SurfaceCloud) -> Mask:
    """Return which points (n,) may lie on a main stem: redder than leaves, strongly curved, or elongated."""
    stem = _redder_than_leaves(cloud) | (cloud.curvatures[:, 1] > _STEM_CURVATURE)
    return colorful_mask(cloud.colors) & (stem | (cloud.elongations > _STEM_ELONGATION))


def pipe_mask(cloud: SurfaceCloud) -> Mask:
    """Return which points (n,) may lie on a pipe: all but those of leaves."""
    return ~colorful_mask(cloud.colors) | _redder_than_leaves(cloud)


def _redder_than_leaves(cloud: SurfaceCloud) -> Mask:
    return np.asarray(cloud.hues > cloud.leaf_hue + max(_LEAF_CONTRAST, 2.5 * cloud.leaf_hue_spread))


def _leaf_hue(hues: Array) -> tuple[float, float]:
    """Return the median hue of flat pieces (k,) and its spread, or `NO_LEAF` and 0 if they are no leaves."""
    if len(hues) < _MIN_FLAT:
        return NO_LEAF, 0.0
    low, median, high = np.quantile(hues, (0.25, 0.5, 0.75)).tolist()
    if median >= 0.0:  # redder than green: a table or a wall
        return NO_LEAF, 0.0
    return median, min((high - low) / 1.35, _MAX_HUE_SPREAD)


def _local_medians(cells: Cloud, values: Array) -> Array:
    """Return the median of values (n,) within about `_PART` of each of the cells (n,)."""
    blocks, block = voxel_means(cells, _PART / 2)
    medians = np.array(
        [
            np.median(part)
            for part in np.split(values[np.argsort(block, kind="stable")], np.cumsum(np.bincount(block))[:-1])
        ]
    )
    near = cKDTree(blocks.points).query_ball_point(blocks.points, _PART)
    return np.array([np.median(medians[rows]) for rows in near])[block]


def _project(tangent: Array, moments: Array) -> Array:
    """Return moments (n, 3, 3) within the planes spanned by ``tangent`` (n, 3, 2), as (n, 2, 2)."""
    return np.asarray(tangent.transpose(0, 2, 1) @ moments @ tangent)
