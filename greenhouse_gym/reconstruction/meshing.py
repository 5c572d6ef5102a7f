"""Thinned clouds and triangle meshes, which the paper imported into its simulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.errors import InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.geometry.point_clouds import Cloud, to_open3d

METHODS = ("ball_pivoting", "poisson", "alpha_shape")
AnyCloud = TypeVar("AnyCloud", bound=Cloud)

_PER_POINT = ("points", "colors", "normals", "station")
_FLAT = 1e-6  # height of a face over its longest edge, below which it has no area
_CUBES = 2**20  # maximum number along an axis: three such numbers fit into one of 63 bits


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh: ``vertices`` (v, 3) metres, ``triangles`` (t, 3) vertex indices."""

    vertices: Array
    triangles: npt.NDArray[np.int64]


def simplify_points(cloud: AnyCloud, target: int = 10_000) -> AnyCloud:
    """Thin a cloud evenly to about ``target`` points (within 5 %), a subset of its own.

    The paper went from 295,490 points to a target of 10,000 (10,346). The points nearest to the centers of cubes are
    kept; the size of the cubes is found by bisection. Where no size gives the target (repeated points, clusters very
    far apart), the points of the next larger cubes are kept, and the missing ones are taken evenly from those of the
    next smaller cubes, or from all.

    Args:
        cloud: Any cloud; its further arrays per point are thinned as well.
        target: Number of points; a cloud with no more is returned unchanged.

    Raises:
        InvalidValueError: The target is not positive, or a point or normal is not finite.
    """
    if target < 1:
        raise InvalidValueError(f"target must be at least 1, got {target}")
    _require_finite(cloud)
    if len(cloud) <= target:
        return cloud
    rows = _spread_out(cloud.points, target)
    return replace(cloud, **{name: getattr(cloud, name)[rows] for name in _PER_POINT if hasattr(cloud, name)})


def _require_finite(cloud: Cloud) -> None:
    """Raise `InvalidValueError` for anything other than a cloud of finite points and normals."""
    if not isinstance(cloud, Cloud):
        raise InvalidValueError(f"expected a Cloud of points, colors and normals, got {type(cloud).__name__}")
    for name, values in (("points", cloud.points), ("normals", cloud.normals)):
        broken = np.count_nonzero(~np.isfinite(values).all(axis=1))
        if broken:
            raise InvalidValueError(f"{broken} of {len(values)} {name} are not finite numbers")


def triangulate(cloud: Cloud, method: str = "ball_pivoting", faces: int | None = 18_000) -> TriangleMesh:
    """Triangulate a cloud, then decimate the mesh to a number of faces; the result passes `check_mesh`.

    All lengths of the methods follow from the cloud's spacing. Points that (nearly) coincide with another are dropped.

    Args:
        cloud: Points with normals. ``"alpha_shape"`` needs no normals; the others drop points whose normal is 0.
        method: ``"ball_pivoting"``, ``"poisson"`` (trimmed where no points are near) or ``"alpha_shape"``.
        faces: Maximum number of faces, by quadric decimation; None keeps all.

    Raises:
        UnknownNameError: The method is not known.
        InvalidValueError: Fewer than four different points, points or normals that are not finite, no normals, points
            on which the method finds no surface (such as points in a plane for an alpha shape), or fewer than one face.
    """
    require_choice("meshing method", method, METHODS)
    if faces is not None and faces < 1:
        raise InvalidValueError(f"faces must be at least 1, or None for all, got {faces}")
    _require_finite(cloud)
    cloud = replace(cloud, normals=np.zeros_like(cloud.points)) if method == "alpha_shape" else _with_normals(cloud)
    rows, spacing = _distinct_points(cloud.points)
    cloud = cloud.select(rows)
    middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
    # Open3D gets lengths in units of the spacing, around 0: it computes partly with 32 bits
    found = _surface(replace(cloud, points=(cloud.points - middle) / spacing), method)
    mesh = _clean(found.vertices, found.triangles)
    if not len(mesh.triangles):
        raise InvalidValueError(f"{method} found no surface in these {len(cloud)} points")
    if faces is not None and len(mesh.triangles) > faces:
        mesh = _decimate(mesh, faces)
    mesh = _clean(middle + spacing * mesh.vertices, mesh.triangles)
    check_mesh(mesh)
    return mesh


