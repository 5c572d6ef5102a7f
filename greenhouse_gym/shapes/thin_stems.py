"""Where peduncles may run: places near fruit, and what is seen around each of them.

A peduncle is thin and long, stands free, and has the color of the row's main stems. But edges of leaves are as thin,
and in some rows stems are redder than leaves, in others greener or just like them. No rule tells peduncles in all of
these, so a small network weighs what surrounds a place at two sizes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import means_by_voxel
from greenhouse_gym.shapes.colors import redness
from greenhouse_gym.shapes.evidence import nearest_shapes
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surfaces import NO_LEAF, SurfaceCloud

Mask = npt.NDArray[np.bool_]

_BY_ITSELF = ("smaller bend", "larger bend", "length", "to leaves", "to stems", "to own", "leaves to stems", "leaves")
_FROM_FRUIT = ("skin", "skin, logarithm", "next skin", "above fruit", "main stem")
_AROUND = ("points", "linear", "planar", "width", "extent", "upright", "agree", "off middle", "tones", "to tones")
_REACHES = (0.008, 0.016)  # metres

MEASURES = (*_BY_ITSELF, *_FROM_FRUIT, *(f"{name}, {1e3 * reach:g} mm" for reach in _REACHES for name in _AROUND))
"""What is measured of each place.

By itself: its principal curvatures and how long things are there; how much redder it is than leaves, main stems and its
neighborhood, how much redder leaves are than stems, and how leaves scatter. Then the distances to the nearest fruit's
skin and to the next one's, how many radii it is above the nearest one's center, and the distance to a main stem's axis.
And of what surrounds it: how many places, how long and flat they spread, how far across and along, how upright, how
well their normals agree, how far off their middle it lies, how tones scatter, and how much redder it is than they.
"""

OF_COLOR = tuple(k for k, name in enumerate(MEASURES) if name.startswith(("to ", "leaves", "tones")))
"""Which of these are of color, and 0 in a cloud of one color."""

_NEXT = 4  # fruits, by their centers, among which the nearest skin is looked for
_FAR = 0.3  # metres to a main stem beyond which there is none
_SPECK = 1e-7  # square metres, of what spreads nowhere


class Places(NamedTuple):
    """Places (n, 3) on axes of what may be peduncles, metres, and their `MEASURES` (n, m)."""

    nodes: Array
    measures: Array


def stands_out(points: Array, normals: Array, tomatoes: tuple[Tomato, ...], settings: ShapeSettings) -> Mask:
    """Which points (n, 3) with normals (n, 3) are no skin of a tomato; a stem on it is off the sphere and turned."""
    skin = nearest_shapes(points, [tomato.shape for tomato in tomatoes], settings.shell)
    on = np.flatnonzero(skin.owner >= 0)
    outwards = points[on] - np.array([t.center for t in tomatoes]).reshape(-1, 3)[skin.owner[on]]
    aligned = (outwards * normals[on]).sum(axis=1) > settings.skin_alignment * np.linalg.norm(outwards, axis=1)
    free = skin.owner < 0
    free[on] = ~aligned & (skin.residual[on] > settings.skin_noise)
    return free


def places_near_fruit(
    surface: SurfaceCloud, tomatoes: tuple[Tomato, ...], main: list[Stem], settings: ShapeSettings
) -> Places:
    """Measure all places within reach of a fruit that lie neither on its skin nor on a main stem.

    Args:
        surface: The cloud.
        tomatoes: The fruits.
        main: The main stems.
        settings: All settings.
    """
    if not tomatoes:
        return Places(np.zeros((0, 3)), np.zeros((0, len(MEASURES))))
    centers, radii = np.array([t.center for t in tomatoes]), np.array([t.radius for t in tomatoes])
    away, _ = cKDTree(centers).query(surface.points, distance_upper_bound=settings.truss_reach)
    near = surface.select(np.isfinite(away))
    near = near.select(stands_out(near.points, near.normals, tomatoes, settings))
    near = near.select(nearest_shapes(near.points, main, settings.stem_margin).owner < 0)
    # only the near side is seen; the axis lies behind it
    inside = near.points - settings.peduncle_radius * near.normals
    shapes = np.column_stack([near.bends, np.log(np.maximum(near.lengths, 0.01))])
    colors = np.column_stack([near.tones, redness(near.colors), near.tones])
    (nodes, points, normals, shapes, colors), _ = means_by_voxel(
        inside, settings.path_step, inside, near.points, near.normals, shapes, colors
    )
    if not len(nodes):
        return Places(nodes, np.zeros((0, len(MEASURES))))
    on_main = nearest_shapes(surface.points, main, settings.shell).owner >= 0
    own = _by_itself(shapes, colors, surface, surface.tones[on_main])
    around = [_around(nodes, normals, colors[:, 0], reach) for reach in _REACHES]
    return Places(nodes, np.column_stack([own, _from_fruit(points, centers, radii, main), *around]))


def _by_itself(shapes: Array, colors: Array, surface: SurfaceCloud, on_main: Array) -> Array:
    tone, raw, _ = colors.T
    known = ([] if surface.leaf == NO_LEAF else [surface.leaf]) + ([float(np.median(on_main))] if len(on_main) else [])
    leaf, *_, stem = [*known, *known] or 2 * [float(np.median(tone))]
    row = np.tile([leaf - stem, surface.spread], (len(tone), 1))
    return np.column_stack([shapes, tone - leaf, tone - stem, raw - tone, row])


def _from_fruit(points: Array, centers: Array, radii: Array, main: list[Stem]) -> Array:
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


def _around(nodes: Array, normals: Array, tones: Array, reach: float) -> Array:
    near = Neighborhoods(nodes, reach)
    variances, axes = np.linalg.eigh(near.covariances(nodes, nodes))
    thick, wide, long = np.maximum(variances, 0.0).T
    middle, tone = near.mean(nodes), near.mean(tones[:, None])[:, 0]
    scatter = np.sqrt(np.maximum(near.mean(tones[:, None] ** 2)[:, 0] - tone**2, 0.0))
    whole = long + _SPECK
    return np.column_stack([
        np.log(near.count), (long - wide) / whole, (wide - thick) / whole, np.sqrt(wide) / reach, np.sqrt(long) / reach,
        np.abs(axes[:, 2, 2]), np.linalg.norm(near.mean(normals), axis=1),
        np.linalg.norm(middle - nodes, axis=1) / reach, scatter, tones - tone,
    ])  # fmt: skip
