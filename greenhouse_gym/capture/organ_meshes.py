"""Triangle mesh of the organs of a row and of the one behind it, with the shape that each triangle belongs to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.capture.light import Skin
from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.organs import THIN_KINDS
from greenhouse_gym.geometry import Array, Box, Capsule, Shape

_SHINE = {"fruit": 0.35, "leaf": 0.06, "calyx": 0.04, "pipe": 0.3, "gutter": 0.1}
_SPACING = 0.005  # m between points sampled in a shape


class RowMesh(NamedTuple):
    """Vertices (v, 3), appearance of the triangles, and the number (t,) of the shape that each belongs to."""

    vertices: Array
    skin: Skin
    owner: npt.NDArray[np.int32]


def mesh_of(row: PlantRow) -> RowMesh:
    """Build one mesh of a row of organs and the row behind it; shapes are numbered as in `RowRaycaster`."""
    vertices, triangles, colors, thin, shine, owner = [], [], [], [], [], []
    rows = [row] if row.behind is None else [row, row.behind]
    beyond = sum(len(one.tomatoes) + len(one.stems) + len(one.clutter) for one in rows)
    count, first = 0, 0
    for one in rows:
        owners = _owners(one, first, beyond)
        for organ, own in zip(one.organs, owners, strict=True):
            vertices.append(organ.vertices)
            triangles.append(organ.triangles + count)
            colors.append(organ.colors)
            thin.append(np.full(len(own), organ.kind in THIN_KINDS))
            shine.append(np.full(len(own), _SHINE.get(organ.kind, 0.02), dtype=np.float32))
            owner.append(own)
            count += len(organ.vertices)
        first += len(one.tomatoes) + len(one.stems) + len(one.clutter)
    points, corners = np.concatenate(vertices), np.concatenate(triangles)
    skin = Skin.of(points, corners, np.concatenate(colors), np.concatenate(thin), np.concatenate(shine))
    return RowMesh(points, skin, np.concatenate(owner).astype(np.int32))


def _owners(row: PlantRow, first: int, beyond: int) -> list[npt.NDArray[np.int64]]:
    """Return the shape that each triangle of each organ belongs to; the row's shapes are numbered from ``first``."""
    groups: dict[str, list[tuple[int, Shape]]] = {}
    for k, stem in enumerate(row.stems):
        groups.setdefault(stem.kind, []).append((first + len(row.tomatoes) + k, stem))
    for k, shape in enumerate(row.clutter):
        for kind in ("petiole",) if isinstance(shape, Capsule) else ("leaf", "gutter"):
            groups.setdefault(kind, []).append((first + len(row.tomatoes) + len(row.stems) + k, shape))
    trees = {kind: _search_tree(members) for kind, members in groups.items()}
    owners = []
    for organ in row.organs:
        count = len(organ.triangles)
        if organ.kind == "fruit" and organ.fruit is not None:
            owners.append(np.full(count, first + organ.fruit))
        elif organ.kind in trees:
            tree, numbers = trees[organ.kind]
            owners.append(numbers[tree.query(organ.vertices[organ.triangles].mean(axis=1))[1]])
        else:
            owners.append(np.full(count, beyond))
    return owners


def _search_tree(members: Sequence[tuple[int, Shape]]) -> tuple[cKDTree, npt.NDArray[np.int64]]:
    """Build a search tree over points in shapes; also return the number of each point's shape."""
    points = [_points_in(shape) for _, shape in members]
    numbers = [np.full(len(own), number) for own, (number, _) in zip(points, members, strict=True)]
    return cKDTree(np.concatenate(points)), np.concatenate(numbers)


def _points_in(shape: Shape) -> Array:
    """Sample points (n, 3) on a capsule's axis or in a box, about `_SPACING` apart."""
    if isinstance(shape, Capsule):
        fractions = np.linspace(0, 1, max(2, int(shape.length / _SPACING) + 1))
        return np.asarray(shape.start + fractions[:, None] * (shape.end - shape.start))
    if isinstance(shape, Box):
        steps = [np.linspace(-1, 1, min(40, max(1, int(2 * h / _SPACING)))) * h for h in shape.half_extents]
        grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        return np.asarray(shape.center + grid @ shape.rotation.T)
    return shape.center[None]
