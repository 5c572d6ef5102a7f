"""What a file of points does not say: its unit, which way is up, and from which side it was seen.

All of it is read off the points alone, in a way that does not depend on how the cloud is turned, mirrored or scaled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.geometry import Array, pose

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres of each unit that is tried."""

_EXTENT, _SPACING = 2.0, 0.0015  # m, of a row that was scanned, and between points of a scan
_DECADES = 0.5  # one sigma of both, in powers of ten
_RARE = {"cm": 3.0}  # what speaks against a unit from the start
_UNSURE = 4.0  # a unit that fits better than the next by less is not sure
_SAMPLES = 2000
_ROD_REACH = 0.03  # m
_ROD = 0.8  # 1 - ratio of the second to the first variance
_SNAP = np.cos(np.deg2rad(12.0))  # axes of the file this near are taken as they are
_FACING = 0.15  # mean of the unit normals across the row below which it was seen from all around
_FLAT, _TABLE = 0.01, 0.3  # m from a plane, and the share of the points that a table or a floor holds
_LONG = 1.3  # times as long as deep must a cloud be for its longer side to be the row's


class Guess(NamedTuple):
    """What was found out, and a sentence on how sure that is."""

    value: Array
    said: str


class Unit(NamedTuple):
    """Metres per unit, and a sentence on how sure that is."""

    metres: float
    said: str


def spacing(points: Array) -> float:
    """Median distance of a point (n, 3) from its nearest neighbor that is not at the same place."""
    tree = cKDTree(points)
    nearest = tree.query(_some(points), k=4)[0]
    nearest[nearest == 0] = np.inf
    closest = nearest.min(axis=1)
    return float(np.median(closest[np.isfinite(closest)])) if np.isfinite(closest).any() else 0.0


def guess_unit(points: Array) -> Unit:
    """The unit that makes of points (n, 3) a scan of a usual size and density."""
    centered = _some(points) - np.median(points, axis=0)
    axes = np.linalg.svd(centered, full_matrices=False)[2]
    extent = float(np.ptp(np.quantile(centered @ axes[0], [0.01, 0.99])))
    apart = max(spacing(points), 1e-12)

    def against(name: str) -> float:
        size = np.log10(max(extent, 1e-12) * UNITS[name] / _EXTENT) / _DECADES
        density = np.log10(apart * UNITS[name] / _SPACING) / _DECADES
        return float(size**2 + density**2 + _RARE.get(name, 0.0))

    best, *others = sorted(UNITS, key=against)
    size = f"{extent * UNITS[best]:.3g} m long with points {1e3 * apart * UNITS[best]:.2g} mm apart"
    said = f"units: taken as {best}, which makes it {size}"
    possible = [name for name in others if best in _RARE or against(name) - against(best) < _UNSURE]
    if possible:
        said += f"; they might be {' or '.join(possible)}: give the units to be sure"
    return Unit(UNITS[best], said)


def guess_up(points: Array) -> Guess:
    """The direction (3,) along which most of what is long and thin stands, of points (n, 3) in metres.

    Which of its two ends is up cannot be seen of stems: it is the end of the file's axis, and of y that which is up in
    the frame of a camera.
    """
    tree = cKDTree(points)
    axes = []
    for around in tree.query_ball_point(_some(points), _ROD_REACH):
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
    for _ in range(10):  # to the middle of the bundle
        near = rods[np.abs(rods @ up) > 0.9]
        up = np.linalg.eigh(near.T @ near)[1][:, 2]
    share = float((np.abs(rods @ up) > 0.9).mean())
    snapped = snap(up)
    k = int(np.argmax(np.abs(snapped)))
    if abs(snapped[k]) < 1.0:
        up = snapped * np.sign(snapped[2] or 1.0)
        name = np.array2string(up, precision=2, separator=", ")
    else:
        sign = -1.0 if k == 1 and in_camera_frame(points) else 1.0
        up, name = sign * np.abs(snapped), f"{'-' if sign < 0 else ''}{'xyz'[k]}"
    return Guess(up, f"up: taken as {name} of the file, along which {share:.0%} of what is long and thin lies")


def _up_without_rods(points: Array) -> Guess:
    """Of what a camera saw, the normal of the largest plane if that may be a floor or a table; else the file's z."""
    if in_camera_frame(points):
        cloud = open3d().geometry.PointCloud(open3d().utility.Vector3dVector(_some(points)))
        open3d().utility.random.seed(0)
        plane, on_it = cloud.segment_plane(_FLAT, 3, 1000)
        normal = -np.sign(plane[1]) * np.array(plane[:3]) / np.linalg.norm(plane[:3])
        if len(on_it) > _TABLE * len(cloud.points) and -normal[1] > 0.5:
            said = f"up: taken as across the plane that holds {len(on_it) / len(cloud.points):.0%} of the points"
            return Guess(normal, said)
    return Guess(np.array([0.0, 0.0, 1.0]), "up: nothing long and thin tells it; taken as the file's z")


def in_camera_frame(points: Array) -> bool:
    """Whether points (n, 3) all lie before a camera at the origin that looks along z, with y down."""
    ahead = points[:, 2]
    return bool(ahead.min() > 0 and np.abs(points[:, :2]).max() < 2.0 * ahead.max() and np.abs(
        np.median(points[:, :2], axis=0)
    ).max() < 0.5 * np.median(ahead))  # fmt: skip


def snap(direction: Array) -> Array:
    """A unit vector, or the axis of the file that is next to it."""
    k = int(np.argmax(np.abs(direction)))
    axis = np.zeros(3)
    axis[k] = np.sign(direction[k])
    return axis if abs(direction[k]) > _SNAP * np.linalg.norm(direction) else direction / np.linalg.norm(direction)


def row_from_file(points: Array, normals: Array, up: Array) -> Guess:
    """(4, 4) rotation to z up, y along the row, x away from who looked.

    Args:
        points: (n, 3).
        normals: (n, 3) unit vectors, toward who looked.
        up: (3,) unit vector.
    """
    any_side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    any_side /= np.linalg.norm(any_side)
    level = np.stack([any_side, np.cross(up, any_side)])
    flat = (points - points.mean(axis=0)) @ level.T
    looks = -(normals @ level.T).mean(axis=0)
    spread, axes = np.linalg.eigh(np.cov(flat[:: len(flat) // 50_000 + 1].T))
    facing = float(np.linalg.norm(looks))
    if spread[1] > _LONG**2 * spread[0]:
        ahead = axes[:, 0] * _sign(looks @ axes[:, 0], flat @ axes[:, 0])
        facing = abs(float(looks @ axes[:, 0]))
    else:
        ahead = looks if facing > _FACING else axes[:, 0] * _sign(0.0, flat @ axes[:, 0])
    x = snap(ahead @ level)
    x = x - (x @ up) * up
    x /= np.linalg.norm(x)
    name = np.array2string(x, precision=2, suppress_small=True, separator=", ")
    seen = f"seen along {name} of the file" if facing > _FACING else f"seen from all around; {name} is taken as ahead"
    return Guess(pose(np.stack([x, np.cross(up, x), up])), f"side: {seen}")


def _sign(preferred: float, values: npt.NDArray[np.floating]) -> float:
    """The sign of a number, or of the values' skewness where that is nearly 0."""
    if abs(preferred) > _FACING:
        return float(np.sign(preferred))
    return float(np.sign(((values - np.median(values)) ** 3).sum()) or 1.0)


def _some(points: Array) -> Array:
    return points[:: max(1, len(points) // _SAMPLES)]
