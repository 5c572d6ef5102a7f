"""Ray casting of a row: depth, shape and shaded color of each pixel, by Open3D's Embree scene without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.capture.light import Light, Skin, mesh_of, shade
from greenhouse_gym.capture.rig import Intrinsics
from greenhouse_gym.common.open3d_loader import open3d
from greenhouse_gym.crops import Palette, PlantRow
from greenhouse_gym.crops.crop import GUTTER_COLOR
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, frame_along, invert

_BACKGROUND = (0.75, 0.80, 0.82)


class View(NamedTuple):
    """A camera's view: depth (h, w) metres (inf = background), shape (h, w) index or -1, color (h, w, 3) uint8.

    ``glare`` (h, w) is the brightness that highlights add, as a fraction of full white; on rows of organs only.
    """

    depth: npt.NDArray[np.float32]
    shape: npt.NDArray[np.int32]
    color: npt.NDArray[np.uint8]
    glare: npt.NDArray[np.float32] | None = None


@dataclass(frozen=True, eq=False)
class RowRaycaster:
    """A row prepared for ray casting."""

    scene: Any  # Open3D's RaycastingScene with one mesh of all shapes
    owner: npt.NDArray[np.int32]  # (triangles,) index of the shape that each triangle belongs to
    axes: Array  # (shapes, 2, 3) ends of the shapes' axes; both the center for spheres and boxes
    round: npt.NDArray[np.bool_]  # (shapes,) whether a shape's normal points away from its axis
    colors: Array  # (shapes, 3) base color, 0-1
    skin: Skin | None = None  # appearance of the triangles of a row of organs; None for a row of primitives
    light: Light = field(default_factory=Light)  # light on a row of organs

    @classmethod
    def of(cls, row: PlantRow, light: Light | None = None) -> RowRaycaster:
        """Prepare a row and the one behind it; shapes are numbered tomatoes, stems, clutter, then the row behind.

        For a row of organs the meshes are cast: triangles of fruit belong to its tomato, those of stems and leaves to
        the nearest capsule or piece of clutter, and all others get numbers beyond all shapes. Rows of primitives have
        fixed light.
        """
        if row.organs:
            mesh = mesh_of(row)
            none = np.zeros((0, 2, 3))
            scene, flat = _scene(mesh.vertices, mesh.skin.corners), np.zeros(0, dtype=bool)
            return cls(scene, mesh.owner, none, flat, none[:, 0], mesh.skin, light or Light())
        shapes: list[Shape] = []
        colors: list[Array] = []
        rng, palette = np.random.default_rng(0), row.palette
        while True:
            shapes += row.shapes
            colors += [_fruit_color(palette, t.ripeness) for t in row.tomatoes]
            colors += [np.array(palette.stems[stem.kind]) for stem in row.stems]
            colors += [np.array(GUTTER_COLOR if _is_gutter(shape) else palette.leaf) for shape in row.clutter]
            if row.behind is None:
                break
            row = row.behind
        vertices, triangles, owner = tessellate(shapes)
        scene = _scene(vertices, triangles)
        axes = np.array(
            [[s.start, s.end] if isinstance(s, Capsule) else [s.center, s.center] for s in shapes], dtype=np.float64
        )
        jitter = rng.normal(1.0, 0.05, (len(shapes), 1))
        rounds = np.array([not isinstance(s, Box | Ellipsoid) for s in shapes])
        return cls(scene, owner, axes, rounds, np.clip(np.array(colors) * jitter, 0, 1))

    def render(self, world_from_camera: Array, intrinsics: Intrinsics) -> View:
        """Render the view of a camera at ``world_from_camera`` (4, 4), one ray per pixel."""
        rays, hits = self._cast(world_from_camera, intrinsics)
        depth, shape = self._found(hits)
        hit = shape >= 0
        color, glare = np.empty((*depth.shape, 3)), None
        color[:] = _BACKGROUND
        directions = rays.numpy()[..., 3:]
        points = rays.numpy()[..., :3][hit] + depth[hit][:, None] * directions[hit]
        if self.skin is None:
            normals = self._normals(points, shape[hit], hits["primitive_normals"].numpy()[hit])
            color[hit] = _shade(self.colors[shape[hit]], normals, directions[hit])
        else:
            triangles = hits["primitive_ids"].numpy()[hit].astype(np.int64)
            smooth = self.skin.normals_at(triangles, hits["primitive_uvs"].numpy()[hit])
            glare = np.zeros(depth.shape, dtype=np.float32)
            sunlit = self._sunlit(points)
            color[hit], glare[hit] = shade(self.skin, self.light, triangles, smooth, directions[hit], sunlit)
        return View(depth, shape, (np.clip(color, 0, 1) * 255).astype(np.uint8), glare)

    def measure(
        self, world_from_camera: Array, intrinsics: Intrinsics
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Return depth and shape of `render`, without the color, which takes most of its time."""
        return self._found(self._cast(world_from_camera, intrinsics)[1])

    def _cast(self, world_from_camera: Array, intrinsics: Intrinsics) -> tuple[Any, Any]:
        """Return Open3D's rays, one per pixel, and their hits."""
        o3d = open3d()
        # Open3D counts pixels from their corners, the package (as OpenCV) from their centers
        corner_based = intrinsics.matrix + [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]
        rays = self.scene.create_rays_pinhole(
            o3d.core.Tensor(corner_based),
            o3d.core.Tensor(invert(world_from_camera)),
            intrinsics.width,
            intrinsics.height,
        )
        return rays, self.scene.cast_rays(rays)

    def _sunlit(self, points: Array) -> npt.NDArray[np.bool_]:
        """Mask the points (n, 3) in direct sun."""
        toward = np.broadcast_to(self.light.toward_sun, points.shape)
        rays = np.concatenate([points + 1e-3 * toward, toward], axis=1).astype(np.float32)
        return ~np.asarray(self.scene.test_occlusions(open3d().core.Tensor(rays)).numpy())

    def _found(self, hits: Any) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        depth = hits["t_hit"].numpy()
        hit = np.isfinite(depth)
        shape = np.full(depth.shape, -1, dtype=np.int32)
        shape[hit] = self.owner[hits["primitive_ids"].numpy()[hit]]
        return depth, shape

    def _normals(self, points: Array, shape: npt.NDArray[np.int32], flat: Array) -> Array:
        start, end = self.axes[shape, 0], self.axes[shape, 1]
        axis = end - start
        fraction = ((points - start) * axis).sum(-1) / np.maximum((axis * axis).sum(-1), 1e-12)
        away = points - (start + np.clip(fraction, 0, 1)[:, None] * axis)
        away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
        return np.where(self.round[shape][:, None], away, flat)


