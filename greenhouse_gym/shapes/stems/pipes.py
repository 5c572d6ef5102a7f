"""Pipes: straight cylinders thicker than a stem, in any direction.

All normals of a cylinder are perpendicular to its axis, and ``point - radius * normal`` lies on the axis. So every
small piece of surface gives the cylinder it may belong to: the axis from the scatter of the normals (their Gauss map),
the radius by linear least squares. The most consistent pieces are refined by robust least squares of distance from the
axis minus radius, and grown along the axis as far as the surface continues. The result is a pipe if a large part of its
circumference shows, evenly and straight: a curled leaf shows less of it, a tomato is also curved along the axis, and
the faces of a box continue beyond its edge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.geometry.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.evidence import SHELL
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.robust_fit import SCALES, gauss_newton_step, tukey_weights

_CELL = 0.010  # metres: size of the pieces of surface
_REACH = 0.030  # metres: radius of the neighborhood of a piece
_MIN_SPREAD = 0.05  # variance of a piece's normals; flatter pieces do not determine a radius
_MAX_SEED_TILT = 0.12  # fraction of that variance along the axis
_MAX_SCATTER = 0.005  # metres by which the centers of a piece's points may scatter
_ROW_ARC = np.deg2rad(60.0)  # of the circumference that a centimetre of a pipe must show
_GROWTH_STEPS = 8  # each doubles the length searched
_MAX_GAP = 0.05  # metres of a pipe that may be occluded
_MIN_ARC = 1.75  # radians of its circumference that must show; the near side alone shows about 2.2
_MIN_FILLED = 0.7  # fraction of its length that must show
_MIN_ALIGNMENT = 0.95  # mean cosine between its points' normals and its own
_MAX_TILT = 0.22  # root mean square of its points' normals along its axis; a tomato has 0.25 and more
_MAX_OUTSIDE = 0.5  # points just outside of it per point on it; the faces of a box continue beyond its edge

Radii = tuple[float, float]


class Cylinder(NamedTuple):
    """An infinite cylinder: (3,) a point on its axis in metres, (3,) unit vector along it, radius in metres."""

    origin: Array
    axis: Array
    radius: float


class _CylinderPoints(NamedTuple):
    """Points in a cylinder's frame.

    Attributes:
        along: (n,) metres along the axis from the origin.
        outward: (n, 3) unit vectors away from the axis.
        residual: (n,) metres outside of the surface.
        alignment: (n,) cosine between normals and ``outward``.
    """

    along: Array
    outward: Array
    residual: Array
    alignment: Array


class _Piece(NamedTuple):
    """The visible part of a cylinder.

    Attributes:
        cylinder: The cylinder.
        low: Start along its axis, metres from the origin.
        high: End along its axis.
        arc: Circumference that shows in a third of the length or more, radians.
        filled: Fraction of the length that shows.
        alignment: Mean cosine between its points' normals and its own.
        tilt: Root mean square of its points' normals along the axis.
        outside: Points just outside of it per point on it.
    """

    cylinder: Cylinder
    low: float
    high: float
    arc: float
    filled: float
    alignment: float
    tilt: float
    outside: float


def find_pipes(cloud: Cloud, radii: Radii) -> list[Stem]:
    """Find pipes.

    Args:
        cloud: One point per voxel, only points that may lie on a pipe; normals out of the surfaces.
        radii: Smallest and largest radius, metres.

    Returns:
        A capsule of kind ``pipe`` for each straight piece.
    """
    seeds, centers = _seeds(cloud, radii)
    if not seeds:
        return []
    tree = cKDTree(cloud.points)
    tried = np.full(centers.shape, np.inf)
    pipes: list[Stem] = []
    for number, (seed, center) in enumerate(zip(seeds, centers, strict=True)):
        if (np.linalg.norm(tried - center, axis=1) < _REACH).any() or any(_is_on(center, pipe) for pipe in pipes):
            continue
        tried[number] = center
        piece = _grow(seed, cloud, tree, radii)
        if piece is not None and _is_pipe(piece, radii):
            origin, axis, radius = piece.cylinder
            pipes.append(Stem(origin + piece.low * axis, origin + piece.high * axis, radius, kind="pipe"))
    return pipes


def _seeds(cloud: Cloud, radii: Radii) -> tuple[list[Cylinder], Array]:
    """Return cylinders that pieces of surface may belong to, the most consistent first, and the pieces' centers (k, 3).

    With P the projection perpendicular to the axis, the radius r and the axis' position c minimize the sum of
    ``|P (point - r * normal) - c|^2``, so only first and second moments of points and normals are needed.
    """
    cells, _ = voxel_means(cloud, _CELL)
    p, n = cells.points, cells.normals
    if len(p) < 2:
        return [], np.zeros((0, 3))
    near = Neighborhoods(p, _REACH)
    tilts, axes = np.linalg.eigh(near.moments(n, n))
    axis = axes[:, :, 0]

    def across(covariances: Array) -> Array:
        """Return the trace of covariances (k, 3, 3) perpendicular to the axes."""
        along = np.einsum("ki,kij,kj->k", axis, covariances, axis)
        return np.asarray(np.trace(covariances, axis1=1, axis2=2) - along)

    spread = np.maximum(across(near.covariances(n, n)), 1e-9)
    common = across(near.covariances(p, n))
    radius = common / spread
    scatter = np.sqrt(np.maximum(across(near.covariances(p, p)) - common**2 / spread, 0.0))
    good = _is_near(radius, radii) & (scatter < _MAX_SCATTER)
    good &= (spread > _MIN_SPREAD) & (tilts[:, 0] < _MAX_SEED_TILT * spread)
    rows = np.flatnonzero(good)
    rows = rows[np.argsort(scatter[rows], kind="stable")]
    mean_p, mean_n = near.mean(p), near.mean(n)
    return [Cylinder(mean_p[k] - radius[k] * mean_n[k], axis[k], float(radius[k])) for k in rows], p[rows]


def _is_near(radius: Array | float, radii: Radii) -> npt.NDArray[np.bool_]:
    """Return whether radii lie roughly within bounds."""
    return np.asarray((radius > 0.8 * radii[0]) & (radius < 1.25 * radii[1]))


def _grow(seed: Cylinder, cloud: Cloud, tree: cKDTree, radii: Radii) -> _Piece | None:
    """Refine a cylinder and follow it along its axis, twice as far in each step."""
    piece: _Piece | None = None
    cylinder, reach = seed, max(0.04, 2.0 * seed.radius)
    for _ in range(_GROWTH_STEPS):
        near = cloud.select(np.array(tree.query_ball_point(cylinder.origin, reach), dtype=np.int64))
        refined = _refine(cylinder, near, radii)
        if refined is None:
            return None
        near = cloud.select(np.array(tree.query_ball_point(refined.origin, reach + refined.radius), dtype=np.int64))
        grown = _visible_piece(refined, near)
        if grown is None:
            return None
        length = grown.high - grown.low
        done = 0.75 * length + refined.radius < reach or (piece is not None and length <= piece.high - piece.low)
        piece = grown
        if done:
            break
        middle = refined.origin + refined.axis * (grown.low + grown.high) / 2
        cylinder, reach = refined._replace(origin=middle), length + refined.radius
    return piece


def _to_cylinder(cylinder: Cylinder, cloud: Cloud) -> _CylinderPoints:
    offset = cloud.points - cylinder.origin
    along = offset @ cylinder.axis
    offset -= along[:, None] * cylinder.axis
    distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    outward = offset / distance[:, None]
    return _CylinderPoints(along, outward, distance - cylinder.radius, (outward * cloud.normals).sum(axis=1))


def _refine(cylinder: Cylinder, near: Cloud, radii: Radii) -> Cylinder | None:
    """Refine a cylinder by Gauss-Newton with Tukey weights; points whose normals face away get no weight."""
    for scale in SCALES:
        along, outward, residual, alignment = _to_cylinder(cylinder, near)
        weight = tukey_weights(residual, scale * SHELL) * (alignment > 0.7)
        if np.count_nonzero(weight) < 30:
            return None
        middle = np.average(along, weights=weight)
        along = along - middle
        sideways = frame_along(cylinder.axis)[:, :2]
        u = outward @ sideways
        jacobian = np.column_stack([-u, -along[:, None] * u, -np.ones(len(u))])
        length = np.average(along**2, weights=weight)
        step = gauss_newton_step(jacobian, weight, residual, 1e-4 * np.array([1.0, 1.0, length, length, 1e-2]))
        axis = cylinder.axis + sideways @ step[2:4]
        cylinder = Cylinder(
            cylinder.origin + middle * cylinder.axis + sideways @ step[:2],
            axis / np.linalg.norm(axis),
            cylinder.radius + float(step[4]),
        )
        if not _is_near(cylinder.radius, radii):
            return None
    return cylinder


def _visible_piece(cylinder: Cylinder, near: Cloud) -> _Piece | None:
    """Return the visible part of a cylinder around its origin, with short gaps bridged."""
    along, outward, residual, alignment = _to_cylinder(cylinder, near)
    on = (np.abs(residual) < SHELL) & (alignment > 0.7)
    u = outward @ frame_along(cylinder.axis)[:, :2]
    columns = int(np.ceil(2 * np.pi * cylinder.radius / _CELL))
    column = np.floor((np.arctan2(u[:, 1], u[:, 0]) / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    row = np.floor(along / _CELL).astype(np.int64)
    first = row.min()
    counts = np.zeros((row.max() - first + 1, columns), dtype=np.int64)
    np.add.at(counts, (row[on] - first, column[on]), 1)
    shows = counts >= 2
    visible = np.flatnonzero(shows.mean(axis=1) * 2 * np.pi > _ROW_ARC)
    if not len(visible):
        return None
    runs = np.split(visible, np.flatnonzero(np.diff(visible) > _MAX_GAP / _CELL) + 1)
    run = min(runs, key=lambda r: max(r[0] + first, -(r[-1] + first), 0))  # the one at the origin
    low, high = (run[0] + first) * _CELL, (run[-1] + 1 + first) * _CELL
    within = (along >= low) & (along <= high)
    on &= within
    outside = within & (residual > SHELL) & (residual < 3.5 * SHELL)
    sectors = int(np.count_nonzero(shows[run].mean(axis=0) > 0.3))
    return _Piece(
        cylinder,
        float(max(low, along[on].min())),
        float(min(high, along[on].max())),
        arc=max(sectors - 1, 0) * 2 * np.pi / columns,  # an arc as wide as k columns touches k + 1 of them
        filled=len(run) / (run[-1] - run[0] + 1),
        alignment=float(alignment[on].mean()),
        tilt=float(np.sqrt(np.mean((near.normals[on] @ cylinder.axis) ** 2))),
        outside=np.count_nonzero(outside) / np.count_nonzero(on),
    )


def _is_pipe(piece: _Piece, radii: Radii) -> bool:
    """Return whether a piece is longer than wide, and round, complete, even and straight enough."""
    return (
        radii[0] <= piece.cylinder.radius <= radii[1]
        and piece.high - piece.low >= 2 * piece.cylinder.radius
        and piece.arc >= _MIN_ARC
        and piece.filled >= _MIN_FILLED
        and piece.alignment >= _MIN_ALIGNMENT
        and piece.tilt <= _MAX_TILT
        and piece.outside <= _MAX_OUTSIDE
    )


def _is_on(point: Array, pipe: Stem) -> bool:
    """Return whether a point (3,) belongs to a known pipe."""
    along = (pipe.end - pipe.start) / pipe.length
    offset = point - pipe.start
    reach = float(offset @ along)
    distance = float(np.linalg.norm(offset - reach * along))
    return -_CELL < reach < pipe.length + _CELL and distance < pipe.radius + _CELL
