"""Stems: main stems as chains of discs through slices of height, thin stems as greedy capsules."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial import cKDTree

from greenhouse_gym.crop import Stem, StemKind, Tomato
from greenhouse_gym.geometry import Array, distance_to_capsules
from greenhouse_gym.shapes.settings import ShapeSettings


class Disc(NamedTuple):
    """Where a main stem may pass a slice: slab number, (3,) center on the axis, rows of its points."""

    slab: int
    center: Array
    rows: npt.NDArray[np.int64]


# -- main stems -------------------------------------------------------------------------------------------------------


def find_main_stems(points: Array, normals: Array, settings: ShapeSettings) -> list[Stem]:
    """Find near-vertical stems in what is not tomato.

    A slice of 3 cm of height shows a stem as a disc a centimetre wide. Discs are linked upwards into the longest
    chains; a chain may jump over slices in which fruit or leaves hide the stem.

    Args:
        points: (n, 3) metres.
        normals: (n, 3) unit vectors.
        settings: All settings.

    Returns:
        Chains of capsules of kind ``main``.
    """
    if len(points) < 20:
        return []
    discs = _discs(points, normals, settings)
    stems: list[Stem] = []
    while len(discs) > 1:
        chain = _longest_chain(discs, settings)
        height = chain[-1].center[2] - chain[0].center[2]
        if height < settings.min_stem or len(chain) * settings.stem_slab < 0.5 * height:
            break
        radius = _chain_radius(chain, points, normals, settings)
        axis = _axis(chain, points, normals, radius)
        stems += [Stem(a, b, radius, kind="main") for a, b in itertools.pairwise(axis)]
        discs = [d for d in discs if _beside(d.center, axis) > 0.02]
    return stems


def _discs(points: Array, normals: Array, settings: ShapeSettings) -> list[Disc]:
    slab = np.floor(points[:, 2] / settings.stem_slab).astype(np.int64)
    upright = np.abs(normals[:, 2]) < 0.5
    low = points[:, :2].min(axis=0)
    cell = 0.004
    widest = 2 * settings.stem_radii[1] + 0.014  # a string beside the stem, and noise
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
            if len(part) < 8:
                continue
            cloud = points[part]
            if np.ptp(cloud[:, :2], axis=0).max() > widest or np.ptp(cloud[:, 2]) < 0.6 * settings.stem_slab:
                continue
            center = cloud.mean(axis=0)
            center[2] = (k + 0.5) * settings.stem_slab
            discs.append(Disc(int(k), center, part))
    return discs


def _longest_chain(discs: list[Disc], settings: ShapeSettings) -> list[Disc]:
    """The chain with the most discs, by dynamic programming upwards; hidden slices cost a little."""
    centers = np.array([d.center for d in discs])
    slabs = np.array([d.slab for d in discs])
    order = np.argsort(slabs, kind="stable")
    score, before = np.ones(len(discs)), np.full(len(discs), -1)
    furthest = int(settings.stem_gap / settings.stem_slab)
    for i in order:
        rise = slabs[i] - slabs
        sideways = np.linalg.norm(centers[:, :2] - centers[i, :2], axis=1)
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


def _chain_radius(chain: list[Disc], points: Array, normals: Array, settings: ShapeSettings) -> float:
    """The radius r for which ``point - r * normal`` scatters least within the discs (linear least squares)."""
    spread = square = 0.0
    for disc in chain:
        p = points[disc.rows, :2] - points[disc.rows, :2].mean(axis=0)
        n = normals[disc.rows, :2] - normals[disc.rows, :2].mean(axis=0)
        spread += float((p * n).sum())
        square += float((n * n).sum())
    return float(np.clip(spread / max(square, 1e-9), *settings.stem_radii))


def _axis(chain: list[Disc], points: Array, normals: Array, radius: float) -> Array:
    """Axis points (k, 3): the discs' points moved inwards by the radius, smoothed along the chain."""
    axis = np.array([d.center for d in chain])
    axis[:, :2] = [(points[d.rows, :2] - radius * normals[d.rows, :2]).mean(axis=0) for d in chain]
    smooth = ndimage.median_filter(axis[:, :2], size=(5, 1), mode="nearest")
    axis[:, :2] = ndimage.uniform_filter1d(smooth, 3, axis=0, mode="nearest")
    keep = np.arange(len(axis)) % 3 == 0  # a knot every 9 cm follows the sway of a stem to a millimetre
    keep[-1] = True
    return axis[keep]


