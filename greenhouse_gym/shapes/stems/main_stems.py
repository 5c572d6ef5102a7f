"""Main stems and strings: chains of discs through slices of height."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from greenhouse_gym.crops.parts import Stem, StemKind
from greenhouse_gym.geometry import Array, distance_to_capsules
from greenhouse_gym.shapes.robust_fit import fit_polyline, gauss_newton_step, tukey_weights
from greenhouse_gym.shapes.settings import ShapeSettings

STRING_RADIUS = 0.001
"""Radius of a string in metres, too thin to measure."""

_SLAB = 0.03  # metres: height of a slice, in which a main stem shows as a small disc
_CELL = 0.004  # metres: side of the pixels in which discs are segmented
_MAX_SLOPE = 1.0  # metres sideways per metre up of the most slanted stem
_MAX_GAP = 0.30  # metres of a stem that may be occluded
_MIN_HEIGHT = 0.25  # metres: shortest stem
_STEM_SLACK = 0.014  # metres by which a disc may be wider than the stem: a string next to it, and noise
_STRING_SLACK = 0.006
_SAME_STEM = 0.02  # metres from a stem's axis within which discs belong to it
_CIRCLE_REACH = 0.004  # metres from a circle within which points are weighted
_MIN_WEIGHT = 5  # points that make a circle
_ITERATIONS = 10
_MIN_TAPERING = 8  # sections needed to estimate how a stem tapers
_MAX_DEVIATION = 0.4  # fraction by which a section's radius may differ from the median to be used
_ON_CIRCLE, _ROUND = 0.002, 0.45  # metres from a circle within which this fraction of a section's points makes it round
_MIN_ROUND = 1 / 3  # fraction of a chain's sections; with fewer the surface is hairy or blurred
_THINNING = 0.0004  # metres by which smooth depths and voxel means make stems thinner, on rows of both generators

Section = tuple[Array, Array]
"""Points (n, 2) and normals (n, 2) of a disc, projected along the stem onto the middle of its slice."""


class Disc(NamedTuple):
    """Cross section of a possible main stem in a slice.

    Attributes:
        slab: Number of the slice.
        center: (3,) metres, in the middle of the slice.
        slope: (2,) metres sideways per metre up.
        rows: Rows of its points.
    """

    slab: int
    center: Array
    slope: Array
    rows: npt.NDArray[np.int64]


def find_main_stems(points: Array, normals: Array, settings: ShapeSettings) -> list[Stem]:
    """Find upright and slanted stems in points that belong to neither tomatoes nor pipes.

    A slice of 3 cm of height, projected along the slope of its content, shows a stem as a disc a centimetre wide. Discs
    are linked upwards into the longest chains; a chain may skip slices in which fruit or leaves hide the stem.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        settings: All settings.

    Returns:
        Chains of capsules of kind ``main``.
    """
    return _find_upright(points, normals, "main", settings.stem_radii, _STEM_SLACK, settings.upright_tolerance)


def find_strings(points: Array, normals: Array, settings: ShapeSettings) -> list[Stem]:
    """Find the strings that hold the stems, in points without color; they are too thin to measure.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        settings: All settings.

    Returns:
        Chains of capsules of kind ``string``.
    """
    return _find_upright(points, normals, "string", (STRING_RADIUS,) * 2, _STRING_SLACK, settings.upright_tolerance)


def _find_upright(
    points: Array, normals: Array, kind: StemKind, radii: tuple[float, float], slack: float, tolerance: float
) -> list[Stem]:
    """Find stems of one kind with radii between two bounds, whose discs may be wider by ``slack`` metres."""
    if len(points) < 20:
        return []
    discs = _discs(points, normals, 2 * radii[1] + slack)
    stems: list[Stem] = []
    while len(discs) > 1:
        chain = _longest_chain(discs)
        height = chain[-1].center[2] - chain[0].center[2]
        if height < _MIN_HEIGHT or len(chain) * _SLAB < 0.5 * height:
            break
        sections = _sections(chain, points, normals)
        heights = np.array([disc.center[2] for disc in chain])
        level = [_perpendicular_section(*own) for own in zip(sections, _slopes(chain), strict=True)]
        sizes, is_round = _chain_radii(level, heights, radii)
        axis = _axis(heights, sections, sizes if is_round else None, tolerance)
        at = np.interp((axis[1:, 2] + axis[:-1, 2]) / 2, heights, sizes)
        stems += [Stem(a, b, r, kind=kind) for (a, b), r in zip(itertools.pairwise(axis), at.tolist(), strict=True)]
        discs = [d for d in discs if _distance_to_axis(d.center, axis) > _SAME_STEM]
    return stems


def _discs(points: Array, normals: Array, max_width: float) -> list[Disc]:
    slab = np.floor(points[:, 2] / _SLAB).astype(np.int64)
    upright = np.abs(normals[:, 2]) < 0.5
    low = points[:, :2].min(axis=0)
    discs = []
    for k in np.unique(slab):
        rows = np.flatnonzero((slab == k) & upright)
        cells = ((points[rows, :2] - low) / _CELL).astype(np.int64)
        image = np.zeros(cells.max(axis=0, initial=0) + 1, dtype=bool)
        image[cells[:, 0], cells[:, 1]] = True
        label, count = ndimage.label(image, structure=np.ones((3, 3)))
        own = label[cells[:, 0], cells[:, 1]]
        ends = np.cumsum(np.bincount(own, minlength=count + 1))[:-1]
        for part in np.split(rows[np.argsort(own, kind="stable")], ends):
            if len(part) < 8 or np.ptp(points[part, 2]) < 0.6 * _SLAB:
                continue
            disc = _disc(int(k), part, points)
            section = _project(points[part] - disc.center, disc.slope)
            if _extent(section)[1].max() <= max_width:
                discs.append(disc)
    return discs


def _disc(slab: int, rows: npt.NDArray[np.int64], points: Array) -> Disc:
    """Return the disc of some points of a slice, with its slope by linear least squares."""
    center = points[rows].mean(axis=0)
    offset = points[rows] - center
    slope = offset[:, :2].T @ offset[:, 2] / max(float(offset[:, 2] @ offset[:, 2]), 1e-12)
    slope *= min(1.0, _MAX_SLOPE / max(float(np.linalg.norm(slope)), 1e-12))
    middle = (slab + 0.5) * _SLAB
    return Disc(slab, np.append(center[:2] + slope * (middle - center[2]), middle), slope, rows)


def _longest_chain(discs: list[Disc]) -> list[Disc]:
    """Return the chain with the most discs, by dynamic programming upwards.

    Skipped slices cost a little, and so does leaving both the vertical and the slope of the disc below.
    """
    centers = np.array([d.center for d in discs])
    slopes = np.array([d.slope for d in discs])
    slabs = np.array([d.slab for d in discs])
    score, before = np.ones(len(discs)), np.full(len(discs), -1)
    max_rise = int(_MAX_GAP / _SLAB)
    for i in np.argsort(slabs, kind="stable"):
        rise = slabs[i] - slabs
        shift = centers[i, :2] - centers[:, :2]
        off_slope = shift - slopes * (_SLAB * rise)[:, None]
        sideways = np.minimum(np.linalg.norm(shift, axis=1), np.linalg.norm(off_slope, axis=1))
        linkable = (rise >= 1) & (rise <= max_rise) & (sideways < 0.004 + 0.3 * _SLAB * rise)
        if linkable.any():
            value = score - 0.1 * (rise - 1) - 20.0 * sideways
            value[~linkable] = -np.inf
            best = int(np.argmax(value))
            if value[best] > 0:
                score[i], before[i] = value[best] + 1.0, best
    chain = [int(np.argmax(score))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return [discs[i] for i in reversed(chain)]


def _chain_radii(sections: list[Section], heights: Array, radii: tuple[float, float]) -> tuple[Array, bool]:
    """Return the radius (k,) at each section of a chain, and whether it comes from circles.

    Circles are fitted to all sections, and a stem tapers linearly. If they are not round, the radius is half the width.
    """
    circles = [_fit_circle(points, normals, None, radii) for points, normals in sections]
    is_round = np.array([_fraction_on(*own) > _ROUND for own in zip(sections, circles, strict=True)])
    if np.count_nonzero(is_round) < _MIN_ROUND * len(sections):
        widths = [_extent(points)[1].mean() for points, _ in sections]
        return np.full(len(sections), np.clip(np.median(widths) / 2, *radii)), False
    sizes, at = np.array([circle[2] for circle in circles])[is_round] + _THINNING, heights[is_round]
    middle = float(np.median(sizes))
    if len(sizes) < _MIN_TAPERING:
        return np.full(len(sections), np.clip(middle, *radii)), True
    good = np.abs(sizes - middle) < _MAX_DEVIATION * middle
    slope, offset = np.polyfit(at[good], sizes[good], 1) if good.sum() > _MIN_TAPERING / 2 else (0.0, middle)
    return np.clip(offset + slope * heights, *np.clip([0.7 * middle, 1.4 * middle], *radii)), True


def _fraction_on(section: Section, circle: tuple[float, float, float]) -> float:
    """Return the fraction of a section's points that lie on a circle and face away from its center."""
    points, normals = section
    offset = points - circle[:2]
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    facing = (offset * normals).sum(axis=1) > 0.3 * distance
    return float(np.mean(facing & (np.abs(distance - circle[2]) < _ON_CIRCLE)))


