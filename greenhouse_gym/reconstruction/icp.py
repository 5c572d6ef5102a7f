"""Fine registration of two stations: point-to-plane ICP between surfaces that face the same way.

A point's partner is what the other station's cameras measured at the pixels it falls on (Blais and Levine 1995), so no
search tree is needed, and several cameras may each give one. The error is measured along the mean of both normals
(symmetric point-to-plane, Rusinkiewicz 2019) with Tukey weights. Stems are thinner than the distance within which
partners are looked for, and stations see them from different sides, so two points are partners only if their normals
agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from greenhouse_gym.geometry import Array, invert, pose, transform
from greenhouse_gym.reconstruction.point_clouds import Cloud
from greenhouse_gym.reconstruction.settings import ReconstructionSettings
from greenhouse_gym.reconstruction.views import StationView

_RELAXATION = 1.3  # times a step, which falls short while partners beyond reach are missing


@dataclass(frozen=True, eq=False)
class Alignment:
    """What fine registration found.

    Attributes:
        first_from_second: (4, 4).
        overlap: Share of the second station's sample that the first could see.
        fitness: Share of those with a partner.
        contradicted: Share of those that have none, and that the first station sees through.
        rmse: Root mean square distance of partners along their normals, metres.
        held: (6,) how much each independent motion would move partners along their normals, a share, the least first;
            see `held`. Near 0 the stations can slide or turn along each other.
        information: (6, 6) rotation then translation, in the first station's frame, for the pose graph.
    """

    first_from_second: Array
    overlap: float
    fitness: float
    contradicted: float
    rmse: float
    held: Array
    information: Array


class Partners(NamedTuple):
    """Pairs of points.

    Attributes:
        row: (k,) of the moved cloud.
        residual: (k,) metres along ``axes``.
        axes: (k, 3) means of both normals.
        facing: (k, 3) normals at the partners.
    """

    row: npt.NDArray[np.int64]
    residual: Array
    axes: Array
    facing: Array


def align(first: StationView, second: Cloud, start: Array, settings: ReconstructionSettings) -> Alignment:
    """Register the second cloud to the first station from a start within ``settings.fine_distance``.

    Args:
        first: What to register to.
        second: The cloud to move, in its own station's rig frame.
        start: (4, 4) first_from_second to start from.
        settings: All settings.
    """
    current = np.array(start, dtype=np.float64)
    for every in (4, 1):  # a quarter of the points brings it near
        some = second.select(np.arange(0, len(second), every))
        for _ in range(settings.icp_iterations):
            step, center = _step(first, some.moved(current), settings)
            step *= _RELAXATION
            turn = Rotation.from_rotvec(step[:3]).as_matrix()
            current = pose(turn, center + step[3:] - turn @ center) @ current
            if np.abs(step).max() < 2e-5 * every:
                break
    return assess(first, second, current, settings)


def _step(first: StationView, moved: Cloud, settings: ReconstructionSettings) -> tuple[Array, Array]:
    """One Gauss-Newton step: rotation vector and translation (6,) of a moved cloud about a center (3,)."""
    found = partners(first, moved, settings)
    if len(found.row) < 6:
        return np.zeros(6), np.zeros(3)
    points = moved.points[found.row]
    center = points.mean(axis=0)
    jacobian = np.column_stack([np.cross(points - center, found.axes), found.axes])
    weighted = jacobian * tukey(found.residual)[:, None]
    step = np.linalg.lstsq(jacobian.T @ weighted, -weighted.T @ found.residual, rcond=1e-9)[0]
    return np.asarray(step), np.asarray(center)


def assess(first: StationView, second: Cloud, first_from_second: Array, settings: ReconstructionSettings) -> Alignment:
    """How well the second cloud, moved to where it is said to stand, agrees with the first station."""
    moved = second.moved(first_from_second)
    found = partners(first, moved, settings)
    seen, through = _seen(first, moved.points, settings.see_through)
    matched = np.zeros(len(moved), dtype=bool)
    matched[found.row] = True
    seen |= matched
    overlap = np.count_nonzero(seen)
    if len(found.row) < 6:
        share = overlap / max(len(moved), 1)
        return Alignment(first_from_second, share, 0.0, 0.0, float("nan"), np.zeros(6), np.eye(6))
    weight = tukey(found.residual)
    jacobian = np.column_stack([np.cross(moved.points[found.row], found.axes), found.axes])
    rmse = float(np.sqrt(np.mean(found.residual**2)))
    information = jacobian.T @ (jacobian * weight[:, None]) / max(rmse, 1e-6) ** 2
    return Alignment(
        first_from_second,
        overlap=overlap / len(moved),
        fitness=np.count_nonzero(matched) / overlap,
        contradicted=np.count_nonzero(through & ~matched) / overlap,
        rmse=rmse,
        held=held(moved.points[found.row], moved.normals[found.row], found.facing, weight),
        information=information,
    )


def held(points: Array, normals: Array, facing: Array, weight: Array) -> Array:
    """By how much each independent motion shows, as a share of the mean square motion of the points: (6,), least first.

    These are the eigenvalues of the registration's information, lengths counted in radii of the points. Each entry
    multiplies the normal that one station measured with the one that the other did, so that the noise of normals, which
    makes any flat wall look as if it held a motion along itself, cancels.

    Args:
        points: (k, 3) of partners, in one frame.
        normals: (k, 3) as one station measured them.
        facing: (k, 3) as the other did.
        weight: (k,).
    """
    center = points.mean(axis=0)
    radius = max(float(np.sqrt(((points - center) ** 2).sum(axis=1).mean())), 1e-9)
    one, two = (np.column_stack([np.cross((points - center) / radius, n), n]) for n in (normals, facing))
    information = (one * weight[:, None]).T @ two / max(float(weight.sum()), 1e-9)
    return np.asarray(np.linalg.eigvalsh((information + information.T) / 2))


def partners(first: StationView, moved: Cloud, settings: ReconstructionSettings) -> Partners:
    """What the first station measured where the points of a cloud in its frame fall, if near and facing alike."""
    rows, residuals, axes, facing = [], [], [], []
    for view in first.cameras.values():
        row, v, u = view.camera.intrinsics.project(transform(invert(view.camera.rig_from_camera), moved.points))
        shown = view.foreground[v, u]
        row, v, u = row[shown], v[shown], u[shown]
        apart = moved.points[row] - view.points(v, u)
        other = view.normals[v, u].astype(np.float64)
        axis = moved.normals[row] + other
        # unit normals: |a + b|^2 = 2 + 2 a . b
        squared = (axis**2).sum(axis=1)
        near = ((apart**2).sum(axis=1) < settings.fine_distance**2) & (squared > 2 + 2 * settings.facing)
        axis = axis[near] / np.sqrt(squared[near])[:, None]
        rows.append(row[near])
        axes.append(axis)
        facing.append(other[near])
        residuals.append((apart[near] * axis).sum(axis=1))
    return Partners(*map(np.concatenate, (rows, residuals, axes, facing)))


def _seen(first: StationView, points: Array, margin: float) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Which points (n,) in the first station's frame it could see, and which of them it sees through.

    A point is seen through if a camera's reading lies more than ``margin`` behind it, and hidden if all readings lie
    more than that in front of it.
    """
    seen, through = np.zeros((2, len(points)), dtype=bool)
    for view in first.cameras.values():
        in_camera = transform(invert(view.camera.rig_from_camera), points)
        row, v, u = view.camera.intrinsics.project(in_camera)
        reading = view.depth[v, u]
        behind = reading - in_camera[row, 2]
        seen[row] |= (reading > 0) & (behind > -margin)
        through[row] |= behind > margin
    return seen, through


def tukey(residual: Array) -> Array:
    """Weights (k,) that fall to zero at 2.5 standard deviations, estimated robustly, at least a millimetre."""
    scale = max(2.5 * 1.4826 * float(np.median(np.abs(residual))), 0.001)
    return np.clip(1 - (residual / scale) ** 2, 0, None) ** 2
