"""Pipes: straight round things thicker than a stem, of any direction.

All normals of a cylinder are perpendicular to its axis, and ``point - radius * normal`` falls onto the axis. So every
small piece of surface tells by itself which cylinder it may belong to: the axis from the scatter of the normals (their
Gauss map), the radius by linear least squares. The pieces that agree best with themselves are refined by robust least
squares of distance from the axis minus radius, and grown along the axis as far as the surface goes on. What then shows
much of its round, even and straight, is a pipe: a bent leaf shows less of it, a tomato is round along the axis as well,
and the faces of a box go on beyond its edge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from greenhouse_gym.crops.parts import Stem
from greenhouse_gym.geometry import Array, frame_along
from greenhouse_gym.reconstruction.point_clouds import Cloud, voxel_means
from greenhouse_gym.shapes.neighborhoods import Neighborhoods
from greenhouse_gym.shapes.robust import SCALES, gauss_newton_step, tukey_weights
from greenhouse_gym.shapes.settings import ShapeSettings

_CELL = 0.010  # metres: pieces of surface are told apart at this size
_REACH = 0.030  # metres: pieces this near are looked at together
_LEAST_SPREAD = 0.05  # least variance of a piece's normals: flatter pieces tell no radius
_MOST_TILT = 0.12  # share of that spread that there may be along the axis
_MOST_SCATTER = 0.005  # metres by which the centers of a piece's points may scatter
_ROW_ARC = np.deg2rad(60.0)  # of the round that a centimetre of a pipe must show to count as seen
_GROWTH_STEPS = 8  # each doubles the length looked at


class Cylinder(NamedTuple):
    """An endless cylinder: (3,) a point on its axis in metres, (3,) unit vector along it, radius in metres."""

    origin: Array
    axis: Array
    radius: float


class _Around(NamedTuple):
    """Points as a cylinder sees them: along its axis, the way out of it, from its side, and the cosine to normals."""

    along: Array  # (n,) metres from the origin
    outward: Array  # (n, 3) unit vectors
    residual: Array  # (n,) metres
    alignment: Array  # (n,)


class _Piece(NamedTuple):
    """What was seen of a cylinder between two places along its axis."""

    cylinder: Cylinder
    low: float  # metres from the origin
    high: float
    arc: float  # of the round that shows in a third of the length or more, radians
    filled: float  # share of the length that was seen
    alignment: float  # mean cosine between its points' normals and its own
    tilt: float  # root mean square of its points' normals along the axis
    outside: float  # points just outside of it per point on it


def find_pipes(cloud: Cloud, settings: ShapeSettings) -> list[Stem]:
    """Find pipes.

    Args:
        cloud: One point per voxel of ``settings.voxel``, without what can be no pipe; normals out of the surfaces.
        settings: All settings.

    Returns:
        A capsule of kind ``pipe`` for each straight piece.
    """
    seeds, places = _seeds(cloud, settings)
    if not seeds:
        return []
    tree = cKDTree(cloud.points)
    tried = np.full(places.shape, np.inf)
    pipes: list[Stem] = []
    for number, (seed, place) in enumerate(zip(seeds, places, strict=True)):
        if (np.linalg.norm(tried - place, axis=1) < _REACH).any() or any(_is_on(place, pipe) for pipe in pipes):
            continue
        tried[number] = place
        piece = _grow(seed, cloud, tree, settings)
        if piece is not None and _is_pipe(piece, settings):
            origin, axis, radius = piece.cylinder
            pipes.append(Stem(origin + piece.low * axis, origin + piece.high * axis, radius, kind="pipe"))
    return pipes


def _seeds(cloud: Cloud, settings: ShapeSettings) -> tuple[list[Cylinder], Array]:
    """Cylinders that pieces of surface may belong to, those that agree best with themselves first; their places (k, 3).

    With P what is perpendicular to the axis, the radius r and the axis' place c minimize the sum of
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
        """What of covariances (k, 3, 3) is perpendicular to the axes (k,)."""
        along = np.einsum("ki,kij,kj->k", axis, covariances, axis)
        return np.asarray(np.trace(covariances, axis1=1, axis2=2) - along)

    spread = np.maximum(across(near.covariances(n, n)), 1e-9)
    common = across(near.covariances(p, n))
    radius = common / spread
    scatter = np.sqrt(np.maximum(across(near.covariances(p, p)) - common**2 / spread, 0.0))
    low, high = settings.pipe_radii
    good = (radius > 0.8 * low) & (radius < 1.25 * high) & (scatter < _MOST_SCATTER)
    good &= (spread > _LEAST_SPREAD) & (tilts[:, 0] < _MOST_TILT * spread)
    rows = np.flatnonzero(good)
    rows = rows[np.argsort(scatter[rows], kind="stable")]
    mean_p, mean_n = near.mean(p), near.mean(n)
    return [Cylinder(mean_p[k] - radius[k] * mean_n[k], axis[k], float(radius[k])) for k in rows], p[rows]


