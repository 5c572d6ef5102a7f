"""Main stems: chains of discs through slices of height."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from greenhouse_gym.crops.parts import Stem, StemKind
from greenhouse_gym.geometry import Array, distance_to_capsules
from greenhouse_gym.shapes.polylines import fitted
from greenhouse_gym.shapes.robust import gauss_newton_step, tukey_weights
from greenhouse_gym.shapes.settings import ShapeSettings

_BESIDE_STEM = 0.014  # metres by which a disc may be wider: a string beside the stem, and noise
_BESIDE_STRING = 0.006
_NEAR = 0.004  # metres from a circle within which points count for it
_FEWEST = 5  # points that make a circle
_ROUNDS = 10
_TAPERING = 8  # sections that tell how a stem tapers
_ODD = 0.4  # share by which a section's radius may differ from the others' to count
_ON_CIRCLE, _ROUND = 0.002, 0.45  # metres from a circle within which this share of a section's points makes it round
_FEWEST_ROUND = 1 / 3  # share of a chain's sections; of fewer the surface was not seen, but something hairy or blurred
_THINNED = 0.0004  # metres by which smooth depths and means over voxels make stems thinner, on rows of both generators


class Disc(NamedTuple):
    """Where a main stem may pass a slice.

    Attributes:
        slab: Number of the slice.
        center: (3,) metres, in the middle of the slice.
        lean: (2,) metres that it moves sideways per metre up.
        rows: Rows of its points.
    """

    slab: int
    center: Array
    lean: Array
    rows: npt.NDArray[np.int64]


def find_main_stems(points: Array, normals: Array, settings: ShapeSettings) -> list[Stem]:
    """Find upright and leaning stems in what is neither tomato nor pipe.

    A slice of 3 cm of height, moved along the lean of what is in it, shows a stem as a disc a centimetre wide. Discs
    are linked upwards into the longest chains; a chain may jump over slices in which fruit or leaves hide the stem.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        settings: All settings.

    Returns:
        Chains of capsules of kind ``main``.
    """
    return _upright(points, normals, "main", settings.stem_radii, _BESIDE_STEM, settings)


def find_strings(points: Array, normals: Array, settings: ShapeSettings) -> list[Stem]:
    """Find the strings that hold the stems, in what has no color; they are too thin to measure.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        settings: All settings.

    Returns:
        Chains of capsules of kind ``string``.
    """
    return _upright(points, normals, "string", (settings.string_radius,) * 2, _BESIDE_STRING, settings)


def _upright(
    points: Array, normals: Array, kind: StemKind, radii: tuple[float, float], slack: float, settings: ShapeSettings
) -> list[Stem]:
    """Stems of one kind with radii between two bounds, whose discs may be wider than that by ``slack`` metres."""
    if len(points) < 20:
        return []
    discs = _discs(points, normals, 2 * radii[1] + slack, settings)
    stems: list[Stem] = []
    while len(discs) > 1:
        chain = _longest_chain(discs, settings)
        height = chain[-1].center[2] - chain[0].center[2]
        if height < settings.min_stem or len(chain) * settings.stem_slab < 0.5 * height:
            break
        sections = _sections(chain, points, normals)
        heights = np.array([disc.center[2] for disc in chain])
        upright = [_upright_section(*own) for own in zip(sections, _leans(chain), strict=True)]
        sizes, is_round = _chain_radii(upright, heights, radii)
        axis = _axis(chain, sections, sizes if is_round else None, settings)
        at = np.interp((axis[1:, 2] + axis[:-1, 2]) / 2, heights, sizes)
        stems += [Stem(a, b, r, kind=kind) for (a, b), r in zip(itertools.pairwise(axis), at.tolist(), strict=True)]
        discs = [d for d in discs if _beside(d.center, axis) > 0.02]
    return stems


def _discs(points: Array, normals: Array, widest: float, settings: ShapeSettings) -> list[Disc]:
    slab = np.floor(points[:, 2] / settings.stem_slab).astype(np.int64)
    upright = np.abs(normals[:, 2]) < 0.5
    low = points[:, :2].min(axis=0)
    cell = 0.004
    discs = []
    for k in np.unique(slab):
        rows = np.flatnonzero((slab == k) & upright)
        cells = ((points[rows, :2] - low) / cell).astype(np.int64)
        image = np.zeros(cells.max(axis=0, initial=0) + 1, dtype=bool)
        image[cells[:, 0], cells[:, 1]] = True
        label, count = ndimage.label(image, structure=np.ones((3, 3)))
        own = label[cells[:, 0], cells[:, 1]]
        for part in np.split(
            rows[np.argsort(own, kind="stable")], np.cumsum(np.bincount(own, minlength=count + 1))[:-1]
        ):
            if len(part) < 8 or np.ptp(points[part, 2]) < 0.6 * settings.stem_slab:
                continue
            disc = _disc(int(k), part, points, settings)
            section = _along(points[part] - disc.center, disc.lean)
            if _extent(section)[1].max() <= widest:
                discs.append(disc)
    return discs


def _disc(slab: int, rows: npt.NDArray[np.int64], points: Array, settings: ShapeSettings) -> Disc:
    """The disc that some points of a slice make, and how it leans by linear least squares."""
    center = points[rows].mean(axis=0)
    away = points[rows] - center
    lean = away[:, :2].T @ away[:, 2] / max(float(away[:, 2] @ away[:, 2]), 1e-12)
    lean *= min(1.0, settings.stem_lean / max(float(np.linalg.norm(lean)), 1e-12))
    middle = (slab + 0.5) * settings.stem_slab
    return Disc(slab, np.append(center[:2] + lean * (middle - center[2]), middle), lean, rows)


def _longest_chain(discs: list[Disc], settings: ShapeSettings) -> list[Disc]:
    """The chain with the most discs, by dynamic programming upwards.

    Hidden slices cost a little, and so does leaving both the vertical and the line along which the disc below leans.
    """
    centers = np.array([d.center for d in discs])
    leans = np.array([d.lean for d in discs])
    slabs = np.array([d.slab for d in discs])
    order = np.argsort(slabs, kind="stable")
    score, before = np.ones(len(discs)), np.full(len(discs), -1)
    furthest = int(settings.stem_gap / settings.stem_slab)
    for i in order:
        rise = slabs[i] - slabs
        moved = centers[i, :2] - centers[:, :2]
        leaning = moved - leans * (settings.stem_slab * rise)[:, None]
        sideways = np.minimum(np.linalg.norm(moved, axis=1), np.linalg.norm(leaning, axis=1))
        able = (rise >= 1) & (rise <= furthest) & (sideways < 0.004 + 0.3 * settings.stem_slab * rise)
        if able.any():
            value = score - 0.1 * (rise - 1) - 20.0 * sideways
            value[~able] = -np.inf
            best = int(np.argmax(value))
            if value[best] > 0:
                score[i], before[i] = value[best] + 1.0, best
    chain = [int(np.argmax(score))]
    while before[chain[-1]] >= 0:
        chain.append(int(before[chain[-1]]))
    return [discs[i] for i in reversed(chain)]


def _chain_radii(sections: list[tuple[Array, Array]], heights: Array, radii: tuple[float, float]) -> tuple[Array, bool]:
    """The radius (k,) at each section of a chain, and whether circles tell it.

    Circles are fitted to all sections, and a stem tapers evenly. Of what is not round the radius is half its width.
    """
    circles = [_circle(points, normals, None, radii) for points, normals in sections]
    is_round = np.array([_share_on(*own) > _ROUND for own in zip(sections, circles, strict=True)])
    if np.count_nonzero(is_round) < _FEWEST_ROUND * len(sections):
        widths = [_extent(points)[1].mean() for points, _ in sections]
        return np.full(len(sections), np.clip(np.median(widths) / 2, *radii)), False
    rounds, at = np.array([circle[2] for circle in circles])[is_round] + _THINNED, heights[is_round]
    middle = float(np.median(rounds))
    if len(rounds) < _TAPERING:
        return np.full(len(sections), np.clip(middle, *radii)), True
    good = np.abs(rounds - middle) < _ODD * middle
    slope, offset = np.polyfit(at[good], rounds[good], 1) if good.sum() > _TAPERING / 2 else (0.0, middle)
    return np.clip(offset + slope * heights, *np.clip([0.7 * middle, 1.4 * middle], *radii)), True


def _share_on(section: tuple[Array, Array], circle: tuple[float, float, float]) -> float:
    """The share of a section's points that lie on a circle and face away from its center."""
    points, normals = section
    away = points - circle[:2]
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    facing = (away * normals).sum(axis=1) > 0.3 * distance
    return float(np.mean(facing & (np.abs(distance - circle[2]) < _ON_CIRCLE)))


