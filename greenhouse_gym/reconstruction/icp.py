"""Fine registration of two stations: point-to-plane ICP between surfaces that face the same way.

A point's partner is the reading of the other station's cameras at the pixels it projects to (Blais and Levine 1995), so
no search tree is needed, and each camera may give one. The error is measured along the mean of both normals (symmetric
point-to-plane, Rusinkiewicz 2019) with Tukey weights. Stems are thinner than the distance within which partners are
looked for, and stations see them from different sides, so two points are partners only if their normals agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.geometry.point_clouds import Cloud
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.station_views import StationView

MAX_ITERATIONS = 30
MIN_FACING = 0.8  # cosine between the normals of partners
SEE_THROUGH = 0.03  # m behind a point at which another station must have a reading to contradict the point
_RELAXATION = 1.3  # times a step, which falls short while partners beyond reach are missing


@dataclass(frozen=True, eq=False)
class IcpResult:
    """Result of fine registration."""

    first_from_second: Array  # (4, 4)
    overlap: float  # fraction of the second station's sample that the first could see
    fitness: float  # fraction of those with a partner
    contradicted: float  # fraction of those without a partner that the first station sees through
    rmse: float  # root mean square distance of partners along their normals, metres
    constraint: Array  # (6,) ascending, see `motion_constraint`. Near 0 the stations can slide or turn along each other
    information: Array  # (6, 6) rotation then translation, in the first station's frame, for the pose graph


class Partners(NamedTuple):
    """Pairs of points."""

    row: npt.NDArray[np.int64]  # (k,) of the moved cloud
    residual: Array  # (k,) metres along ``axes``
    axes: Array  # (k, 3) means of both normals
    facing: Array  # (k, 3) normals at the partners


def fine_icp(first: StationView, second: Cloud, start: Array, settings: ReconstructionSettings) -> IcpResult:
    """Register the second cloud, in its own rig frame, to the first station.

    ``start`` (4, 4) is first_from_second, right to about ``settings.fine_distance``.
    """
    current = np.array(start, dtype=np.float64)
    for every in (4, 1):  # a quarter of the points gets it close
        subset = second.select(np.arange(0, len(second), every))
        for _ in range(MAX_ITERATIONS):
            step, center = _gauss_newton_step(first, subset.transformed(current), settings)
            step *= _RELAXATION
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            current = pose(turn, center + step[3:] - turn @ center) @ current
            if np.abs(step).max() < 2e-5 * every:
                break
    return assess_pose(first, second, current, settings)


def _gauss_newton_step(first: StationView, moved: Cloud, settings: ReconstructionSettings) -> tuple[Array, Array]:
    """Return the rotation vector and translation (6,) of one step of a moved cloud about a center (3,)."""
    found = find_partners(first, moved, settings)
    if len(found.row) < 6:
        return np.zeros(6), np.zeros(3)
    points = moved.points[found.row]
    center = points.mean(axis=0)
    jacobian = np.column_stack([np.cross(points - center, found.axes), found.axes])
    weighted = jacobian * tukey_weights(found.residual)[:, None]
    step = np.linalg.lstsq(jacobian.T @ weighted, -weighted.T @ found.residual, rcond=1e-9)[0]
    return np.asarray(step), np.asarray(center)


def assess_pose(
    first: StationView, second: Cloud, first_from_second: Array, settings: ReconstructionSettings
) -> IcpResult:
    """Measure the agreement of the second cloud, at a given pose, with the first station."""
    moved = second.transformed(first_from_second)
    found = find_partners(first, moved, settings)
    visible, through = _visibility(first, moved.points)
    matched = np.zeros(len(moved), dtype=bool)
    matched[found.row] = True
    visible |= matched
    overlap = np.count_nonzero(visible)
    if len(found.row) < 6:
        fraction = overlap / max(len(moved), 1)
        return IcpResult(first_from_second, fraction, 0.0, 0.0, float("nan"), np.zeros(6), np.eye(6))
    weight = tukey_weights(found.residual)
    jacobian = np.column_stack([np.cross(moved.points[found.row], found.axes), found.axes])
    rmse = float(np.sqrt(np.mean(found.residual**2)))
    information = jacobian.T @ (jacobian * weight[:, None]) / max(rmse, 1e-6) ** 2
    return IcpResult(
        first_from_second,
        overlap=overlap / len(moved),
        fitness=np.count_nonzero(matched) / overlap,
        contradicted=np.count_nonzero(through & ~matched) / overlap,
        rmse=rmse,
        constraint=motion_constraint(moved.points[found.row], moved.normals[found.row], found.facing, weight),
        information=information,
    )


def motion_constraint(points: Array, normals: Array, facing: Array, weight: Array) -> Array:
    """Return the strength (6,) with which partners constrain each independent motion, ascending.

    Each entry is the mean square motion of the points (k, 3) along their normals, as a fraction of all of their motion.
    These are the eigenvalues of the registration's information, lengths counted in radii of the points. Each entry
    multiplies the normal that one station measured, ``normals`` (k, 3), with the one that the other did, ``facing``
    (k, 3), so that the noise of normals, which would make any flat wall seem to constrain motion along itself, cancels.
    """
    center = points.mean(axis=0)
    radius = max(float(np.sqrt(((points - center) ** 2).sum(axis=1).mean())), 1e-9)
    one, two = (np.column_stack([np.cross((points - center) / radius, n), n]) for n in (normals, facing))
    information = (one * weight[:, None]).T @ two / max(float(weight.sum()), 1e-9)
    return np.asarray(np.linalg.eigvalsh((information + information.T) / 2))


def find_partners(first: StationView, moved: Cloud, settings: ReconstructionSettings) -> Partners:
    """Pair points of a cloud with the first station's readings at their pixels that are near and face the same way."""
    rows, residuals, axes, facing = [], [], [], []
    for view in first.cameras.values():
        row, v, u = view.camera.intrinsics.project(transform(invert(view.camera.rig_from_camera), moved.points))
        shown = view.foreground[v, u]
        row, v, u = row[shown], v[shown], u[shown]
        difference = moved.points[row] - view.points(v, u)
        other = view.normals[v, u].astype(np.float64)
        axis = moved.normals[row] + other
        # unit normals: |a + b|^2 = 2 + 2 a . b
        squared = (axis**2).sum(axis=1)
        near = ((difference**2).sum(axis=1) < settings.fine_distance**2) & (squared > 2 + 2 * MIN_FACING)
        axis = axis[near] / np.sqrt(squared[near])[:, None]
        rows.append(row[near])
        axes.append(axis)
        facing.append(other[near])
        residuals.append((difference[near] * axis).sum(axis=1))
    return Partners(*map(np.concatenate, (rows, residuals, axes, facing)))


def _visibility(first: StationView, points: Array) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Mask the points (n,) in the first station's frame that it could see, and those it sees through.

    A point is seen through if a camera's reading lies clearly behind it, and hidden if all readings lie clearly in
    front of it.
    """
    visible, through = np.zeros((2, len(points)), dtype=bool)
    for view in first.cameras.values():
        in_camera = transform(invert(view.camera.rig_from_camera), points)
        row, v, u = view.camera.intrinsics.project(in_camera)
        reading = view.depth[v, u]
        behind = reading - in_camera[row, 2]
        visible[row] |= (reading > 0) & (behind > -SEE_THROUGH)
        through[row] |= behind > SEE_THROUGH
    return visible, through


def tukey_weights(residual: Array) -> Array:
    """Return weights (k,) that fall to zero at 2.5 standard deviations, estimated robustly, at least a millimetre."""
    scale = max(2.5 * 1.4826 * float(np.median(np.abs(residual))), 0.001)
    return np.clip(1 - (residual / scale) ** 2, 0, None) ** 2