def _extent(points: Array) -> tuple[Array, Array]:
    """Return the middle (2,) and widths (2,) of points (n, 2), between their quantiles 0.05 and 0.95."""
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    return (low + high) / 2, high - low


def _fit_circle(
    points: Array, normals: Array, radius: float | None, radii: tuple[float, float]
) -> tuple[float, float, float]:
    """Return center and radius of the circle through points (n, 2) by robust least squares; ``radius`` fixes it."""
    turned = normals - normals.mean(axis=0)
    first = float(((points - points.mean(axis=0)) * turned).sum() / max((turned**2).sum(), 1e-9))
    size = float(np.clip(first, *radii)) if radius is None else radius
    center = (points - size * normals).mean(axis=0)
    for _ in range(_ITERATIONS):
        offset = points - center
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        unit, residual = offset / distance[:, None], distance - size
        weight = tukey_weights(residual, _CIRCLE_REACH) * ((unit * normals).sum(axis=1) > 0.3)
        if weight.sum() < _MIN_WEIGHT:
            break
        jacobian = np.column_stack([-unit, -np.ones(len(unit))])
        damping = np.array([1e-3, 1e-3, 1e-3 if radius is None else 1e6])
        step = gauss_newton_step(jacobian, weight, residual, damping)
        center, size = center + step[:2], float(np.clip(size + step[2], *radii))
    return float(center[0]), float(center[1]), size