def _with_normals(cloud: Cloud) -> Cloud:
    """Return the points that have a normal, with normals of unit length."""
    length = np.linalg.norm(cloud.normals, axis=1)
    usable = np.flatnonzero(length > 1e-9)
    if len(usable) == 0 or len(length) != len(cloud):
        raise InvalidValueError(f"these {len(cloud)} points have no normals; only alpha_shape works without")
    cloud = cloud.select(usable)
    return replace(cloud, normals=cloud.normals / length[usable, None])


def _surface(cloud: Cloud, method: str) -> Any:
    """Return Open3D's mesh of a cloud with a spacing of about 1."""
    o3d = open3d()
    points, create = to_open3d(cloud), o3d.geometry.TriangleMesh
    if method == "ball_pivoting":
        return create.create_from_point_cloud_ball_pivoting(points, o3d.utility.DoubleVector([1.2, 2.0, 4.0]))
    if method == "poisson":
        depth = int(np.clip(np.log2(np.ptp(cloud.points, axis=0).max()), 5, 10))
        mesh, _ = create.create_from_point_cloud_poisson(points, depth=depth, n_threads=1)
        mesh.remove_vertices_by_mask(cKDTree(cloud.points).query(np.asarray(mesh.vertices))[0] > 3.0)
        return mesh
    try:
        return create.create_from_point_cloud_alpha_shape(points, 3.0)
    except RuntimeError as error:
        reason = "they lie in a plane or on a sphere"
        raise InvalidValueError(f"these {len(cloud)} points have no alpha shape: {reason}") from error


def _decimate(mesh: TriangleMesh, faces: int) -> TriangleMesh:
    """Reduce a mesh to at most ``faces`` faces by quadric decimation, or by merging the vertices within cubes.

    Quadric decimation stops early where many faces share an edge, as in alpha shapes.
    """
    stopped = mesh_to_open3d(mesh).simplify_quadric_decimation(faces)
    fewer = _clean(stopped.vertices, stopped.triangles)
    if len(fewer.triangles) > faces:
        small, large = 0.0, float(np.ptp(mesh.vertices, axis=0).max())
        for _ in range(16):
            size = (small + large) / 2
            merged = stopped.simplify_vertex_clustering(size)
            candidate = _clean(merged.vertices, merged.triangles)
            if len(candidate.triangles) > faces:
                small = size
            else:
                large, fewer = size, candidate
    if not 0 < len(fewer.triangles) <= faces:
        raise InvalidValueError(f"a mesh of {len(mesh.triangles)} faces cannot be decimated to {faces}")
    return fewer


def check_mesh(mesh: TriangleMesh) -> None:
    """Raise `InvalidValueError`, naming every fault, for a mesh that other programs would reject.

    Faults: vertices that are not finite or that no face uses; indices out of range; faces without area or duplicated.
    """
    vertices, triangles = mesh.vertices, mesh.triangles
    outside = (triangles < 0) | (triangles >= len(vertices))
    if outside.any():
        raise InvalidValueError(
            f"broken mesh: {outside.any(axis=1).sum()} of {len(triangles)} faces name vertices that do not exist"
        )
    faults = {
        "vertices that are not finite": np.count_nonzero(~np.isfinite(vertices).all(axis=1)),
        "vertices that no face uses": len(vertices) - len(np.unique(triangles)),
        "faces without area": np.count_nonzero(~_with_area(vertices, triangles)),
        "duplicate faces": len(triangles) - len(_first_of_each(np.sort(triangles, axis=1))),
    }
    if any(faults.values()):
        named = ", ".join(f"{count} {fault}" for fault, count in faults.items() if count)
        raise InvalidValueError(f"broken mesh of {len(vertices)} vertices and {len(triangles)} faces: {named}")


