"""Segmentation of a cloud's cells into flat patches of smooth surfaces and into clusters of near cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from greenhouse_gym.geometry import Array

Rows = npt.NDArray[np.int64]

CELL = 0.005
"""Side in metres of the cells that boxes are fitted to."""

_SMOOTH = 0.9  # cosine between the normals of neighbors on one smooth surface
_ALIGNED = 0.8  # cosine between the normals of a flat patch's cells and the plane's
_MIN_PATCH_CELLS = 30  # smaller patches are no leaves
_MAX_GAP = 0.012  # metres between cells of one cluster
_MAX_PLANES = 40  # cells of a surface whose planes are tried


def flat_patches(centers: Array, normals: Array, flatness: float) -> list[Rows]:
    """Return the rows of the cells of each flat patch: neighbors with similar normals near one plane.

    The largest flat part is removed from every smooth surface until only small pieces are left.

    Args:
        centers: (n, 3) mean point of each cell, metres.
        normals: (n, 3) mean unit normal of each cell.
        flatness: Largest distance of a cell from its plane, metres.
    """
    pairs = cKDTree(centers).query_pairs(1.8 * CELL, output_type="ndarray")
    one, two = pairs.T
    apart = centers[two] - centers[one]
    off_plane = np.abs((apart * (normals[one] + normals[two])).sum(axis=1)) / 2
    smooth = (normals[one] * normals[two]).sum(axis=1) > _SMOOTH
    smooth &= off_plane < 0.5 * np.linalg.norm(apart, axis=1) + CELL / 5
    links = _links(len(centers), pairs[smooth])
    surfaces = _connected(links, np.arange(len(centers)), _MIN_PATCH_CELLS)
    patches = []
    while surfaces:
        rows = surfaces.pop()
        patch = _connected(links, rows[_in_best_plane(centers[rows], normals[rows], flatness)], 1)[0]
        if len(patch) >= _MIN_PATCH_CELLS:
            patches.append(patch)
        surfaces += _connected(links, np.setdiff1d(rows, patch), _MIN_PATCH_CELLS)
    return patches


def clusters(centers: Array, min_cells: int) -> list[Rows]:
    """Return the rows of the cells (n, 3) of each cluster of at least ``min_cells`` cells."""
    if not len(centers):
        return []
    pairs = cKDTree(centers).query_pairs(_MAX_GAP, output_type="ndarray")
    return _connected(_links(len(centers), pairs), np.arange(len(centers)), min_cells)


def _in_best_plane(centers: Array, normals: Array, flatness: float) -> npt.NDArray[np.bool_]:
    """Return which cells (n,) lie in the plane through one cell that contains most cells, after a fit to these."""
    seeds = np.linspace(0, len(centers) - 1, min(len(centers), _MAX_PLANES)).astype(int)
    height = normals[seeds] @ centers.T - (normals[seeds] * centers[seeds]).sum(axis=1)[:, None]
    inside = (np.abs(height) < flatness) & (normals[seeds] @ normals.T > _ALIGNED)
    best = inside[np.argmax(inside.sum(axis=1))]
    middle = centers[best].mean(axis=0)
    normal = np.linalg.svd(centers[best] - middle, full_matrices=False)[2][-1]
    fitted = np.abs((centers - middle) @ normal) < flatness
    fitted &= np.abs(normals @ normal) > _ALIGNED
    return np.asarray(fitted if np.count_nonzero(fitted) > np.count_nonzero(best) else best)


def _links(count: int, pairs: Rows) -> csr_array:
    return coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()


def _connected(links: csr_array, rows: Rows, min_size: int) -> list[Rows]:
    """Return the connected parts of some rows of a graph with at least ``min_size`` rows, largest first."""
    label = connected_components(links[rows][:, rows], directed=False)[1]
    parts = np.split(np.argsort(label, kind="stable"), np.cumsum(np.bincount(label))[:-1])
    return [rows[part] for part in sorted(parts, key=len, reverse=True) if len(part) >= min_size]
