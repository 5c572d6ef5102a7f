"""Primitives as triangle meshes, written as PLY, OBJ and STL files by trimesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from greenhouse_gym.export.primitives import Primitive

if TYPE_CHECKING:
    from trimesh import Trimesh

FINENESS = 2
"""Subdivisions of round shapes: a sphere has 20 * 4**2 triangles, a cylinder 4 * 2**2 corners around its axis."""


def mesh_of(primitive: Primitive, fineness: int = FINENESS) -> Trimesh:
    """Return a primitive as a closed mesh in its world's frame, with vertices on its surface and triangles outward."""
    from trimesh import creation  # takes a second

    around = 4 * 2**fineness
    if primitive.kind == "box":
        mesh = creation.box(2 * np.array(primitive.size))
    elif primitive.kind in ("sphere", "ellipsoid"):
        mesh = creation.icosphere(fineness)
        mesh.vertices *= primitive.size
    elif primitive.kind == "capsule":
        radius, length = primitive.size
        mesh = creation.capsule(length, radius, count=[around // 2, around])
    else:
        radius, length = primitive.size
        mesh = creation.cylinder(radius, length, sections=around)
    mesh.apply_transform(primitive.pose)
    mesh.visual.vertex_colors = [*primitive.color, 1.0]
    return mesh


def ply(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one binary PLY file with colored vertices."""
    return bytes(_joined(parts).export(file_type="ply"))


def stl(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one binary STL file."""
    return bytes(_joined(parts).export(file_type="stl"))


def obj(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one OBJ file, one named object per primitive."""
    from trimesh import Scene
    from trimesh.exchange.obj import export_obj

    text = export_obj(
        Scene({part.name: mesh_of(part) for part in parts}), include_color=False, digits=5, header="metres, z up"
    )
    return str(text).encode()


def _joined(parts: Sequence[Primitive]) -> Trimesh:
    from trimesh import util

    return util.concatenate([mesh_of(part) for part in parts])
