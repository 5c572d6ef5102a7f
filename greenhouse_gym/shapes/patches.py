"""Cells of a cloud that belong together: flat patches of smooth surfaces, and lumps of what lies near each other."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.settings import ShapeSettings

Rows = npt.NDArray[np.int64]

_SEEDS = 40  # cells of a surface whose planes are tried


def flat_patches(centers: Array, facing: Array, settings: ShapeSettings) -> list[Rows]:
    """Rows of the cells of each flat patch: neighbors that face alike and lie near one plane.

    From every smooth surface the largest flat part is taken off, again and again, until only crumbs are left.

    Args:
        centers: (n, 3) where the points of each cell are in the mean, metres.
        facing: (n, 3) their mean unit normals.
        settings: All settings.
    """
    pairs = cKDTree(centers).query_pairs(1.8 * settings.clutter_cell, output_type="ndarray")
    one, two = pairs.T
    apart = centers[two] - centers[one]
    off_plane = np.abs((apart * (facing[one] + facing[two])).sum(axis=1)) / 2
    smooth = (facing[one] * facing[two]).sum(axis=1) > settings.clutter_facing
    smooth &= off_plane < 0.5 * np.linalg.norm(apart, axis=1) + settings.clutter_cell / 5
    links = _links(len(centers), pairs[smooth])
    surfaces = _connected(links, np.arange(len(centers)), settings.min_patch_cells)
    patches = []
    while surfaces:
        rows = surfaces.pop()
        patch = _connected(links, rows[_in_best_plane(centers[rows], facing[rows], settings)], 1)[0]
        if len(patch) >= settings.min_patch_cells:
            patches.append(patch)
        surfaces += _connected(links, np.setdiff1d(rows, patch), settings.min_patch_cells)
    return patches


def lumps(centers: Array, settings: ShapeSettings) -> list[Rows]:
    """Rows of the cells (n, 3) of each lump: what lies nearer together than the gap between different things."""
    if not len(centers):
        return []
    pairs = cKDTree(centers).query_pairs(settings.clutter_gap, output_type="ndarray")
    return _connected(_links(len(centers), pairs), np.arange(len(centers)), settings.min_lump_cells)


def _in_best_plane(centers: Array, facing: Array, settings: ShapeSettings) -> npt.NDArray[np.bool_]:
    """Which cells (n,) lie in the plane that holds most of them: through one of them first, then fitted to its own."""
    seeds = np.linspace(0, len(centers) - 1, min(len(centers), _SEEDS)).astype(int)
    height = facing[seeds] @ centers.T - (facing[seeds] * centers[seeds]).sum(axis=1)[:, None]
    held = (np.abs(height) < settings.clutter_flat) & (facing[seeds] @ facing.T > settings.clutter_aligned)
    best = held[np.argmax(held.sum(axis=1))]
    middle = centers[best].mean(axis=0)
    normal = np.linalg.svd(centers[best] - middle, full_matrices=False)[2][-1]
    fitted = np.abs((centers - middle) @ normal) < settings.clutter_flat
    fitted &= np.abs(facing @ normal) > settings.clutter_aligned
    return np.asarray(fitted if np.count_nonzero(fitted) > np.count_nonzero(best) else best)


def _links(count: int, pairs: Rows) -> csr_array:
    return coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def _connected(links: csr_array, rows: Rows, least: int) -> list[Rows]:
    """The connected parts of some rows of a graph that have at least so many, largest first."""
    label = connected_components(links[rows][:, rows], directed=False)[1]
    parts = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    return [rows[part] for part in sorted(parts, key=len, reverse=True) if len(part) >= least]
