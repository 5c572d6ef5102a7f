"""Points of a cloud that are no surface: pixels without a reading, and points far from all others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from greenhouse_gym.build.scans.cloud_files import RawCloud
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import group_sizes

_SAMPLES = 2000  # points among which repeated positions are searched
_MIN_REPEATS = 5  # of the samples at one position, where sensors write one for every missing reading
_FAR = 4.0  # median distances from the middle of the cloud within which no point is a stray
_SMALL = 0.1  # fraction of the points, of groups of strays


def without_strays(cloud: RawCloud) -> RawCloud:
    """Return a cloud without points that are no surface, with sentences on them.

    Some sensors write one position, mostly the origin, for all pixels without a reading. Strays are small groups far
    from the rest, such as readings of 65.535 m.
    """
    points = cloud.points
    kept = np.asarray(np.isfinite(points).all(axis=1))
    notes = [f"{np.count_nonzero(~kept)} points have no finite position and were left out"] if not kept.all() else []
    for position in _repeated(points[kept]):
        missing = kept & (points == position).all(axis=1)
        if missing.any():
            kept = kept & ~missing
            where = ", ".join(f"{value:g}" for value in position)
            notes.append(f"{np.count_nonzero(missing)} points at ({where}) are missing readings and were left out")
    strays, distance = _strays(points[kept])
    if strays.any():
        notes.append(
            f"{np.count_nonzero(strays)} of {len(points)} points lie far from the others, up to {distance:.3g} units "
            "of the file, and were left out"
        )
        kept[kept] = ~strays
    if kept.all():
        return cloud
    colors, normals = (None if each is None else each[kept] for each in (cloud.colors, cloud.normals))
    return replace(cloud, points=points[kept], colors=colors, normals=normals, notes=(*cloud.notes, *notes))


def _repeated(points: Array) -> Array:
    """Return the origin and the positions (k, 3) that many points share."""
    positions, counts = np.unique(points[:: len(points) // _SAMPLES + 1], axis=0, return_counts=True)
    return np.concatenate([np.zeros((1, 3)), positions[counts >= _MIN_REPEATS]])


def _strays(points: Array) -> tuple[npt.NDArray[np.bool_], float]:
    """Return which points (n, 3) are strays, and how far the farthest of them is from the middle of the others."""
    none = np.zeros(len(points), dtype=bool)
    if not len(points):
        return none, 0.0
    with np.errstate(over="ignore"):
        distance = np.abs(points - np.median(points, axis=0)).max(axis=1)
    reach = float(np.median(distance))
    far = distance > _FAR * reach
    if reach == 0 or not far.any():
        return none, 0.0
    strays = far & (group_sizes(points, reach) < _SMALL * len(points))
    return strays, float(distance[strays].max(initial=0.0))
