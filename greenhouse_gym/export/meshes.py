"""Primitives as triangle meshes, and as PLY, OBJ and STL files."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.export.primitives import Primitive
from greenhouse_gym.geometry import Array, transform

AROUND = 16
"""Corners around a sphere, a capsule or a cylinder."""


class Mesh(NamedTuple):
    """Vertices (v, 3) in metres, and triangles (t, 3) that wind counter-clockwise seen from outside."""

    vertices: Array
    triangles: npt.NDArray[np.int64]


def mesh_of(primitive: Primitive, around: int = AROUND) -> Mesh:
    """A primitive as a closed mesh, whose vertices lie on its surface, in the frame of its world."""
    size = np.array(primitive.size)
    if primitive.kind == "box":
        corners, triangles = _cube()
        return Mesh(transform(primitive.pose, corners * size), triangles)
    directions, triangles = _ball(around)
    if primitive.kind in ("sphere", "ellipsoid"):
        return Mesh(transform(primitive.pose, directions * size), triangles)
    radius, length = primitive.size
    caps = directions * radius
    if primitive.kind == "cylinder":
        flat = np.linalg.norm(directions[:, :2], axis=1, keepdims=True)
        outward = directions[:, :2] / np.maximum(flat, 1e-9) * radius * (flat > 1e-6)
        caps = np.column_stack([outward, np.zeros(len(outward))])
    caps[:, 2] += np.where(directions[:, 2] > 0, length / 2, -length / 2)
    return Mesh(transform(primitive.pose, caps), triangles)


@lru_cache(maxsize=8)
def _ball(around: int) -> Mesh:
    """A unit ball; its rings lie above and below the equator, never on it, so that it can be pulled into a capsule."""
    rings = max(2, around // 2)
    angles = (np.arange(rings) + 0.5) / rings * np.pi
    turns = np.arange(around) / around * 2 * np.pi
    # the two rings next to the middle are at the equator itself, so that a capsule is as wide as it should be
    angles[rings // 2 - 1 : rings // 2 + 1] = [np.pi / 2 - 1e-6, np.pi / 2 + 1e-6]
    ring = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    body = [np.column_stack([np.sin(a) * ring, np.full(around, np.cos(a))]) for a in angles]
    vertices = np.concatenate([[[0.0, 0.0, 1.0]], *body, [[0.0, 0.0, -1.0]]])
    last = len(vertices) - 1
    k, following = np.arange(around), (np.arange(around) + 1) % around
    parts = [np.stack([np.zeros(around, int), 1 + k, 1 + following], axis=-1)]
    for r in range(rings - 1):
        upper, lower = 1 + r * around, 1 + (r + 1) * around
        parts.append(np.stack([upper + k, lower + k, lower + following], axis=-1))
        parts.append(np.stack([upper + k, lower + following, upper + following], axis=-1))
    bottom = 1 + (rings - 1) * around
    parts.append(np.stack([bottom + k, np.full(around, last), bottom + following], axis=-1))
    return Mesh(vertices, np.concatenate(parts))


@lru_cache(maxsize=1)
def _cube() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]))


def ply(parts: Sequence[Primitive]) -> bytes:
    """All primitives as one binary PLY file with colored vertices."""
    meshes = [mesh_of(part) for part in parts]
    colors = [
        np.tile(np.rint(255 * np.array(p.color)), (len(m.vertices), 1)) for p, m in zip(parts, meshes, strict=True)
    ]
    vertices, triangles = _joined(meshes)
    table = np.empty(len(vertices), dtype=[("position", "<f4", 3), ("color", "u1", 3)])
    table["position"], table["color"] = vertices, np.concatenate(colors)
    faces = np.empty(len(triangles), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        f"element face {len(triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    return header.encode("ascii") + table.tobytes() + faces.tobytes()


def obj(parts: Sequence[Primitive]) -> bytes:
    """All primitives as one OBJ file, each an object of its name."""
    lines, first = ["# metres, z up"], 1
    for part in parts:
        mesh = mesh_of(part)
        lines.append(f"o {part.name}")
        lines += [f"v {x:.5f} {y:.5f} {z:.5f}" for x, y, z in mesh.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + first).tolist()]
        first += len(mesh.vertices)
    return ("\n".join(lines) + "\n").encode("ascii")


def stl(parts: Sequence[Primitive]) -> bytes:
    """All primitives as one binary STL file."""
    vertices, triangles = _joined([mesh_of(part) for part in parts])
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    table = np.zeros(len(triangles), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    table["normal"], table["corners"] = normals, corners
    return b"metres, z up".ljust(80) + np.uint32(len(triangles)).tobytes() + table.tobytes()


def _joined(meshes: Sequence[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + offset for mesh, offset in zip(meshes, offsets[:-1], strict=True)]
    return Mesh(
        np.concatenate([np.zeros((0, 3)), *(mesh.vertices for mesh in meshes)]),
        np.concatenate([np.zeros((0, 3), int), *triangles]),
    )
