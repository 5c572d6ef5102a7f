"""Drop stray points, and guess what a file does not state: unit, upward direction, side of the scanner.

All guesses use the points alone and do not depend on how the cloud is rotated, mirrored or scaled.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.build.scans.cloud_files import RawCloud
from greenhouse_gym.build.scans.cloud_formats.las import FOOT, SURVEY_FOOT
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.geometry.point_clouds import group_sizes

_MIN_REPEATS = 5  # of the samples at one position, where sensors write one for every missing reading
_FAR = 4.0  # median distances from the middle of the cloud within which no point is a stray
_SMALL = 0.1  # fraction of the points, of groups of strays

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": FOOT, "us-ft": SURVEY_FOOT}
"""Metres per unit."""

_GUESSED = ("m", "cm", "mm")
_EXTENT, _SPACING = 2.0, 0.0015  # typical length of a scanned row and distance between points, m
_DECADES = 0.5  # standard deviation of both, in powers of ten
_RARE = {"cm": 3.0}  # prior cost of rare units
_UNSURE = 4.0  # difference in cost below which the choice of a unit is uncertain
_SAMPLES = 2000
_ROD_REACH = 0.03  # m
_ROD = 0.8  # 1 - ratio of the second to the first variance
_SNAP = np.cos(np.deg2rad(12.0))  # directions this close to an axis of the file are snapped to it
_FACING = 0.15  # mean of the unit normals across the row below which it was scanned from all sides
_FLAT, _TABLE = 0.01, 0.3  # distance from a plane (m), and fraction of the points that a table or floor holds
_ELSEWHERE = 0.005  # fraction of the points that need not lie in front of a camera
_LONG = 1.3  # minimum ratio of length to depth for the longer side to be the row's direction


def without_strays(cloud: RawCloud) -> RawCloud:
    """Return a cloud without stray points and missing readings, and sentences on what was dropped.

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


class Guess(NamedTuple):
    """A guess and a sentence on its confidence."""

    value: Array
    note: str


class Unit(NamedTuple):
    """Metres per unit and a sentence on its confidence."""

    metres: float
    note: str


def spacing(points: Array) -> float:
    """Return the median distance of points (n, 3) from their nearest neighbor at another position."""
    tree = cKDTree(points)
    nearest = tree.query(_subset(points), k=4)[0]
    nearest[nearest == 0] = np.inf
    closest = nearest.min(axis=1)
    return float(np.median(closest[np.isfinite(closest)])) if np.isfinite(closest).any() else 0.0


def guess_unit(points: Array) -> Unit:
    """Guess the unit with which points (n, 3) form a scan of typical size and density."""
    centered = _subset(points) - np.median(points, axis=0)
    axes = np.linalg.svd(centered, full_matrices=False)[2]
    extent = float(np.ptp(np.quantile(centered @ axes[0], [0.01, 0.99])))
    apart = max(spacing(points), 1e-12)

    def cost(name: str) -> float:
        size = np.log10(max(extent, 1e-12) * UNITS[name] / _EXTENT) / _DECADES
        density = np.log10(apart * UNITS[name] / _SPACING) / _DECADES
        return float(size**2 + density**2 + _RARE.get(name, 0.0))

    best, *others = sorted(_GUESSED, key=cost)
    size = f"{extent * UNITS[best]:.3g} m long with points {1e3 * apart * UNITS[best]:.2g} mm apart"
    note = f"units: taken as {best}, which makes it {size}"
    possible = [name for name in others if best in _RARE or cost(name) - cost(best) < _UNSURE]
    if possible:
        note += f"; they might be {' or '.join(possible)}: give the units to be sure"
    return Unit(UNITS[best], note)


