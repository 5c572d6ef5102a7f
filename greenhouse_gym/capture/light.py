"""Organ meshes of a row, and light on them: sun with shadows, sky, light through leaves, gloss and exposure.

Shading is done in linear light; input and output colors are coded with a gamma of 2.2, as photographs are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from greenhouse_gym.crops import PlantRow
from greenhouse_gym.crops.organs import THIN_KINDS
from greenhouse_gym.geometry import Array, Box, Capsule, Shape

GAMMA = 2.2
Pixels: TypeAlias = npt.NDArray[np.float32]

_SKY = np.array([0.0, 0.0, 1.0], dtype=np.float32)

_SHINE = {"fruit": 0.35, "leaf": 0.06, "calyx": 0.04, "pipe": 0.3, "gutter": 0.1}
_SPACING = 0.005  # m between points sampled in a shape


@dataclass(frozen=True)
class Light:
    """The light in a greenhouse and the camera's settings.

    Attributes:
        azimuth: Direction of the sun about z, radians; pi is behind cameras that face the row.
        elevation: Height of the sun, radians.
        sun: Strength of the direct part; with ``diffuse`` = 1 about that of a hazy day, 0 is overcast.
        diffuse: Strength of the sky's part.
        white_balance: Gains of red, green and blue that the camera leaves uncorrected.
        exposure: Gain of all channels; above 1 highlights burn out.
        gloss: Strength of highlights on fruit and leaves.
        flicker: One sigma of the sun's strength from station to station, as clouds pass, and a third of it that of the
            exposure from image to image; relative.
    """

    azimuth: float = float(np.pi)
    elevation: float = 0.9
    sun: float = 0.6
    diffuse: float = 0.8
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exposure: float = 1.0
    gloss: float = 0.5
    flicker: float = 0.1

    @property
    def toward_sun(self) -> npt.NDArray[np.float32]:
        """Unit vector (3,) float32 to the sun in the world."""
        level = np.cos(self.elevation)
        toward = [level * np.cos(self.azimuth), level * np.sin(self.azimuth), np.sin(self.elevation)]
        return np.array(toward, dtype=np.float32)

    def at_station(self, rng: np.random.Generator) -> Light:
        """Sample the light at one station: clouds and exposure vary."""
        sun, exposure = np.exp(self.flicker * rng.normal(0.0, [1.0, 1 / 3]))
        return replace(self, sun=self.sun * float(sun), exposure=self.exposure * float(exposure))


def draw_light(rng: np.random.Generator) -> Light:
    """Sample the light of a greenhouse, from overcast to direct sun from any side (prior).

    The camera meters on the whole light, so that leaves come out at about a third of full white.
    """
    sun, diffuse = rng.uniform(0.0, 1.2), rng.uniform(0.6, 1.0)
    return Light(
        azimuth=rng.uniform(0, 2 * np.pi),
        elevation=rng.uniform(0.35, 1.1),
        sun=sun,
        diffuse=diffuse,
        white_balance=tuple(float(np.exp(rng.normal(0, s))) for s in (0.05, 0.0, 0.08)),  # type: ignore[arg-type]
        exposure=1.9 / (0.4 * sun + diffuse) * float(np.exp(rng.normal(0, 0.2))),
        gloss=rng.uniform(0.3, 0.8),
    )


@dataclass(frozen=True, eq=False)
class Skin:
    """Appearance of the triangles of a mesh."""

    colors: npt.NDArray[np.float32]  # (2, t, 3) linear color of the outer and of the inner side under white light
    normals: npt.NDArray[np.float32]  # (v, 3) unit normals at the vertices, outwards
    corners: npt.NDArray[np.int64]  # (t, 3) vertex indices of the triangles
    thin: npt.NDArray[np.float32]  # (t,) 1 where light is transmitted, as by leaves, else 0
    shine: npt.NDArray[np.float32]  # (t,) strength of highlights

    @classmethod
    def of(
        cls,
        vertices: Array,
        corners: npt.NDArray[np.int64],
        colors: Array,
        thin: npt.NDArray[np.bool_],
        shine: npt.NDArray[np.float32],
    ) -> Skin:
        """Build the skin of a mesh with coded colors (t, 3) in [0, 1]; the undersides of thin triangles are paler."""
        sides = np.stack([colors, np.where(thin[:, None], _underside(colors), colors)]).astype(np.float32) ** GAMMA
        normals = _vertex_normals(vertices, corners).astype(np.float32)
        return cls(sides, normals, corners, thin.astype(np.float32), shine)

    def normals_at(self, triangles: npt.NDArray[np.int64], weights: Pixels) -> Pixels:
        """Interpolate unit normals (n, 3) on triangles (n,), at weights (n, 2) of their second and third corner."""
        a, b, c = (self.normals[self.corners[triangles, k]] for k in range(3))
        u, v = weights[:, :1], weights[:, 1:]
        normals = (1 - u - v) * a + u * b + v * c
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)


def _vertex_normals(vertices: Array, triangles: npt.NDArray[np.int64]) -> Array:
    """Average the normals of the triangles around each vertex by area, unit normals (v, 3)."""
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    flat = np.cross(b - a, c - a)
    summed = np.stack(
        [np.bincount(triangles.ravel(), np.repeat(flat[:, k], 3), len(vertices)) for k in range(3)], axis=1
    )
    return summed / np.maximum(np.linalg.norm(summed, axis=1, keepdims=True), 1e-15)


def shade(
    skin: Skin,
    light: Light,
    triangles: npt.NDArray[np.int64],
    normals: Pixels,
    directions: Pixels,
    sunlit: npt.NDArray[np.bool_],
) -> tuple[Pixels, Pixels]:
    """Shade points on triangles (n,): coded colors (n, 3), not yet clipped, and linear brightness of highlights (n,).

    ``normals`` (n, 3) are outward unit vectors, ``directions`` (n, 3) rays from the camera, ``sunlit`` (n,) marks
    points in direct sun.
    """
    toward_camera = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    facing = np.sign((normals * toward_camera).sum(axis=1) + 1e-9)
    lit, thin, shine = sunlit.astype(np.float32), skin.thin[triangles], skin.shine[triangles]
    base = skin.colors[(facing < 0).astype(np.int64), triangles]
    normals = normals * facing[:, None]
    sun = normals @ light.toward_sun
    direct = light.sun * np.clip(sun, 0, None) * lit
    diffuse = light.diffuse * (0.45 + 0.3 * normals[:, 2] + 0.25 * np.clip((normals * toward_camera).sum(axis=1), 0, 1))
    through = light.sun * np.clip(-sun, 0, None) * lit * thin
    color = base * (direct + diffuse)[:, None] + _transmitted(base) * through[:, None]
    glare = np.zeros(len(color), dtype=np.float32)
    for source, strength, width in ((light.toward_sun, light.sun * lit, 60), (_SKY, 0.25 * light.diffuse, 12)):
        half = toward_camera + source
        half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
        glare += light.gloss * shine * strength * np.clip((normals * half).sum(axis=1), 0, 1) ** width
    color = (color + glare[:, None]) * np.array(light.white_balance, dtype=np.float32) * np.float32(light.exposure)
    return np.clip(color, 0, None) ** np.float32(1 / GAMMA), glare * light.exposure


def _underside(color: Array) -> Array:
    """Return the color of a leaf's underside: a quarter lighter and paler (prior)."""
    gray = color.mean(axis=1, keepdims=True)
    return np.clip(1.25 * (0.75 * color + 0.25 * gray), 0, 1)


def _transmitted(base: Pixels) -> Pixels:
    """Return the linear color of light transmitted by a leaf.

    It is a yellower green than reflected light: in LOPEX93 the redness of tomato leaves falls from -0.09 reflected to
    -0.16 transmitted, and about half as much light is transmitted as reflected in the green.
    """
    return base * np.array([0.55, 0.65, 0.25], dtype=np.float32)


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
