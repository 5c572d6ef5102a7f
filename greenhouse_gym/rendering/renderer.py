"""Rendering without OpenGL: MuJoCo's ray casting, shaded on the CPU. Works everywhere at a few images per second."""

from __future__ import annotations

import copy
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.scene.obstacles import ArmPlacement

Image = npt.NDArray[np.uint8]

KEY_LIGHT = np.array([-2.2, -1.6, 3.6])
"""Position of the key light in the aisle, which casts shadows."""

FILL_LIGHT = np.array([-0.5, 0.8, 0.3]) / np.linalg.norm([-0.5, 0.8, 0.3])
"""Direction of the fill light, which casts no shadows."""

AMBIENT, KEY, FILL, ABOVE = 0.48, 0.5, 0.16, 0.08
"""Brightness of the ambient, key, fill and overhead light."""

SHADOW = 0.12
"""Fraction of the key light within its shadows."""

_SKY_LOW, _SKY_HIGH = np.array([0.93, 0.95, 0.95]), np.array([0.74, 0.83, 0.9])
_FADE = (4.0, 9.0)  # surfaces fade into the background between these distances, metres
_ROWS_PER_TASK = 128


@dataclass(frozen=True)
class Viewpoint:
    """A pinhole camera that keeps the horizon level.

    Attributes:
        position: (x, y, z) in the scene, metres.
        look_at: (x, y, z) in the center of the image, metres.
        field_of_view: Vertical field of view, degrees.
    """

    position: tuple[float, float, float]
    look_at: tuple[float, float, float]
    field_of_view: float = 46.0

    def axes(self) -> Array:
        """Return the (3, 3) rotation scene_from_camera (OpenCV): columns are right, down and forward."""
        forward = np.subtract(self.look_at, self.position).astype(np.float64)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.column_stack([right, np.cross(forward, right), forward])


@dataclass(frozen=True, eq=False)
class Line:
    """Polyline in an image: ``points`` (m, 3) in the scene, RGB ``color`` in [0, 1], ``radius`` in metres."""

    points: npt.ArrayLike
    color: tuple[float, float, float]
    radius: float = 0.004


def default_camera(placement: ArmPlacement | None = None) -> Viewpoint:
    """Return a viewpoint in the aisle next to and above the arm, from which the arm stands out from the plants."""
    placement = placement or ArmPlacement()
    turn = rotation_about([0.0, 0.0, 1.0], placement.yaw)
    position = turn @ [-1.15, -1.9, 1.7] + placement.position
    look_at = turn @ [0.3, 0.05, 1.3] + placement.position
    return Viewpoint(tuple(position.tolist()), tuple(look_at.tolist()))


