"""Depth and color cameras on the wrist and on a mast next to the arm, rendered by ray casting without OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError, check_whole, is_number, require_choice
from greenhouse_gym.geometry import Array, invert, pose, rotation_about
from greenhouse_gym.rendering.raycaster import Hits, RayCaster
from greenhouse_gym.rendering.renderer import surface_colors
from greenhouse_gym.scene import CompiledScene

if TYPE_CHECKING:
    from greenhouse_gym.capture.sensor import StereoNoise

Float32 = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]
Geoms = npt.NDArray[np.int64]

CAMERAS = ("wrist", "mast")
"""Camera mounts: behind the tool, looking along it; on a mast next to the arm, looking at the plants."""

MAX_RANGE = 2.0
"""Maximum depth of a reading, metres."""

COLOR_RANGE = 10.0
"""Maximum distance of a surface in color images, metres."""

TIP_FROM_WRIST = pose(translation=[0.07, 0.0, -0.13])
"""Pose of the wrist camera: next to the flange, looking along the tool."""

_BASE_FROM_MAST = pose(
    rotation_about([0, 0, 1], -0.5) @ rotation_about([0, 1, 0], 0.2) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],
    [-0.15, 0.5, 0.45],
)
"""Pose of the mast camera: left of the arm and above its shoulder, looking at the middle of the workspace."""

_MAX_PIXELS = 1 << 13  # in each direction

D435_FOCAL = 424.2  # px at 848 px width; the noise parameters refer to this width


@dataclass(frozen=True)
class DepthCamera:
    """A pinhole depth camera.

    Attributes:
        mount: One of `CAMERAS`.
        width: Pixels.
        height: Pixels.
        field_of_view: Horizontal field of view, degrees.
    """

    mount: str = "wrist"
    width: int = 64
    height: int = 48
    field_of_view: float = 87.0

    def __post_init__(self) -> None:
        require_choice("camera", self.mount, CAMERAS)
        for name in ("width", "height"):
            check_whole(f"a camera's {name}", getattr(self, name), 1, _MAX_PIXELS)
        if not (is_number(self.field_of_view) and 0 < self.field_of_view < 180):
            raise InvalidValueError(
                f"a camera's field_of_view must be a number of degrees between 0 and 180, got {self.field_of_view!r}"
            )

    @property
    def focal(self) -> float:
        """Focal length, pixels."""
        return float(self.width / (2 * np.tan(np.radians(self.field_of_view) / 2)))

    @cached_property
    def rays(self) -> Array:
        """(height * width, 3) directions through the pixels in the camera frame, with z = 1."""
        u = (np.arange(self.width) + 0.5 - self.width / 2) / self.focal
        v = (np.arange(self.height) + 0.5 - self.height / 2) / self.focal
        x, y = np.meshgrid(u, v)
        return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


class Images(NamedTuple):
    """Images of c cameras in each of n simulations.

    Attributes:
        depth: (n, c, h, w) depth along the optical axis, metres; 0 without a reading.
        color: (n, c, h, w, 3) RGB, 0 to 255; c is 0 if no color images are rendered.
        geom: (n, c, h, w) ids of the geoms in the compiled model, -1 without a hit; c is 0 unless requested.
        views: (n, c, 4, 4) camera poses, base_from_camera.
    """

    depth: Float32
    color: Bytes
    geom: Geoms
    views: Array

    def first(self, count: int) -> Images:
        """Return the images of the first ``count`` simulations."""
        return self if count == len(self.depth) else Images._make(values[:count] for values in self)


def no_images(count: int) -> Images:
    """Return the empty images of n simulations without cameras."""
    return Images(
        np.empty((count, 0, 0, 0), np.float32),
        np.empty((count, 0, 0, 0, 3), np.uint8),
        np.empty((count, 0, 0, 0), np.int64),
        np.empty((count, 0, 4, 4)),
    )


class CameraRig:
    """Cameras of n simulations whose models share a layout.

    Args:
        cameras: The cameras, all of the same image size.
        compiled: Any scene of that layout.
        threads: Number of threads for ray casting.
        renders_arm: Render the arm in depth images; otherwise its pixels have no reading.
        renders_color: Render color images as well; they always show the arm.
        renders_geoms: Render images of geoms as well; they always show the arm.
    """

    def __init__(
        self,
        cameras: Sequence[DepthCamera],
        compiled: CompiledScene,
        threads: int,
        renders_arm: bool,
        renders_color: bool = False,
        renders_geoms: bool = False,
    ):
        self.cameras = tuple(cameras)
        self._renders_arm, self._renders_color = renders_arm, renders_color
        self._renders_geoms = renders_geoms
        self._rays = [camera.rays for camera in self.cameras]
        self._lengths = [np.linalg.norm(rays, axis=1) for rays in self._rays]
        self._casters = [RayCaster(compiled) for _ in range(max(1, threads))]
        self._arm = self._casters[0].arm
        self._pool = ThreadPoolExecutor(len(self._casters)) if len(self._casters) > 1 else None

    def render(
        self,
        models: Sequence[mujoco.MjModel],
        qpos: Array,
        frame: Array,
        tip: Array,
        tool: Array,
        noises: Sequence[np.random.Generator | None],
        plants: Sequence[mujoco.MjData | None] | None = None,
        due: npt.NDArray[np.bool_] | None = None,
    ) -> Images:
        """Render the images of all cameras.

        Args:
            models: Model of each of the n simulations.
            qpos: (n, j) joint positions, radians.
            frame: (n, 5) base frame in the scene: position in metres, cosine and sine of the heading.
            tip: (n, 3) tool tips in the scene, metres.
            tool: (n, 3, 3) tool rotations, scene_from_tool.
            noises: Generator of each simulation's depth noise; None for noise-free images.
            plants: State of each simulation with plants that move; None if none does.
            due: (n,) whether the images of each simulation are rendered; the others are zero. None renders all.
        """
        count = len(models)
        due = np.ones(count, dtype=np.bool_) if due is None else due
        scene_from_base, scene_from_tip = scene_from_bases(frame), np.zeros((len(tip), 4, 4))
        scene_from_tip[:, :3, :3], scene_from_tip[:, :3, 3], scene_from_tip[:, 3, 3] = tool, tip, 1.0
        views = _camera_poses(self.cameras, invert(scene_from_base) @ scene_from_tip)
        depth, color, geom = self._render_clean(
            models, qpos, scene_from_base[:, None] @ views, plants or [None] * count, due
        )
        for own, noise, rendered in zip(depth, noises, due, strict=True):
            if noise is not None and rendered:
                for c, camera in enumerate(self.cameras):
                    own[c] = _with_noise(own[c], camera, noise)
        return Images(depth, color, geom, views)

    def _render_clean(
        self,
        models: Sequence[mujoco.MjModel],
        qpos: Array,
        views: Array,
        plants: Sequence[mujoco.MjData | None],
        due: npt.NDArray[np.bool_],
    ) -> tuple[Float32, Bytes, Geoms]:
        """Return noise-free depth, color and geoms from camera poses scene_from_camera (n, c, 4, 4)."""
        first = self.cameras[0]
        shape = (len(models), len(self.cameras), first.height, first.width)
        depths = np.zeros(shape, dtype=np.float32)
        geoms = np.zeros(shape if self._renders_geoms else (len(models), 0, 0, 0), dtype=np.int64)
        colors = np.zeros((*shape, 3) if self._renders_color else (len(models), 0, 0, 0, 3), dtype=np.uint8)

        def shoot(part: int) -> None:
            for i in np.flatnonzero(due)[part :: len(self._casters)]:
                for k in range(len(self.cameras)):
                    hits, directions = self._cast(self._casters[part], models[i], qpos[i], k, views[i, k], plants[i])
                    depths[i, k] = self._depth(hits, k).reshape(shape[2:])
                    if self._renders_geoms:
                        geoms[i, k] = hits.geom.reshape(shape[2:])
                    if self._renders_color:
                        shown = surface_colors(hits.rgba, hits.normal, directions, hits.distance)
                        colors[i, k] = (shown * 255.0 + 0.5).astype(np.uint8).reshape(*shape[2:], 3)

        if self._pool is None:
            shoot(0)
        else:
            list(self._pool.map(shoot, range(len(self._casters))))
        return depths, colors, geoms

    def _cast(
        self,
        caster: RayCaster,
        model: mujoco.MjModel,
        joints: Array,
        camera: int,
        view: Array,
        plants: mujoco.MjData | None,
    ) -> tuple[Hits, Array]:
        """Cast the rays of a camera; return the hits and the ray directions (m, 3)."""
        rays, lengths = self._rays[camera], self._lengths[camera]
        directions = (rays / lengths[:, None]) @ view[:3, :3].T
        reach = COLOR_RANGE if self._renders_color else MAX_RANGE * float(lengths.max())
        hits = caster.cast(
            model,
            joints,
            view[:3, 3].copy(),
            directions,
            reach,
            self._renders_color,
            plants,
            self.cameras[camera].width,
        )
        return hits, directions

    def _depth(self, hits: Hits, camera: int) -> Array:
        visible = hits.distance >= 0
        if not self._renders_arm:
            visible &= (hits.geom < self._arm.start) | (hits.geom >= self._arm.stop)
        depth = np.where(visible, hits.distance / self._lengths[camera], 0.0)
        depth[depth > MAX_RANGE] = 0.0
        return depth

    def close(self) -> None:
        """Shut down the threads."""
        if self._pool is not None:
            self._pool.shutdown()


def scene_from_bases(frame: Array) -> Array:
    """Return poses scene_from_base (n, 4, 4) for base frames (n, 5): position, cosine and sine of the heading."""
    result = np.zeros((len(frame), 4, 4))
    result[:, 0, 0] = result[:, 1, 1] = frame[:, 3]
    result[:, 1, 0], result[:, 0, 1] = frame[:, 4], -frame[:, 4]
    result[:, 2, 2] = result[:, 3, 3] = 1.0
    result[:, :3, 3] = frame[:, :3]
    return result


def _camera_poses(cameras: Sequence[DepthCamera], base_from_tip: Array) -> Array:
    """Return camera poses base_from_camera (n, c, 4, 4) for tool poses base_from_tip (n, 4, 4)."""
    result = np.empty((len(base_from_tip), len(cameras), 4, 4))
    for k, camera in enumerate(cameras):
        result[:, k] = base_from_tip @ TIP_FROM_WRIST if camera.mount == "wrist" else _BASE_FROM_MAST
    return result


def stereo_noise(camera: DepthCamera) -> StereoNoise:
    """Return the noise model of a D435 scaled to the image width of a camera; see `greenhouse_gym.capture.sensor`."""
    from greenhouse_gym.capture.sensor import StereoNoise

    scale = camera.focal / D435_FOCAL
    full = StereoNoise()
    return replace(
        full, disparity_noise=full.disparity_noise * scale, disparity_step=full.disparity_step * scale, edge_fattening=0
    )


def _with_noise(depth: Float32, camera: DepthCamera, rng: np.random.Generator) -> Float32:
    """Return a depth image (h, w) with the noise of a D435."""
    from greenhouse_gym.capture.sensor import sense_depth

    sensed = sense_depth(depth, camera.focal, rng, stereo_noise(camera))
    sensed[sensed > MAX_RANGE] = 0.0
    return sensed