def _extent(points: Array) -> tuple[Array, Array]:
    """Middle (2,) and widths (2,) of points (n, 2), but for a few stray ones."""
    low, high = np.quantile(points, (0.05, 0.95), axis=0)
    return (low + high) / 2, high - low


def _circle(
    points: Array, normals: Array, radius: float | None, radii: tuple[float, float]
) -> tuple[float, float, float]:
    """Center and radius of the circle through a section's points (n, 2), by robust least squares; or of one radius."""
    turned = normals - normals.mean(axis=0)
    first = float(((points - points.mean(axis=0)) * turned).sum() / max((turned**2).sum(), 1e-9))
    size = float(np.clip(first, *radii)) if radius is None else radius
    center = (points - size * normals).mean(axis=0)
    for _ in range(_ROUNDS):
        away = points - center
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        unit, off = away / distance[:, None], distance - size
        weight = tukey_weights(off, _NEAR) * ((unit * normals).sum(axis=1) > 0.3)
        if weight.sum() < _FEWEST:
            break
        jacobian = np.column_stack([-unit, -np.ones(len(unit))])
        held = np.array([1e-3, 1e-3, 1e-3 if radius is None else 1e6])
        step = gauss_newton_step(jacobian, weight, off, held)
        center, size = center + step[:2], float(np.clip(size + step[2], *radii))
    return float(center[0]), float(center[1]), size


