"""Tomatoes: skin-colored spheres, the most credible first, grouped into trusses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from greenhouse_gym.crop import Tomato
from greenhouse_gym.geometry import Array
from greenhouse_gym.shapes.colors import could_be_fruit_or_stem, redness
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, fit_spheres, vote

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_CREDIBLE = np.array([14.4, -7.0e3, 36.7, -26.3])
"""Logistic regression of "is a tomato" on coverage, rmse (m) and alignment, and its offset; on six simulated rows."""


class FoundTomatoes(NamedTuple):
    """Tomatoes found in a cloud, each with how credible it is, 0 to 1."""

    tomatoes: tuple[Tomato, ...]
    confidence: tuple[float, ...]


def find_tomatoes(points: Array, normals: Array, colors: Array, settings: ShapeSettings) -> FoundTomatoes:
    """Find tomatoes in a cloud.

    Args:
        points: (n, 3) metres, one per voxel of ``settings.voxel``.
        normals: (n, 3) unit vectors pointing out of the surfaces.
        colors: (n, 3) RGB in [0, 1].
        settings: All settings.

    Returns:
        Spheres with truss numbers, ripeness and confidence.
    """
    skin = np.flatnonzero(could_be_fruit_or_stem(colors, settings))
    points, normals, colors = points[skin], normals[skin], colors[skin]
    fits = choose(fit_spheres(points, normals, vote(points, normals, settings), settings), points, settings)
    trusses = group_trusses(
        np.array([f.center for f in fits]).reshape(-1, 3), np.array([f.radius for f in fits]), settings.truss_gap
    )
    return FoundTomatoes(
        tuple(
            Tomato(f.center, f.radius, truss=int(truss), ripeness=ripeness_of(colors[f.points]))
            for f, truss in zip(fits, trusses, strict=True)
        ),
        tuple(credibility(f) for f in fits),
    )


def credibility(fit: SphereFit) -> float:
    """How likely a fitted sphere is a tomato, 0 to 1, by how much of it was seen and how well that fits."""
    return float(1 / (1 + np.exp(-_CREDIBLE @ [fit.coverage, fit.rmse, fit.alignment, 1.0])))


def choose(fits: list[SphereFit], points: Array, settings: ShapeSettings) -> list[SphereFit]:
    """Keep credible fits that no better one explains: best first, each must own most of its points."""
    owned = np.zeros(len(points), dtype=bool)
    chosen: list[SphereFit] = []
    for fit in sorted(fits, key=lambda f: -credibility(f)):
        if credibility(fit) < settings.min_confidence:
            break
        own = np.count_nonzero(~owned[fit.points])
        apart = all(np.linalg.norm(fit.center - other.center) > 0.75 * (fit.radius + other.radius) for other in chosen)
        if apart and own > 0.6 * len(fit.points):
            owned[fit.points] = True
            chosen.append(fit)
    return sorted(chosen, key=lambda f: tuple(np.round(f.center[[1, 2, 0]], 3)))


def group_trusses(centers: Array, radii: Array, gap: float) -> npt.NDArray[np.int32]:
    """Truss number (n,) of each fruit: fruits whose skins are less than ``gap`` metres apart hang together."""
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1) - radii[:, None] - radii[None]
    return np.asarray(connected_components(coo_array(distance < gap), directed=False)[1], dtype=np.int32)


def ripeness_of(colors: Array) -> float:
    """Ripeness, 0 to 1, from the skin's colors (n, 3): by the median of (R - G) / (R + G), which ignores shading."""
    return float(np.round(np.interp(np.median(redness(colors)), _REDNESS, np.linspace(0, 1, len(_REDNESS))), 3))