def _sections(chain: list[Disc], points: Array, normals: Array) -> list[Section]:
    """Return the section of each disc of a chain."""
    return [
        (_project(points[d.rows] - [0.0, 0.0, d.center[2]], slope), _project(normals[d.rows], slope))
        for d, slope in zip(chain, _slopes(chain), strict=True)
    ]


def _slopes(chain: list[Disc]) -> Array:
    """Return the slope (k, 2) of a chain at each of its discs."""
    centers = np.array([d.center for d in chain])
    return np.asarray(np.gradient(centers[:, :2], centers[:, 2], axis=0))


def _perpendicular_section(section: Section, slope: Array) -> Section:
    """Return a level section of a slanted stem as one across its axis: an ellipse becomes a circle."""
    steepness = float(np.linalg.norm(slope))
    if steepness < 1e-6:
        return section
    shorter = np.eye(2) - (1 - 1 / np.hypot(1.0, steepness)) * np.outer(slope, slope) / steepness**2
    return section[0] @ shorter, section[1]


def _project(vectors: Array, slope: Array) -> Array:
    """Return vectors (n, 3) projected along a slope (2,) to height zero, (n, 2)."""
    return np.asarray(vectors[:, :2] - vectors[:, 2:] * slope)


def _axis(heights: Array, sections: list[Section], radii: Array | None, tolerance: float) -> Array:
    """Return axis points (k, 3): centers of circles of known radii, or of sections, smoothed along the chain."""
    if radii is None:
        middles = np.array([_extent(points)[0] for points, _ in sections])
    else:
        middles = np.array([_fit_circle(*own, r, (r, r))[:2] for own, r in zip(sections, radii.tolist(), strict=True)])
    line = np.polynomial.polynomial.polyfit(heights, middles, 1)  # smoothing would bend the ends of a slanted stem
    straight = line[0] + heights[:, None] * line[1]
    smooth = ndimage.median_filter(middles - straight, size=(3, 1), mode="nearest")
    smooth = ndimage.uniform_filter1d(smooth, 3, axis=0, mode="nearest")
    return fit_polyline(np.column_stack([straight + smooth, heights]), tolerance)


def _distance_to_axis(point: Array, axis: Array) -> float:
    """Return the distance in metres of a point (3,) from a polyline (k, 3)."""
    return float(distance_to_capsules(point[None], axis[:-1], axis[1:], np.zeros(len(axis) - 1)).min())
