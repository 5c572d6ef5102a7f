"""A cloud of few points, and a triangle mesh: what the paper imported into its simulator."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.common.files import write_atomically
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.errors import FileFormatError, FileWriteError, InvalidValueError, require_choice
from greenhouse_gym.geometry import Array
from greenhouse_gym.reconstruction.point_clouds import Cloud, to_open3d
from greenhouse_gym.reconstruction.thinning import apart, first_of_each, spread_out

METHODS = ("ball_pivoting", "poisson", "alpha_shape")
AnyCloud = TypeVar("AnyCloud", bound=Cloud)

_PER_POINT = ("points", "colors", "normals", "station")
_FLAT = 1e-6
"""A face lower than this share of its longest edge has no area."""


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A mesh: ``vertices`` (v, 3) metres, ``triangles`` (t, 3) vertex indices."""

    vertices: Array
    triangles: npt.NDArray[np.int64]


# -- fewer points -----------------------------------------------------------------------------------------------------


def simplify_points(cloud: AnyCloud, target: int = 10_000) -> AnyCloud:
    """Thin a cloud out evenly to about ``target`` points (within 5 %), keeping real points.

    The paper went from 295,490 points to a target of 10,000 (10,346). Points are kept that lie nearest to the centers
    of cubes, whose size is found by bisection. Where no size gives the wished number (points that repeat each other,
    clusters very far apart), the points of the cubes just too large are taken, and evenly as many of the cubes just too
    small, or of all, as are missing.

    Args:
        cloud: Any cloud; what else it carries per point is kept.
        target: Points wanted; a cloud with no more is returned unchanged.

    Raises:
        InvalidValueError: The target is not positive, or a point or normal is not finite.
    """
    if target < 1:
        raise InvalidValueError(f"target must be at least 1, got {target}")
    _require_finite(cloud)
    if len(cloud) <= target:
        return cloud
    rows = spread_out(cloud.points, target)
    return replace(cloud, **{name: getattr(cloud, name)[rows] for name in _PER_POINT if hasattr(cloud, name)})


def _require_finite(cloud: Cloud) -> None:
    """Raise `InvalidValueError` for what is no cloud, and for points or normals that are NaN or infinite."""
    if not isinstance(cloud, Cloud):
        raise InvalidValueError(f"expected a Cloud of points, colors and normals, got {type(cloud).__name__}")
    for name, values in (("points", cloud.points), ("normals", cloud.normals)):
        broken = np.count_nonzero(~np.isfinite(values).all(axis=1))
        if broken:
            raise InvalidValueError(f"{broken} of {len(values)} {name} are not finite numbers")


# -- meshes -----------------------------------------------------------------------------------------------------------


def triangulate(cloud: Cloud, method: str = "ball_pivoting", faces: int | None = 18_000) -> TriangleMesh:
    """Triangulate a cloud, then decimate the mesh to a number of faces; the result passes `check_mesh`.

    All lengths of the methods follow from the cloud's spacing. Points that (nearly) repeat another are left out.

    Args:
        cloud: Points with normals. ``"alpha_shape"`` needs no normals; the others leave out points whose normal is 0.
        method: ``"ball_pivoting"``, ``"poisson"`` (trimmed where no points are near) or ``"alpha_shape"``.
        faces: Most faces wanted, by quadric decimation; None keeps all.

    Raises:
        UnknownNameError: No such method.
        InvalidValueError: Fewer than four different points, points or normals that are not finite, no normals, points
            on which the method finds no surface (such as points in a plane for an alpha shape), or fewer than one face.
    """
    require_choice("meshing method", method, METHODS)
    if faces is not None and faces < 1:
        raise InvalidValueError(f"faces must be at least 1, or None for all, got {faces}")
    _require_finite(cloud)
    cloud = replace(cloud, normals=np.zeros_like(cloud.points)) if method == "alpha_shape" else _with_normals(cloud)
    rows, spacing = apart(cloud.points)
    cloud = cloud.select(rows)
    middle = (cloud.points.min(axis=0) + cloud.points.max(axis=0)) / 2
    # Open3D gets lengths in units of the spacing, around 0: it computes in part with 32 bits
    found = _surface(replace(cloud, points=(cloud.points - middle) / spacing), method)
    mesh = _cleaned(found.vertices, found.triangles)
    if not len(mesh.triangles):
        raise InvalidValueError(f"{method} found no surface in these {len(cloud)} points")
    if faces is not None and len(mesh.triangles) > faces:
        mesh = _decimated(mesh, faces)
    mesh = _cleaned(middle + spacing * mesh.vertices, mesh.triangles)
    check_mesh(mesh)
    return mesh


def _with_normals(cloud: Cloud) -> Cloud:
    """The points that have a normal, with normals of unit length."""
    length = np.linalg.norm(cloud.normals, axis=1)
    usable = np.flatnonzero(length > 1e-9)
    if len(usable) == 0 or len(length) != len(cloud):
        raise InvalidValueError(f"these {len(cloud)} points have no normals; only alpha_shape can do without")
    cloud = cloud.select(usable)
    return replace(cloud, normals=cloud.normals / length[usable, None])


def _surface(cloud: Cloud, method: str) -> Any:
    """Open3D's mesh of a cloud whose points lie about 1 apart."""
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
        where = "they lie in a plane or on a sphere"
        raise InvalidValueError(f"these {len(cloud)} points have no alpha shape: {where}") from error


