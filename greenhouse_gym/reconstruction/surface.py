"""A cloud of few points, and a triangle mesh: what the paper imported into its simulator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.errors import FileFormatError, InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.open3d_loader import open3d
from greenhouse_gym.reconstruction.clouds import Cloud, to_open3d

METHODS = ("ball_pivoting", "poisson", "alpha_shape")
AnyCloud = TypeVar("AnyCloud", bound=Cloud)


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh: ``vertices`` (v, 3) metres, ``triangles`` (t, 3) vertex indices."""

    vertices: Array
    triangles: npt.NDArray[np.int64]


def simplify_points(cloud: AnyCloud, target: int = 10_000) -> AnyCloud:
    """Thin a cloud out evenly to about ``target`` points (within 5 %), keeping real points.

    The paper went from 295,490 points to a target of 10,000 (10,346). Points are kept that lie nearest to the centers
    of cubes, whose size is found by bisection.

    Args:
        cloud: Any cloud; what else it carries per point is kept.
        target: Points wanted; a cloud with fewer is returned unchanged.
    """
    if target < 1:
        raise InvalidValueError(f"target must be at least 1, got {target}")
    if len(cloud) <= target:
        return cloud
    extent = max(float(np.ptp(cloud.points, axis=0).max()), 1e-9)
    small, large = extent / 1e5, extent
    rows = np.arange(len(cloud))
    for _ in range(40):
        size = float(np.sqrt(small * large))
        rows = _one_per_cube(cloud.points, size)
        if abs(len(rows) - target) <= 0.02 * target:
            break
        small, large = (size, large) if len(rows) > target else (small, size)
    per_point = {
        name: value[rows]
        for name, value in vars(cloud).items()
        if isinstance(value, np.ndarray) and name in ("points", "colors", "normals", "station")
    }
    return replace(cloud, **per_point)


def _one_per_cube(points: Array, size: float) -> npt.NDArray[np.int64]:
    """Rows of the points nearest to the centers of the occupied cubes, in ascending order."""
    cubes = np.floor((points - points.min(axis=0)) / size)
    off_center = ((points - points.min(axis=0)) / size - cubes - 0.5) ** 2
    keys = (cubes[:, 0] * 2_000_003 + cubes[:, 1]) * 2_000_003 + cubes[:, 2]
    order = np.lexsort((off_center.sum(axis=1), keys))
    first = np.ones(len(order), dtype=bool)
    first[1:] = keys[order][1:] != keys[order][:-1]
    return np.sort(order[first])


def triangulate(cloud: Cloud, method: str = "ball_pivoting", faces: int | None = 18_000) -> TriangleMesh:
    """Triangulate a cloud, then decimate the mesh to a number of faces.

    Args:
        cloud: Points with normals.
        method: ``"ball_pivoting"``, ``"poisson"`` (trimmed where no points are near) or ``"alpha_shape"``.
        faces: Most faces wanted, by quadric decimation; None keeps all.

    Raises:
        UnknownNameError: No such method.
        InvalidValueError: Fewer than four points, or points in a plane for an alpha shape.
    """
    require_choice("meshing method", method, METHODS)
    if len(cloud) < 4:
        raise InvalidValueError(f"a mesh needs at least 4 points, got {len(cloud)}")
    o3d = open3d()
    points = to_open3d(cloud)
    spacing = float(np.median(points.compute_nearest_neighbor_distance()))
    mesh: Any
    if method == "ball_pivoting":
        radii = o3d.utility.DoubleVector([1.2 * spacing, 2.0 * spacing, 4.0 * spacing])
        mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(points, radii)
    elif method == "poisson":
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(points, depth=9, n_threads=1)
        mesh.remove_vertices_by_mask(cKDTree(cloud.points).query(np.asarray(mesh.vertices))[0] > 3.0 * spacing)
    else:
        try:
            mesh = o3d.geometry.TriangleMesh.create_from_point_cloud_alpha_shape(points, 3.0 * spacing)
        except RuntimeError as error:
            raise InvalidValueError(f"these {len(cloud)} points have no alpha shape: {error}") from error
    mesh = _clean(mesh)
    if faces is not None and len(mesh.triangles) > faces:
        mesh = _clean(mesh.simplify_quadric_decimation(faces))
    return TriangleMesh(np.array(mesh.vertices), np.array(mesh.triangles, dtype=np.int64))


def _clean(mesh: Any) -> Any:
    mesh.remove_degenerate_triangles()
    mesh.remove_duplicated_triangles()
    mesh.remove_unreferenced_vertices()
    return mesh


def save_points(cloud: Cloud, path: str | Path) -> None:
    """Write a cloud as a file that viewers open: PLY, PCD or XYZ, by the suffix.

    Raises:
        FileFormatError: The file could not be written.
    """
    _write(path, lambda name: open3d().io.write_point_cloud(name, to_open3d(cloud)))


def save_mesh(mesh: TriangleMesh, path: str | Path) -> None:
    """Write a mesh as a file that viewers open: PLY, OBJ or STL, by the suffix.

    Raises:
        FileFormatError: The file could not be written.
    """
    o3d = open3d()
    stored = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )
    stored.compute_vertex_normals()
    _write(path, lambda name: o3d.io.write_triangle_mesh(name, stored))


def _write(path: str | Path, write: Callable[[str], bool]) -> None:
    """Write to a temporary name of the same suffix, then rename."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    if not write(str(temporary)):
        temporary.unlink(missing_ok=True)
        raise FileFormatError(path, "could not be written")
    temporary.replace(path)