def _beside(point: Array, axis: Array) -> float:
    """Distance in metres of a point (3,) from a polyline (k, 3)."""
    return float(distance_to_capsules(point[None], axis[:-1], axis[1:], np.zeros(len(axis) - 1)).min())


# -- thin stems -------------------------------------------------------------------------------------------------------


def find_thin_stems(
    points: Array, normals: Array, tomatoes: tuple[Tomato, ...], settings: ShapeSettings
) -> tuple[list[Stem], npt.NDArray[np.bool_]]:
    """Find peduncles and pedicels: thin straight pieces near the fruit.

    Args:
        points: (n, 3) what is neither tomato nor main stem, metres.
        normals: (n, 3) unit vectors.
        tomatoes: The fruit found so far.
        settings: All settings.

    Returns:
        The pieces, and which points (n,) they explain.
    """
    explained = np.zeros(len(points), dtype=bool)
    stems: list[Stem] = []
    if not tomatoes or not len(points):
        return stems, explained
    fruit = cKDTree(np.array([t.center for t in tomatoes]))
    reach = max(t.radius for t in tomatoes) + 0.10
    near_fruit = np.flatnonzero(fruit.query(points)[0] < reach)
    if len(near_fruit) < 10:
        return stems, explained
    tree = cKDTree(points[near_fruit])
    line = _lines(points[near_fruit], tree, settings)
    open_rows = line.copy()
    for seed in np.argsort(points[near_fruit][:, 2], kind="stable")[::-1]:
        if not open_rows[seed]:
            continue
        own = np.array(tree.query_ball_point(points[near_fruit[seed]], settings.thin_length / 2), dtype=np.int64)
        own = own[open_rows[own]]
        piece = _thin_piece(points[near_fruit[own]], normals[near_fruit[own]], fruit, tomatoes, settings)
        open_rows[seed] = False
        if piece is None:
            continue
        inside = distance_to_capsules(points[near_fruit[own]], piece.start, piece.end, piece.radius)[:, 0] < 0.004
        open_rows[own[inside]] = False
        explained[near_fruit[own[inside]]] = True
        stems.append(piece)
    return stems, explained


def _lines(points: Array, tree: cKDTree, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which points (n,) lie on something long and thin: the spread of their neighbours has one large axis."""
    _, rows = tree.query(points, k=min(40, len(points)), distance_upper_bound=0.015)
    found = rows < len(points)
    cloud = points[np.where(found, rows, 0)]
    weight = found[..., None] / np.maximum(found.sum(axis=1), 1)[:, None, None]
    centered = (cloud - (weight * cloud).sum(axis=1, keepdims=True)) * np.sqrt(weight)
    values = np.linalg.eigvalsh(np.einsum("nki,nkj->nij", centered, centered))
    thickness = np.sqrt(np.maximum(values[:, 1], 0.0))
    return (found.sum(axis=1) >= 8) & (values[:, 1] < 0.2 * values[:, 2]) & (thickness < settings.thin_radii[1])


def _thin_piece(
    cloud: Array, normals: Array, fruit: cKDTree, tomatoes: tuple[Tomato, ...], settings: ShapeSettings
) -> Stem | None:
    """One capsule along the longest axis of a few points, if they are thin enough."""
    if len(cloud) < 8:
        return None
    center = cloud.mean(axis=0)
    _, _, axes = np.linalg.svd(cloud - center, full_matrices=False)
    along = (cloud - center) @ axes[0]
    across = (cloud - center) - along[:, None] * axes[0]
    width = float(np.quantile(np.linalg.norm(across, axis=1), 0.9))
    if np.ptp(along) < 0.012 or width > settings.thin_radii[1]:
        return None
    flat = normals - (normals @ axes[0])[:, None] * axes[0]
    spread, square = ((across - across.mean(0)) * (flat - flat.mean(0))).sum(), ((flat - flat.mean(0)) ** 2).sum()
    radius = float(np.clip(spread / max(square, 1e-9), *settings.thin_radii))
    center = center - radius * flat.mean(axis=0)  # only the near side is seen; the axis lies behind it
    ends = center + np.outer([along.min(), along.max()], axes[0])
    gap = min(
        float(np.linalg.norm(end - tomatoes[k].center) - tomatoes[k].radius)
        for end, k in zip(ends, fruit.query(ends)[1], strict=True)
    )
    kind: StemKind = "pedicel" if gap < 0.008 and np.ptp(along) < 0.03 else "peduncle"
    return Stem(ends[0], ends[1], radius, kind=kind)