def _sections(chain: list[Disc], points: Array, normals: Array) -> list[tuple[Array, Array]]:
    """For each disc its points (n, 2) and normals (n, 2), moved along the chain onto the middle of the slice."""
    return [
        (_along(points[d.rows] - [0.0, 0.0, d.center[2]], lean), _along(normals[d.rows], lean))
        for d, lean in zip(chain, _leans(chain), strict=True)
    ]


def _leans(chain: list[Disc]) -> Array:
    """How a chain leans (k, 2) at each of its discs."""
    centers = np.array([d.center for d in chain])
    return np.asarray(np.gradient(centers[:, :2], centers[:, 2], axis=0))


def _upright_section(section: tuple[Array, Array], lean: Array) -> tuple[Array, Array]:
    """A level section of what leans as one across its axis: an ellipse becomes a circle."""
    slope = float(np.linalg.norm(lean))
    if slope < 1e-6:
        return section
    shorter = np.eye(2) - (1 - 1 / np.hypot(1.0, slope)) * np.outer(lean, lean) / slope**2
    return section[0] @ shorter, section[1]


def _along(vectors: Array, lean: Array) -> Array:
    """Vectors (n, 3) moved along a lean (2,) to height zero, (n, 2)."""
    return np.asarray(vectors[:, :2] - vectors[:, 2:] * lean)


def _axis(
    chain: list[Disc], sections: list[tuple[Array, Array]], radii: Array | None, settings: ShapeSettings
) -> Array:
    """Axis points (k, 3): the middles of circles of known radii (k,), or of sections, smoothed along the chain."""
    height = np.array([d.center[2] for d in chain])
    if radii is None:
        middles = np.array([_extent(points)[0] for points, _ in sections])
    else:
        middles = np.array([_circle(*own, r, (r, r))[:2] for own, r in zip(sections, radii.tolist(), strict=True)])
    line = np.polynomial.polynomial.polyfit(height, middles, 1)  # smoothing would bend the ends of a leaning stem
    straight = line[0] + height[:, None] * line[1]
    smooth = ndimage.median_filter(middles - straight, size=(3, 1), mode="nearest")
    smooth = ndimage.uniform_filter1d(smooth, 3, axis=0, mode="nearest")
    return fitted(np.column_stack([straight + smooth, height]), settings.upright_tolerance)


def _beside(point: Array, axis: Array) -> float:
    """Distance in metres of a point (3,) from a polyline (k, 3)."""
    return float(distance_to_capsules(point[None], axis[:-1], axis[1:], np.zeros(len(axis) - 1)).min())
