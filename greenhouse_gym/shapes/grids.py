"""The same surfaces by several grids of voxels: what falls into one voxel is chance, and so is what is seen by it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.settings import ShapeSettings
from greenhouse_gym.shapes.surfaces import SurfaceCloud, look_at_surfaces, looked_at_finer

_SHIFT = np.array([0.0137, 0.0211, 0.0173])
"""Metres from one grid to the next, no multiple of a voxel's side."""


class Grid(NamedTuple):
    """Surfaces by one grid.

    Attributes:
        surface: One point per voxel of ``settings.voxel``.
        fine: The same with one per voxel of ``settings.fine_voxel``, where small fruit is looked for.
        shift: (3,) by which both are moved from where they are, metres.
    """

    surface: SurfaceCloud
    fine: SurfaceCloud
    shift: Array


def by_grids(whole: Cloud, surface: SurfaceCloud, settings: ShapeSettings) -> Iterator[Grid]:
    """A cloud by each of ``settings.grids`` grids.

    Args:
        whole: All of its points.
        surface: What is known of it by the first grid, without what is left out.
        settings: All settings.
    """
    # estimated normals do not tell well how thin things bend
    measured = bool((np.linalg.norm(whole.normals, axis=1) > 0.5).any())
    for k in range(settings.grids):
        shift = k * _SHIFT
        moved = replace(whole, points=whole.points + shift)
        seen = surface
        if k:
            near = replace(surface, points=surface.points + shift)
            near = looked_at_finer(near, voxel_means(moved, settings.voxel)[0], settings)
            seen = look_at_surfaces(near, settings)
        fine = looked_at_finer(seen, voxel_means(moved, settings.fine_voxel)[0], settings)
        yield Grid(seen, fine.select(np.full(len(fine), measured)), shift)
