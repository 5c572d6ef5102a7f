"""Which tomatoes a recording could show, and which of them were found."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

from greenhouse_gym.capture.raycast import RowRaycaster
from greenhouse_gym.capture.rig import Intrinsics, Rig
from greenhouse_gym.crop import Tomato
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.plants import PlantRow


def visible_tomatoes(
    row: PlantRow, rig: Rig, world_from_station: Array, share: float = 0.30, foreground: float = 0.60
) -> npt.NDArray[np.bool_]:
    """Which tomatoes (n,) of a row a recording could show at all.

    A tomato is visible if in some frame at least ``share`` of the pixels it alone would cover show it, after the cut
    ``foreground`` metres in front of the reference camera, along the rig's forward axis.

    Args:
        row: The grown row.
        rig: The cameras.
        world_from_station: (stations, 4, 4) true poses.
        share: Of its own pixels.
        foreground: Metres.
    """
    caster = RowRaycaster.of(row)
    count = len(row.tomatoes)
    centers = np.array([t.center for t in row.tomatoes]).reshape(-1, 3)
    radii = np.array([t.radius for t in row.tomatoes])
    front = rig.cameras[rig.reference].rig_from_camera[0, 3] + foreground
    visible = np.zeros(count, dtype=bool)
    for pose in world_from_station:
        for camera in rig.cameras.values():
            world_from_camera = pose @ camera.rig_from_camera
            view = caster.look(world_from_camera, camera.intrinsics)
            in_camera = transform(invert(world_from_camera), centers)
            for i in np.flatnonzero(~visible & (in_camera[:, 2] > 2 * radii) & (in_camera[:, 2] < 2 * foreground)):
                window, alone = _silhouette(in_camera[i], float(radii[i]), camera.intrinsics)
                if not alone.any():
                    continue
                rows, columns = np.nonzero(alone & (view.shape[window] == i))
                z = view.depth[window][rows, columns].astype(np.float64)
                x = (columns + window[1].start - camera.intrinsics.cx) / camera.intrinsics.fx * z
                y = (rows + window[0].start - camera.intrinsics.cy) / camera.intrinsics.fy * z
                near = transform(camera.rig_from_camera, np.column_stack([x, y, z]))[:, 0] < front
                visible[i] = np.count_nonzero(near) >= share * np.count_nonzero(alone)
    return visible


def _silhouette(
    center: Array, radius: float, intrinsics: Intrinsics
) -> tuple[tuple[slice, slice], npt.NDArray[np.bool_]]:
    """The part of the image a sphere may cover, and which of its pixels have a ray through the sphere."""
    k = intrinsics
    reach = 1.3 * radius * max(k.fx, k.fy) / (center[2] - radius)
    u, v = k.fx * center[0] / center[2] + k.cx, k.fy * center[1] / center[2] + k.cy
    columns = slice(int(np.clip(u - reach, 0, k.width)), int(np.clip(u + reach, 0, k.width)))
    rows = slice(int(np.clip(v - reach, 0, k.height)), int(np.clip(v + reach, 0, k.height)))
    x, y = np.meshgrid(
        (np.arange(columns.start, columns.stop) - k.cx) / k.fx, (np.arange(rows.start, rows.stop) - k.cy) / k.fy
    )
    along = (x * center[0] + y * center[1] + center[2]) / (x * x + y * y + 1.0)
    nearest = (x * along - center[0]) ** 2 + (y * along - center[1]) ** 2 + (along - center[2]) ** 2
    return (rows, columns), nearest < radius**2


class Matches(NamedTuple):
    """Pairs of true and found tomatoes whose centers lie within one true radius.

    Attributes:
        true: (k,) indices of true tomatoes.
        found: (k,) indices of found ones.
        center_errors: (k,) metres.
        diameter_errors: (k,) relative.
    """

    true: npt.NDArray[np.int64]
    found: npt.NDArray[np.int64]
    center_errors: Array
    diameter_errors: Array


def match_tomatoes(true: Sequence[Tomato], found: Sequence[Tomato]) -> Matches:
    """Match tomatoes one to one with the least total distance; pairs farther apart than a true radius do not count."""
    if not true or not found:
        empty = np.zeros(0, dtype=np.int64)
        return Matches(empty, empty, np.zeros(0), np.zeros(0))
    a, b = np.array([t.center for t in true]), np.array([t.center for t in found])
    radii, sizes = np.array([t.radius for t in true]), np.array([t.radius for t in found])
    distance = np.linalg.norm(a[:, None] - b[None], axis=-1)
    i, j = linear_sum_assignment(np.minimum(distance, 1.0))
    close = distance[i, j] < radii[i]
    i, j = i[close], j[close]
    return Matches(i, j, distance[i, j], np.abs(sizes[j] / radii[i] - 1.0))
