"""How the surfaces of a cloud bend, and what color its leaves are.

Leaves are flat or bend one way, stems bend one way and much, fruit bends alike both ways. The color of leaves differs
from cultivar to cultivar and with the light, so it is read off the cloud itself: it is that of what is flat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.colors import is_colorful, redness
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.settings import ShapeSettings

_CELL = 0.005  # metres: pieces of surface are told apart at this size
_REACH = 0.011  # and looked at together with those this near
_SLACK = 3e-6  # square metres, added to how far a piece spreads, so that a speck does not bend
_FLAT = 10.0  # 1/m: what bends less both ways is flat
_FEWEST_FLAT = 200  # pieces that tell the leaves' color
_MOST_SPREAD = 0.06  # of the redness of leaves, that of reflected and of transmitted light

NO_LEAF = -1.0
"""The leaves' redness where nothing is flat: everything is redder."""


@dataclass(frozen=True, eq=False)
class SurfaceCloud(Cloud):
    """A cloud and what is known of the surface around each of its points.

    Attributes:
        bends: (n, 2) its principal curvatures in 1/m, the smaller first; positive where it bulges.
        lengths: (n,) how many times as much it spreads along as across, a ratio of variances.
        tones: (n,) its redness, smoothed over neighbors.
        leaf: Redness of the leaves in the middle, or `NO_LEAF` where there are none.
        spread: By how much that scatters (a standard deviation, by the quartiles).
    """

    bends: Array
    lengths: Array
    tones: Array
    leaf: float
    spread: float

    def select(self, rows: npt.NDArray[np.generic]) -> SurfaceCloud:
        """The points at ``rows``: indices or a mask."""
        return replace(
            self,
            **{
                name: getattr(self, name)[rows] for name in ("points", "colors", "normals", "bends", "lengths", "tones")
            },
        )


def look_at_surfaces(cloud: Cloud, settings: ShapeSettings) -> SurfaceCloud:
    """Look at how a cloud, one point per voxel of ``settings.voxel``, bends around each point."""
    if not len(cloud):
        return SurfaceCloud(
            cloud.points, cloud.colors, cloud.normals, np.zeros((0, 2)), np.zeros(0), np.zeros(0), NO_LEAF, 0.0
        )
    cells, cell = voxel_means(cloud, _CELL)
    near = Neighborhoods(cells.points, _REACH)
    # normals change linearly over a bent surface: the shape operator by least squares, within the tangent plane
    _, axes = np.linalg.eigh(near.moments(cells.normals, cells.normals))
    tangent = axes[:, :, :2]
    spread = near.covariances(cells.points, cells.points)
    variances = np.linalg.eigvalsh(spread)
    place = _within(tangent, spread) + _SLACK * np.eye(2)
    operator = np.linalg.solve(place, _within(tangent, near.covariances(cells.points, cells.normals)))
    bends = np.asarray(np.linalg.eigvalsh((operator + operator.transpose(0, 2, 1)) / 2), dtype=np.float64)
    tones = near.mean(redness(cells.colors)[:, None])[:, 0]
    flat = (np.abs(bends).max(axis=1) < _FLAT) & is_colorful(cells.colors, settings)
    leaf, scatter = NO_LEAF, 0.0
    if np.count_nonzero(flat) >= _FEWEST_FLAT:
        low, leaf, high = np.quantile(tones[flat], (0.25, 0.5, 0.75)).tolist()
        scatter = min((high - low) / 1.35, _MOST_SPREAD)
        if leaf >= 0.0:  # redder than green: a table or a wall
            leaf, scatter = NO_LEAF, 0.0
    lengths = variances[:, 2] / (variances[:, 1] + _SLACK)
    return SurfaceCloud(
        cloud.points, cloud.colors, cloud.normals, bends[cell], lengths[cell], tones[cell], leaf, scatter
    )


def looked_at_finer(surface: SurfaceCloud, fine: Cloud, settings: ShapeSettings) -> SurfaceCloud:
    """What is known of a surface at the points of a finer cloud of it; those far from all of its own are left out.

    Where the finer cloud has no normals, it gets those of the surface.
    """
    if not len(surface) or not len(fine):
        return surface
    away, nearest = cKDTree(surface.points).query(fine.points, distance_upper_bound=2 * settings.voxel)
    near = np.isfinite(away)
    fine, own = fine.select(near), surface.select(nearest[near])
    bare = np.linalg.norm(fine.normals, axis=1) < 0.5
    normals = np.where(bare[:, None], own.normals, fine.normals)
    return replace(own, points=fine.points, colors=fine.colors, normals=normals)


def _within(tangent: Array, moments: Array) -> Array:
    """Moments (n, 3, 3) within planes spanned by (n, 3, 2), (n, 2, 2)."""
    return np.asarray(tangent.transpose(0, 2, 1) @ moments @ tangent)