def render_scene(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: Viewpoint | None = None,
    width: int = 640,
    height: int = 480,
    lines: Sequence[Line] = (),
    samples: int = 2,
) -> Image:
    """Render a model in its current state.

    Args:
        model: The model; transparent geoms are invisible.
        data: Its state, with current kinematics.
        camera: Viewpoint; `default_camera` if None.
        width: Pixels.
        height: Pixels.
        lines: Polylines, hidden behind surfaces.
        samples: Rays per pixel in each direction: 1 is fast, 2 is smooth.

    Returns:
        (height, width, 3) uint8.

    Raises:
        InvalidValueError: A size is not positive.
    """
    if min(width, height, samples) < 1:
        raise InvalidValueError(f"width, height and samples must be at least 1, got {width}, {height}, {samples}")
    camera = camera or default_camera()
    w, h = width * samples, height * samples
    axes, eye = camera.axes(), np.array(camera.position, dtype=np.float64)
    directions, stretch, focal = view_rays(camera, w, h)

    def shade(rows: slice) -> tuple[Array, Array]:
        # rays use scratch memory of the data, so each task needs its own copy
        return _shade(model, copy.copy(data), eye, directions[rows].reshape(-1, 3))

    tasks = [slice(first, first + _ROWS_PER_TASK) for first in range(0, h, _ROWS_PER_TASK)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = list(pool.map(shade, tasks))
    colors = np.concatenate([color for color, _ in parts]).reshape(h, w, 3)
    depth = np.concatenate([distance for _, distance in parts]).reshape(h, w) / stretch
    for line in lines:
        points = (np.asarray(line.points, dtype=np.float64).reshape(-1, 3) - eye) @ axes
        for start, end in pairwise(points):
            _draw_segment(colors, depth, start, end, focal, line)
    image = colors.reshape(height, samples, width, samples, 3).mean(axis=(1, 3))
    return np.asarray(np.clip(image * 255.0 + 0.5, 0, 255), dtype=np.uint8)


def render_depth(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Viewpoint | None = None, width: int = 640, height: int = 480
) -> npt.NDArray[np.float32]:
    """Return depth (height, width) along the optical axis, metres, 0 without a hit; arguments as in `render_scene`.

    Raises:
        InvalidValueError: A size is not positive.
    """
    if min(width, height) < 1:
        raise InvalidValueError(f"width and height must be at least 1, got {width}, {height}")
    camera = camera or default_camera()
    directions, stretch, _ = view_rays(camera, width, height)
    eye = np.array(camera.position, dtype=np.float64)
    distance = _cast(model, copy.copy(data), eye, directions.reshape(-1, 3))[0].reshape(height, width)
    return np.where(distance >= 0, distance / stretch, 0.0).astype(np.float32)


def view_rays(camera: Viewpoint, width: int, height: int) -> tuple[Array, Array, float]:
    """Return unit rays (h, w, 3) in the scene, ray length per unit of depth (h, w), and the focal length in pixels."""
    focal = float(height / (2 * np.tan(np.radians(camera.field_of_view) / 2)))
    u, v = np.meshgrid((np.arange(width) + 0.5 - width / 2) / focal, (np.arange(height) + 0.5 - height / 2) / focal)
    directions = np.stack([u, v, np.ones_like(u)], -1) @ camera.axes().T
    stretch = np.linalg.norm(directions, axis=-1)
    return directions / stretch[..., None], stretch, focal


def _cast(
    model: mujoco.MjModel, data: mujoco.MjData, origin: Array, rays: Array
) -> tuple[Array, npt.NDArray[np.int32], Array]:
    """Return distances (m,), -1 for a miss, geom ids (m,) and normals (m, 3) for unit rays (m, 3) from one point."""
    count = len(rays)
    geom, distance, normal = np.full(count, -1, dtype=np.int32), np.empty(count), np.zeros(3 * count)
    mujoco.mj_multiRay(
        model, data, origin, np.ascontiguousarray(rays).reshape(-1), None, True, -1, geom, distance, normal, count, 1e3
    )
    return distance, geom, normal.reshape(-1, 3)


def _shade(model: mujoco.MjModel, data: mujoco.MjData, eye: Array, rays: Array) -> tuple[Array, Array]:
    """Return colors (m, 3) and distances (m,) along the rays; infinite without a hit."""
    distance, geom, normal = _cast(model, data, eye, rays)
    hit = np.flatnonzero(distance >= 0)
    away = eye + distance[hit, None] * rays[hit] - KEY_LIGHT
    reach = np.linalg.norm(away, axis=1)
    away /= reach[:, None]
    key = np.zeros(len(rays))
    lit = _cast(model, data, KEY_LIGHT, away)[0] > reach - 2e-3
    key[hit] = np.maximum(-np.einsum("mi,mi->m", normal[hit], away), 0.0) * np.where(lit, 1.0, SHADOW)
    colors = _lit(model.geom_rgba[geom], normal, rays, distance, key)
    distance[distance < 0] = np.inf
    return colors, distance


def surface_colors(rgba: npt.NDArray[np.float32], normal: Array, rays: Array, distance: Array) -> Array:
    """Return shaded colors (m, 3), 0 to 1, without shadows and with a directional key light.

    Args:
        rgba: (m, 4) surface colors.
        normal: (m, 3) unit normals of the surfaces.
        rays: (m, 3) unit vectors.
        distance: (m,) distances along the rays, metres; negative without a hit.
    """
    towards = KEY_LIGHT / np.linalg.norm(KEY_LIGHT)
    return _lit(rgba, normal, rays, distance, np.maximum((normal * towards).sum(axis=1), 0.0))


def background_fade(distance: Array) -> Array:
    """Return the fraction (...), 0 to 1, by which surfaces at distances (...), metres, fade into the background."""
    return np.asarray(np.clip((distance - _FADE[0]) / (_FADE[1] - _FADE[0]), 0.0, 1.0))


def sky_colors(rays: Array) -> Array:
    """Return background colors (..., 3), 0 to 1, along unit rays (..., 3)."""
    up = np.clip(rays[..., 2:] * 2.0 + 0.3, 0.0, 1.0)
    return _SKY_LOW + up * (_SKY_HIGH - _SKY_LOW)


def _lit(rgba: npt.NDArray[np.float32], normal: Array, rays: Array, distance: Array, key: Array) -> Array:
    """Return colors (m, 3) along rays, given the key light (m,) on the surfaces."""
    fill = np.maximum((normal * FILL_LIGHT).sum(axis=1), 0.0)
    light = AMBIENT + ABOVE * normal[:, 2] + KEY * key + FILL * fill
    color = np.array(rgba[:, :3], dtype=np.float64) * light[:, None]
    fade = background_fade(distance)
    fade[distance < 0] = 1.0
    return np.clip(color + fade[:, None] * (sky_colors(rays) - color), 0.0, 1.0)


def _draw_segment(colors: Array, depth: Array, start: Array, end: Array, focal: float, line: Line) -> None:
    """Draw a segment in camera coordinates over the surfaces behind it."""
    near = 0.05
    if max(start[2], end[2]) < near:
        return
    for a, b in ((start, end), (end, start)):
        if a[2] < near:  # clip the part behind the camera
            a = a + (b - a) * (near - a[2]) / (b[2] - a[2])
            start, end = (a, end) if b is end else (start, a)
    h, w = depth.shape
    p, q = (focal * s[:2] / s[2] + [w / 2, h / 2] for s in (start, end))
    reach = focal * line.radius / min(start[2], end[2]) + 1
    low = np.maximum(np.floor(np.minimum(p, q) - reach), 0).astype(int)
    high = np.minimum(np.ceil(np.maximum(p, q) + reach) + 1, [w, h]).astype(int)
    if (high <= low).any():
        return
    x, y = np.meshgrid(np.arange(low[0], high[0]) + 0.5, np.arange(low[1], high[1]) + 0.5)
    along = q - p
    fraction = np.clip(((x - p[0]) * along[0] + (y - p[1]) * along[1]) / max(float(along @ along), 1e-9), 0.0, 1.0)
    z = 1.0 / ((1 - fraction) / start[2] + fraction / end[2])  # inverse depth is linear in an image
    offset = np.hypot(x - p[0] - fraction * along[0], y - p[1] - fraction * along[1])
    area = (slice(low[1], high[1]), slice(low[0], high[0]))
    radius = np.maximum(focal * line.radius / z, 0.8)
    drawn = (offset <= radius) & (z - line.radius < depth[area])
    round_look = 0.75 + 0.25 * np.sqrt(np.clip(1 - (offset / radius) ** 2, 0, 1))
    colors[area][drawn] = (round_look[..., None] * np.array(line.color))[drawn]
    depth[area][drawn] = z[drawn]