def guess_up(points: Array) -> Guess:
    """Guess the upward direction (3,) of points (n, 3) in metres: the main direction of long and thin parts.

    Stems do not show which of its two ends is up. The positive axis of the file is taken, or for y in a camera's frame
    the negative axis.
    """
    tree = cKDTree(points)
    axes = []
    for around in tree.query_ball_point(_subset(points), _ROD_REACH):
        if len(around) < 10:
            continue
        near = points[around[:: len(around) // 300 + 1]]
        variances, directions = np.linalg.eigh(np.cov(near.T))
        if variances[1] < (1 - _ROD) * variances[2]:
            axes.append(directions[:, 2])
    if len(axes) < 30:
        return _up_without_rods(points)
    rods = np.array(axes)
    votes = [int((np.abs(rods @ rod) > 0.95).sum()) for rod in rods[:: len(rods) // 400 + 1]]
    up = rods[:: len(rods) // 400 + 1][int(np.argmax(votes))]
    for _ in range(10):  # converge to the center of the bundle
        near = rods[np.abs(rods @ up) > 0.9]
        up = np.linalg.eigh(near.T @ near)[1][:, 2]
    fraction = float((np.abs(rods @ up) > 0.9).mean())
    snapped = snap(up)
    k = int(np.argmax(np.abs(snapped)))
    if abs(snapped[k]) < 1.0:
        up = snapped * np.sign(snapped[2] or 1.0)
        name = np.array2string(up, precision=2, separator=", ")
    else:
        sign = -1.0 if k == 1 and in_camera_frame(points) else 1.0
        up, name = sign * np.abs(snapped), f"{'-' if sign < 0 else ''}{'xyz'[k]}"
    return Guess(up, f"up: taken as {name} of the file, along which {fraction:.0%} of the long and thin parts lie")


def _up_without_rods(points: Array) -> Guess:
    """Guess the upward direction of a camera's cloud by its largest plane, if that may be a floor or table; else z."""
    if in_camera_frame(points):
        cloud = open3d().geometry.PointCloud(open3d().utility.Vector3dVector(_subset(points)))
        open3d().utility.random.seed(0)
        plane, on_it = cloud.segment_plane(_FLAT, 3, 1000)
        normal = -np.sign(plane[1]) * np.array(plane[:3]) / np.linalg.norm(plane[:3])
        if len(on_it) > _TABLE * len(cloud.points) and -normal[1] > 0.5:
            note = f"up: taken as normal to the plane that holds {len(on_it) / len(cloud.points):.0%} of the points"
            return Guess(normal, note)
    return Guess(np.array([0.0, 0.0, 1.0]), "up: no long and thin parts show it; taken as the file's z")


def in_camera_frame(points: Array) -> bool:
    """Return whether points (n, 3) lie in front of a camera at the origin that looks along z, with y down.

    One point in 200 may lie elsewhere.
    """
    nearest, middle, farthest = np.quantile(points[:, 2], [_ELSEWHERE, 0.5, 1 - _ELSEWHERE])
    aside = np.quantile(np.abs(points[:, :2]), 1 - _ELSEWHERE)
    off_axis = np.abs(np.median(points[:, :2], axis=0)).max()
    return bool(nearest > 0 and aside < 2.0 * farthest and off_axis < 0.5 * middle)


def snap(direction: Array) -> Array:
    """Return a direction as a unit vector, or the axis of the file close to it."""
    k = int(np.argmax(np.abs(direction)))
    axis = np.zeros(3)
    axis[k] = np.sign(direction[k])
    return axis if abs(direction[k]) > _SNAP * np.linalg.norm(direction) else direction / np.linalg.norm(direction)


def row_from_file(points: Array, normals: Array, up: Array) -> Guess:
    """Guess the pose (4, 4) of the file in a frame with z up, y along the row, x away from the scanner.

    Args:
        points: (n, 3) points.
        normals: (n, 3) unit vectors toward the scanner.
        up: (3,) unit vector.
    """
    any_side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    any_side /= np.linalg.norm(any_side)
    level = np.stack([any_side, np.cross(up, any_side)])
    flat = (points - points.mean(axis=0)) @ level.T
    view = -(normals @ level.T).mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov(flat[:: len(flat) // 50_000 + 1].T))
    facing = float(np.linalg.norm(view))
    if spread[1] > _LONG**2 * spread[0]:
        ahead = axes[:, 0] * _sign(view @ axes[:, 0], flat @ axes[:, 0])
        facing = abs(float(view @ axes[:, 0]))
    else:
        ahead = view if facing > _FACING else axes[:, 0] * _sign(0.0, flat @ axes[:, 0])
    x = snap(ahead @ level)
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    name = np.array2string(x, precision=2, suppress_small=True, separator=", ")
    side = f"seen along {name} of the file" if facing > _FACING else f"seen from all sides; {name} is taken as ahead"
    return Guess(pose(np.stack([x, np.cross(up, x), up])), f"side: {side}")


def _sign(preferred: float, values: npt.NDArray[np.floating]) -> float:
    """Return the sign of a number, or of the skewness of values if the number is close to 0."""
    if abs(preferred) > _FACING:
        return float(np.sign(preferred))
    return float(np.sign(((values - np.median(values)) ** 3).sum()) or 1.0)


def _subset(points: Array) -> Array:
    return points[:: max(1, len(points) // _SAMPLES)]