def _grow(seed: Cylinder, cloud: Cloud, tree: cKDTree, settings: ShapeSettings) -> _Piece | None:
    """What there is of a cylinder: refined and followed along its axis, twice as far each time."""
    piece: _Piece | None = None
    cylinder, reach = seed, max(0.04, 2.0 * seed.radius)
    for _ in range(_GROWTH_STEPS):
        near = cloud.select(np.array(tree.query_ball_point(cylinder.origin, reach), dtype=np.int64))
        refined = _refine(cylinder, near, settings)
        if refined is None:
            return None
        near = cloud.select(np.array(tree.query_ball_point(refined.origin, reach + refined.radius), dtype=np.int64))
        grown = _seen(refined, near, settings)
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


def _look(cylinder: Cylinder, cloud: Cloud) -> _Around:
    away = cloud.points - cylinder.origin
    along = away @ cylinder.axis
    away -= along[:, None] * cylinder.axis
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
    outward = away / distance[:, None]
    return _Around(along, outward, distance - cylinder.radius, (outward * cloud.normals).sum(axis=1))


def _refine(cylinder: Cylinder, near: Cloud, settings: ShapeSettings) -> Cylinder | None:
    """Gauss-Newton with Tukey weights on ``distance - radius``; points whose normals look away do not count."""
    low, high = settings.pipe_radii
    for scale in SCALES:
        along, outward, residual, alignment = _look(cylinder, near)
        weight = tukey_weights(residual, scale * settings.shell) * (alignment > 0.7)
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
        if not 0.8 * low < cylinder.radius < 1.25 * high:
            return None
    return cylinder


def _seen(cylinder: Cylinder, near: Cloud, settings: ShapeSettings) -> _Piece | None:
    """The stretch around a cylinder's origin in which its surface shows, short gaps bridged."""
    along, outward, residual, alignment = _look(cylinder, near)
    on = (np.abs(residual) < settings.shell) & (alignment > 0.7)
    u = outward @ frame_along(cylinder.axis)[:, :2]
    columns = int(np.ceil(2 * np.pi * cylinder.radius / _CELL))
    column = np.floor((np.arctan2(u[:, 1], u[:, 0]) / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    row = np.floor(along / _CELL).astype(np.int64)
    first = row.min()
    counts = np.zeros((row.max() - first + 1, columns), dtype=np.int64)
    np.add.at(counts, (row[on] - first, column[on]), 1)
    shows = counts >= 2
    seen = np.flatnonzero(shows.mean(axis=1) * 2 * np.pi > _ROW_ARC)
    if not len(seen):
        return None
    runs = np.split(seen, np.flatnonzero(np.diff(seen) > settings.pipe_gap / _CELL) + 1)
    run = min(runs, key=lambda r: max(r[0] + first, -(r[-1] + first), 0))  # the one at the origin
    low, high = (run[0] + first) * _CELL, (run[-1] + 1 + first) * _CELL
    within = (along >= low) & (along <= high)
    on &= within
    outside = within & (residual > settings.shell) & (residual < 3.5 * settings.shell)
    touched = int(np.count_nonzero(shows[run].mean(axis=0) > 0.3))
    return _Piece(
        cylinder,
        float(max(low, along[on].min())),
        float(min(high, along[on].max())),
        arc=max(touched - 1, 0) * 2 * np.pi / columns,  # an arc as wide as k columns touches k + 1 of them
        filled=len(run) / (run[-1] - run[0] + 1),
        alignment=float(alignment[on].mean()),
        tilt=float(np.sqrt(np.mean((near.normals[on] @ cylinder.axis) ** 2))),
        outside=np.count_nonzero(outside) / np.count_nonzero(on),
    )


def _is_pipe(piece: _Piece, settings: ShapeSettings) -> bool:
    """Whether a piece is longer than wide and round, whole, even and straight enough."""
    low, high = settings.pipe_radii
    return (
        low <= piece.cylinder.radius <= high
        and piece.high - piece.low >= 2 * piece.cylinder.radius
        and piece.arc >= settings.pipe_arc
        and piece.filled >= settings.pipe_filled
        and piece.alignment >= settings.pipe_alignment
        and piece.tilt <= settings.pipe_tilt
        and piece.outside <= settings.pipe_outside
    )


def _is_on(place: Array, pipe: Stem) -> bool:
    """Whether a place (3,) belongs to a pipe that is known already."""
    along = (pipe.end - pipe.start) / pipe.length
    away = place - pipe.start
    reach = float(away @ along)
    return -_CELL < reach < pipe.length + _CELL and float(np.linalg.norm(away - reach * along)) < pipe.radius + _CELL