def _decimated(mesh: TriangleMesh, faces: int) -> TriangleMesh:
    """At most ``faces`` faces by quadric decimation; where it stops early, by merging the vertices within cubes.

    Quadric decimation stops early where many faces share an edge, as in alpha shapes.
    """
    stopped = _to_open3d(mesh).simplify_quadric_decimation(faces)
    fewer = _cleaned(stopped.vertices, stopped.triangles)
    if len(fewer.triangles) > faces:
        small, large = 0.0, float(np.ptp(mesh.vertices, axis=0).max())
        for _ in range(16):
            size = (small + large) / 2
            merged = stopped.simplify_vertex_clustering(size)
            candidate = _cleaned(merged.vertices, merged.triangles)
            if len(candidate.triangles) > faces:
                small = size
            else:
                large, fewer = size, candidate
    if not 0 < len(fewer.triangles) <= faces:
        raise InvalidValueError(f"a mesh of {len(mesh.triangles)} faces cannot be decimated to {faces}")
    return fewer


def check_mesh(mesh: TriangleMesh) -> None:
    """Raise `InvalidValueError`, naming every fault, for a mesh that other programs would stumble over.

    Faults: vertices that are not finite or that no face uses; indices out of range; faces without area or that are
    there twice.
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
        "faces that are there twice": len(triangles) - len(first_of_each(np.sort(triangles, axis=1))),
    }
    if any(faults.values()):
        named = ", ".join(f"{count} {fault}" for fault, count in faults.items() if count)
        raise InvalidValueError(f"broken mesh of {len(vertices)} vertices and {len(triangles)} faces: {named}")


def _with_area(vertices: Array, triangles: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Which faces (t,) are not degenerate; faces with a vertex that is not finite count as degenerate."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    longest = np.maximum.reduce([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) > _FLAT * longest)


def _cleaned(vertices: Any, triangles: Any) -> TriangleMesh:
    """A mesh without the faults that `check_mesh` names; of faces with the same vertices the first stays.

    Args:
        vertices: (v, 3) metres, an array or Open3D's vector.
        triangles: (t, 3) vertex indices, all in range, an array or Open3D's vector.
    """
    vertices, triangles = np.asarray(vertices), np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    triangles = triangles[_with_area(vertices, triangles)]
    triangles = triangles[first_of_each(np.sort(triangles, axis=1))]
    used, renumbered = np.unique(triangles, return_inverse=True)
    return TriangleMesh(vertices[used], renumbered.reshape(-1, 3))


def _to_open3d(mesh: TriangleMesh) -> Any:
    o3d = open3d()
    return o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles.astype(np.int32))
    )


# -- files ------------------------------------------------------------------------------------------------------------


def save_points(cloud: Cloud, path: str | Path) -> None:
    """Write a cloud as a file that viewers open: PLY, PCD or XYZ, by the suffix.

    Raises:
        FileFormatError: No such suffix is known.
        FileWriteError: The file could not be written, say because the disk is full.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".ply":  # on a full disk Open3D leaves a part of these without a word, and ends the process over .xyz
        write_atomically(path, _ply(cloud))
    elif suffix == ".xyz":
        np.savetxt(table := io.BytesIO(), cloud.points, "%.10f")
        write_atomically(path, table.getvalue())
    else:
        o3d = open3d().io
        _write(
            path,
            lambda name: o3d.write_point_cloud(name, to_open3d(cloud)),
            lambda name: len(o3d.read_point_cloud(name).points) == len(cloud),
        )


def _ply(cloud: Cloud) -> bytes:
    """A cloud as the content of a binary PLY file."""
    table = np.empty(len(cloud), np.dtype([("points", "<f8", 3), ("normals", "<f4", 3), ("colors", "u1", 3)]))
    table["points"], table["normals"] = cloud.points, cloud.normals
    table["colors"] = np.rint(255 * np.clip(cloud.colors, 0, 1))
    kinds = {"double": ("x", "y", "z"), "float": ("nx", "ny", "nz"), "uchar": ("red", "green", "blue")}
    properties = "".join(f"property {kind} {name}\n" for kind, names in kinds.items() for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(cloud)}\n{properties}end_header\n"
    return header.encode() + table.tobytes()


def save_mesh(mesh: TriangleMesh, path: str | Path) -> None:
    """Write a mesh as a file that viewers open: PLY, OBJ or STL, by the suffix.

    Raises:
        FileFormatError: No such suffix is known.
        FileWriteError: The file could not be written, say because the disk is full.
    """
    o3d, stored = open3d().io, _to_open3d(mesh)
    stored.compute_vertex_normals()
    _write(
        path,
        lambda name: o3d.write_triangle_mesh(name, stored),
        lambda name: len(o3d.read_triangle_mesh(name).triangles) == len(mesh.triangles),
    )


def _write(path: str | Path, write: Callable[[str], bool], whole: Callable[[str], bool]) -> None:
    """Write to a temporary name of the same suffix, then rename.

    Open3D reports success on a full disk too, so the file must prove ``whole`` when it is read again.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not write(str(temporary)):
            raise FileFormatError(path, "could not be written")
        if not whole(str(temporary)):
            raise OSError("only a part of it; is the disk full?")
        temporary.replace(path)
    except OSError as error:
        raise FileWriteError(path, error) from error
    finally:
        if temporary.exists():
            temporary.unlink()