def _scene(vertices: Array, triangles: npt.NDArray[np.int64]) -> Any:
    """Build Open3D's scene of one mesh."""
    o3d = open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32)))
    return scene


def tessellate(shapes: Sequence[Shape]) -> tuple[Array, npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Tessellate shapes: vertices (v, 3), triangles (t, 3), index of the shape of each triangle (t,)."""
    vertices, triangles, owner = [], [], []
    count = 0
    fine, coarse = _unit_capsule(24, 10), _unit_capsule(10, 3)
    for index, shape in enumerate(shapes):
        if isinstance(shape, Box):
            local, faces = _unit_box()
            own = shape.center + (local * shape.half_extents) @ shape.rotation.T
        elif isinstance(shape, Capsule):
            local, side, faces = coarse
            along = shape.end - shape.start
            length = max(shape.length, 1e-9)
            frame = frame_along(along if length > 1e-9 else np.array([0.0, 0.0, 1.0]))
            lifted = shape.radius * local + np.outer(side * length / 2, [0.0, 0.0, 1.0])
            own = (shape.start + shape.end) / 2 + lifted @ frame.T
        else:
            local, _, faces = fine
            own = shape.center + shape.radius * local
            if isinstance(shape, Ellipsoid):
                own = shape.center + (local * shape.semi_axes) @ shape.rotation.T
        vertices.append(own)
        triangles.append(faces + count)
        owner.append(np.full(len(faces), index, dtype=np.int32))
        count += len(own)
    return np.concatenate(vertices), np.concatenate(triangles), np.concatenate(owner)


def _unit_capsule(around: int, rings: int) -> tuple[Array, Array, npt.NDArray[np.int64]]:
    """Return vertices (v, 3) of a unit sphere cut at its equator, the side (v,) +-1 of each, triangles (t, 3)."""
    latitude = np.concatenate([np.linspace(-np.pi / 2, 0, rings + 1), np.linspace(0, np.pi / 2, rings + 1)])
    side = np.repeat([-1.0, 1.0], rings + 1)
    longitude = np.arange(around) * 2 * np.pi / around
    lat, lon = np.meshgrid(latitude, longitude, indexing="ij")
    # a polygon lies inside its circle; scaling by the mean of both keeps the size right on average
    scale = 2.0 / (1.0 + np.cos(np.pi / around))
    vertices = np.stack([scale * np.cos(lat) * np.cos(lon), scale * np.cos(lat) * np.sin(lon), np.sin(lat)], axis=-1)
    grid = np.arange(lat.size).reshape(lat.shape)
    a, b = grid[:-1], grid[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    triangles = np.concatenate([np.stack([a, d, c], axis=-1), np.stack([a, c, b], axis=-1)]).reshape(-1, 3)
    return vertices.reshape(-1, 3), np.repeat(side, around), triangles


def _unit_box() -> tuple[Array, npt.NDArray[np.int64]]:
    """Return the eight corners (8, 3) of the box from -1 to 1, and its twelve triangles."""
    corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _fruit_color(palette: Palette, ripeness: float | None) -> Array:
    stops, skin = np.linspace(0, 1, len(palette.fruit)), np.array(palette.fruit)
    return np.array([np.interp(1.0 if ripeness is None else ripeness, stops, skin[:, k]) for k in range(3)])


def _is_gutter(shape: Shape) -> bool:
    return isinstance(shape, Box) and bool(shape.half_extents[1] > 0.5)


def _shade(base: Array, normals: Array, directions: Array) -> Array:
    """Shade colors by diffuse light from above and from the camera, an ambient part, and a highlight."""
    toward_camera = -directions / np.linalg.norm(directions, axis=1, keepdims=True)
    facing = np.abs((normals * toward_camera).sum(1))
    normals = normals * np.sign((normals * toward_camera).sum(1, keepdims=True) + 1e-9)
    above = np.clip(normals @ np.array([-0.35, 0.2, 0.91]), 0, 1)
    half = toward_camera + np.array([-0.35, 0.2, 0.91])
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    highlight = np.clip((normals * half).sum(1), 0, 1) ** 40
    return base * (0.40 + 0.30 * facing + 0.45 * above)[:, None] + 0.15 * highlight[:, None]