def _with_area(vertices: Array, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Mask the faces (t,) that are not degenerate; faces with a vertex that is not finite are degenerate."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    longest = np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) > _FLAT * longest)


def _clean(vertices: Any, triangles: Any) -> TriangleMesh:
    """Remove the faults that `check_mesh` names; of faces with the same vertices the first stays.

    Vertices (v, 3), metres, and triangles (t, 3), indices in range, are arrays or Open3D's vectors.
    """
    vertices, triangles = np.asarray(vertices), np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    triangles = triangles[_with_area(vertices, triangles)]
    triangles = triangles[_first_of_each(np.sort(triangles, axis=1))]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return TriangleMesh(vertices[used], renumbered.reshape(-1, 3))


def mesh_to_open3d(mesh: TriangleMesh) -> Any:
    """Convert a mesh to Open3D's legacy mesh."""
    o3d = open3d()
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )


def _spread_out(points: Array, target: int) -> npt.NDArray[np.int64]:
    """Return the rows of ``target`` points (within 2 %) out of more, spread evenly, in ascending order."""
    local = points - points.min(axis=0)
    extent = float(local.max()) or 1.0
    small, large = extent / _CUBES, 2.0 * extent
    while large > 1.0001 * small:
        size = float(np.sqrt(small * large))
        count = 1 + np.count_nonzero(np.diff(np.sort(_cubes(local, size))))
        if abs(count - target) <= 0.02 * target:
            return _one_per_cube(local, size)
        small, large = (size, large) if count > target else (small, size)
    kept, finer = _one_per_cube(local, large), _one_per_cube(local, small)
    others = np.setdiff1d(finer if len(finer) >= target else np.arange(len(points)), kept)
    missing = target - len(kept)
    return np.sort(np.concatenate([kept, others[np.arange(missing) * len(others) // missing]]))


def _cubes(local: Array, size: float) -> npt.NDArray[np.int64]:
    """Return the number (n,) of the cube that each point lies in; points (n, 3) have no negative coordinates."""
    x, y, z = (local.T / size).astype(np.int64)
    return np.asarray(x << 42 | y << 21 | z)


def _one_per_cube(local: Array, size: float) -> npt.NDArray[np.int64]:
    """Return the rows of the points nearest to the centers of the occupied cubes, in ascending order."""
    order = np.argsort(((local / size % 1.0 - 0.5) ** 2).sum(axis=1), kind="stable")
    return np.sort(order[_first_of_each(_cubes(local[order], size)[:, None])])


def _first_of_each(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return the first row of each group of equal ``values`` (n, k), ascending (`numpy.unique`, but faster)."""
    order = np.lexsort(values.T)
    first = np.ones(len(order), dtype=bool)
    first[1:] = (np.diff(values[order], axis=0) != 0).any(axis=1)
    return np.sort(order[first])


def _distinct_points(points: Array) -> tuple[npt.NDArray[np.int64], float]:
    """Return the rows of points without (near) duplicates, and the spacing of those points, metres."""
    rows = _first_of_each(points)
    spacing = _spacing(points[rows])
    cubes = np.floor((points[rows] - points.min(axis=0)) / (0.2 * spacing))
    rows = rows[_first_of_each(cubes)]
    rows = np.delete(rows, cKDTree(points[rows]).query_pairs(0.1 * spacing, output_type="ndarray")[:, 1])
    return rows, _spacing(points[rows])


def _spacing(points: Array) -> float:
    """Return the usual distance between neighbors, metres, robust against a few near duplicates.

    In clouds thinned to one point per cube the sixth neighbor is 1.7 times as far as the first.
    """
    if len(points) < 4:
        raise InvalidValueError(f"a mesh needs at least 4 points, got {len(points)} different ones")
    subset = points[:: len(points) // 20_000 + 1]
    return float(np.median(cKDTree(points).query(subset, k=[min(7, len(points))])[0])) / 1.7
