"""Tomatoes: skin-colored spheres, the most credible first, grouped into trusses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from greenhouse_gym.crop import Tomato
from greenhouse_gym.geometry import Array, Sphere
from greenhouse_gym.shapes.colors import could_be_fruit_or_stem, redness
from greenhouse_gym.shapes.second_look import look_again
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.spheres import SphereFit, fit_spheres, vote

_REDNESS = np.array([-0.12, 0.07, 0.34, 0.77])
"""(R - G) / (R + G) of the skin at ripeness 0, 1/3, 2/3, 1: green, turning, orange, red."""

_CREDIBLE = np.array([14.4, -7.0e3, 36.7, -26.3])
"""Logistic regression of "is a tomato" on coverage, rmse (m) and alignment, and its offset; on six simulated rows."""

_CREDIBLE_BESIDE = np.array([1.43, 2.5, -5.64e3, 2.98, -76.9, -9.67, 7.71])
"""The same for spheres of the size of their truss: on the logarithms of the number of points and of coverage, on rmse
(m), alignment, gap (m) and difference in redness to the nearest tomato, and its offset; on the same rows."""

_SURE = 0.8
"""How credible a tomato must be for others to be looked for beside it."""

_LIKELY = 0.5
"""How credible these others must be: near a truss much is round."""


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
    fits = fit_spheres(points, normals, vote(points, normals, settings), settings)
    credible = [credibility(fit) for fit in fits]
    sure = choose(fits, credible, len(points), _SURE)
    tones = redness(colors)
    for fit in look_again(points, normals, tones, sure, group_trusses(sure, settings.truss_gap), settings):
        if (likely := credibility_beside(fit, sure, tones)) > _LIKELY:
            fits.append(fit)
            credible.append(likely)
    found = choose(fits, credible, len(points), settings.min_confidence)
    confidence = dict(zip(fits, credible, strict=True))
    return FoundTomatoes(
        tuple(
            Tomato(fit.center, fit.radius, truss=int(truss), ripeness=ripeness_of(colors[fit.points]))
            for fit, truss in zip(found, group_trusses(found, settings.truss_gap), strict=True)
        ),
        tuple(confidence[fit] for fit in found),
    )


def credibility(fit: SphereFit) -> float:
    """How likely a fitted sphere is a tomato, 0 to 1, by how much of it was seen and how well that fits."""
    return float(1 / (1 + np.exp(-_CREDIBLE @ [fit.coverage, fit.rmse, fit.alignment, 1.0])))


def credibility_beside(fit: SphereFit, others: list[SphereFit], tones: Array) -> float:
    """The same for one of the size of its truss.

    Args:
        fit: The sphere, fitted to what the others leave unexplained.
        others: Tomatoes, at least one.
        tones: (n,) redness of all points.
    """
    centers, radii = _centers_and_radii(others)
    gaps = np.linalg.norm(centers - fit.center, axis=1) - radii - fit.radius
    nearest = others[int(gaps.argmin())]
    unlike = abs(np.median(tones[fit.points]) - np.median(tones[nearest.points]))
    seen = [np.log(len(fit.points)), np.log(fit.coverage), fit.rmse, fit.alignment]
    return float(1 / (1 + np.exp(-_CREDIBLE_BESIDE @ [*seen, max(gaps.min(), 0.0), unlike, 1.0])))


def choose(fits: list[SphereFit], credible: list[float], count: int, least: float) -> list[SphereFit]:
    """Keep credible fits that no better one explains: best first, each must own most of its points.

    Args:
        fits: Spheres among the same points.
        credible: How credible each is, 0 to 1.
        count: Number of the points.
        least: How credible a fit must be.
    """
    owned = np.zeros(count, dtype=bool)
    centers, radii = _centers_and_radii(fits)
    chosen: list[int] = []
    for k in np.argsort(-np.array(credible), kind="stable").tolist():
        if credible[k] < least:
            break
        distance = np.linalg.norm(centers[chosen] - centers[k], axis=1)
        apart = (distance > 0.75 * (radii[chosen] + radii[k])).all()
        if apart and np.count_nonzero(~owned[fits[k].points]) > 0.6 * len(fits[k].points):
            owned[fits[k].points] = True
            chosen.append(k)
    return sorted([fits[k] for k in chosen], key=lambda f: tuple(np.round(f.center[[1, 2, 0]], 3)))


def group_trusses(fruits: Sequence[Sphere], gap: float) -> npt.NDArray[np.int32]:
    """Truss number (n,) of each fruit: fruits whose skins are less than ``gap`` metres apart hang together."""
    centers, radii = _centers_and_radii(fruits)
    distance = np.linalg.norm(centers[:, None] - centers[None], axis=-1) - radii[:, None] - radii[None]
    return np.asarray(connected_components(coo_array(distance < gap), directed=False)[1], dtype=np.int32)


def ripeness_of(colors: Array) -> float:
    """Ripeness, 0 to 1, from the skin's colors (n, 3): by the median of (R - G) / (R + G), which ignores shading."""
    return float(np.round(np.interp(np.median(redness(colors)), _REDNESS, np.linspace(0, 1, len(_REDNESS))), 3))


def _centers_and_radii(spheres: Sequence[Sphere]) -> tuple[Array, Array]:
    """(n, 3) and (n,)."""
    return np.array([s.center for s in spheres]).reshape(-1, 3), np.array([s.radius for s in spheres])
