"""OpenGL rendering with MuJoCo's own renderer; headless machines use EGL."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.opengl_choice import opengl_choice, opengl_is_off
from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.rendering.renderer import (
    ABOVE,
    AMBIENT,
    FILL,
    FILL_LIGHT,
    KEY,
    KEY_LIGHT,
    SHADOW,
    Image,
    Line,
    Viewpoint,
    background_fade,
    default_camera,
    sky_colors,
    view_rays,
)

Float32 = npt.NDArray[np.float32]

_MAX_LINES = 2000  # pieces of lines that a picture holds in addition to the geoms of its model
_QUALITY = {"offsamples": 0, "shadowsize": 1024, "numslices": 12, "numstacks": 8, "numquads": 1}
"""Drawing quality: in software, MuJoCo's own (4 samples, 4096, 28, 16, 4) takes seven times as long per image."""

_AT_THE_PLANTS = np.array([0.5, 0.0, 1.0])
_processes: set[int] = set()  # ids of the processes that created a context
_inherited: list[Any] = []  # contexts of the parent process of a fork, which must not be freed here


class OpenGLMissingError(GreenhouseError, RuntimeError):
    """Raised where OpenGL is not available."""


class OpenGLRenderer:
    """Off-screen renderer of models that share a layout. Several renderers coexist, each with its own context.

    A renderer belongs to the thread that created it. Lights and background are those of `render_scene`. The visual
    settings of the models are changed.

    Args:
        model: Any model of that layout.
        width: Pixels.
        height: Pixels.

    Raises:
        OpenGLMissingError: OpenGL is not available, or this process was forked from one that used it.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 640, height: int = 480):
        self._process = os.getpid()
        if _processes - {self._process}:
            raise OpenGLMissingError(_FORKED)
        _processes.add(self._process)
        for name, value in _QUALITY.items():
            setattr(model.vis.quality, name, value)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        try:
            self._gl = _context_class()(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except OpenGLMissingError:
            raise
        except Exception as error:  # each backend raises its own kind
            raise OpenGLMissingError(
                f"OpenGL is not available ({error}); on Debian and Ubuntu: apt install libegl1 libgl1"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + _MAX_LINES)
        self._option = mujoco.MjvOption()
        self._area = mujoco.MjrRect(0, 0, width, height)

    def picture(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: Viewpoint | None = None, lines: Sequence[Line] = ()
    ) -> Image:
        """Return an image (h, w, 3) uint8; lines are hidden behind surfaces.

        Raises:
            OpenGLMissingError: This process was forked from the one that created the renderer.
        """
        if os.getpid() != self._process:
            raise OpenGLMissingError(_FORKED)
        camera = camera or default_camera()
        height, width = self._area.height, self._area.width
        colors, depth = np.empty((height, width, 3), dtype=np.uint8), np.empty((height, width), dtype=np.float32)
        self._draw(model, data, camera, lines)
        mujoco.mjr_readPixels(colors, depth, self._area, self._context)
        near, far = (model.stat.extent * end for end in (model.vis.map.znear, model.vis.map.zfar))
        sky, stretch = _background(camera, width, height)
        fade = background_fade(near / (1.0 - depth * (1.0 - near / far)) * stretch)[..., None]
        return np.asarray(np.flipud(colors + fade * (sky - colors) + np.float32(0.5)), dtype=np.uint8)

    def close(self) -> None:
        """Free the context."""
        if os.getpid() != self._process:
            _inherited.append(self)
            return
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    def _draw(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Viewpoint, lines: Sequence[Line]) -> None:
        self._gl.make_current()
        model.vis.global_.fovy = camera.field_of_view
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, free_camera(camera), every, self._scene)
        _set_lights(self._scene)
        for line in lines:
            add_line(self._scene, line)
        mujoco.mjr_render(self._area, self._scene, self._context)


_FORKED = "OpenGL does not work in a process that was forked from one that used it"


@lru_cache(maxsize=8)
def _background(camera: Viewpoint, width: int, height: int) -> tuple[Float32, Float32]:
    """Return the sky (h, w, 3), 0 to 255, and the ray length per unit of depth (h, w), from the bottom row up."""
    rays, stretch, _ = view_rays(camera, width, height)
    return np.flipud(255.0 * sky_colors(rays)).astype(np.float32), np.flipud(stretch).astype(np.float32)


def _set_lights(scene: mujoco.MjvScene) -> None:
    """Replace the lights of the model by those of the ray caster."""
    towards = _AT_THE_PLANTS - KEY_LIGHT
    lights = (
        (towards, KEY * (1 - SHADOW)),  # with shadows
        (towards, KEY * SHADOW),
        (-FILL_LIGHT, FILL),
        (np.array([0.0, 0.0, -1.0]), ABOVE),
    )
    scene.nlight = len(lights)
    for light, (direction, bright) in zip(scene.lights, lights, strict=False):
        light.dir[:] = direction / np.linalg.norm(direction)
        light.pos[:], light.attenuation[:] = KEY_LIGHT, (1.0, 0.0, 0.0)
        light.ambient[:], light.diffuse[:], light.specular[:] = 0.0, bright, 0.0
        light.type, light.headlight, light.castshadow = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, 0, 0
        light.cutoff, light.exponent = 85.0, 0.0
    for light in scene.lights[:2]:
        light.type = mujoco.mjtLightType.mjLIGHT_SPOT
    scene.lights[0].castshadow = 1
    scene.lights[len(lights) - 1].ambient[:] = AMBIENT  # on a light with shadows, ambient would be missing within them


def free_camera(camera: Viewpoint) -> mujoco.MjvCamera:
    """Return MuJoCo's free camera with the same position and direction."""
    view = mujoco.MjvCamera()
    away = np.subtract(camera.look_at, camera.position)
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.lookat[:] = camera.look_at
    view.distance = float(np.linalg.norm(away))
    view.azimuth = float(np.degrees(np.arctan2(away[1], away[0])))
    view.elevation = float(np.degrees(np.arcsin(away[2] / view.distance)))
    return view


def add_line(scene: mujoco.MjvScene, line: Line) -> None:
    """Add a polyline to a scene until the scene has no free geoms."""
    points: Array = np.asarray(line.points, dtype=np.float64).reshape(-1, 3)
    for start, end in pairwise(points):
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        color = np.array([*line.color, 1.0], dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).reshape(-1), color)
        mujoco.mjv_connector(geom, kind, line.radius, start, end)
        geom.emission = 0.4  # equally bright in shadows
        scene.ngeom += 1


def _context_class() -> type[Any]:
    """Return EGL without a display unless the user chose otherwise, whatever MuJoCo selected when it was imported."""
    if opengl_is_off():
        raise OpenGLMissingError(f"OpenGL is switched off by MUJOCO_GL={opengl_choice()}")
    no_display = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if no_display and not opengl_choice():
        from mujoco.egl import GLContext
    else:
        from mujoco.gl_context import GLContext
    return GLContext  # type: ignore[no-any-return]
