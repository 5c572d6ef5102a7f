"""Pictures with OpenGL, through MuJoCo's own renderer; headless machines use EGL."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

from greenhouse_gym.errors import GreenhouseError
from greenhouse_gym.geometry import Array
from greenhouse_gym.scene.render import Camera, Image, Line, default_camera

_MAX_GEOMS = 4000


class OpenGLMissingError(GreenhouseError, RuntimeError):
    """No picture can be drawn with OpenGL here."""


class OpenGLRenderer:
    """Draws models of one layout into memory; several work side by side, each with a context of its own.

    Args:
        model: Any of the models.
        width: Pixels.
        height: Pixels.

    Raises:
        OpenGLMissingError: There is no OpenGL here.
    """

    def __init__(self, model: mujoco.MjModel, width: int = 640, height: int = 480):
        try:
            self._gl = _context_class()(width, height)
            self._gl.make_current()
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        except Exception as error:  # each backend raises its own kind
            raise OpenGLMissingError(
                f"OpenGL does not work here ({error}); on Debian and Ubuntu: apt install libegl1 libgl1"
            ) from error
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=_MAX_GEOMS)
        self._option = mujoco.MjvOption()
        self._area = mujoco.MjrRect(0, 0, width, height)

    def picture(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera | None = None, lines: Sequence[Line] = ()
    ) -> Image:
        """(h, w, 3) uint8; lines are hidden where something stands before them."""
        colors = np.empty((self._area.height, self._area.width, 3), dtype=np.uint8)
        self._draw(model, data, camera, lines)
        mujoco.mjr_readPixels(colors, None, self._area, self._context)
        return np.flipud(colors).copy()

    def close(self) -> None:
        """Free the context."""
        self._gl.make_current()
        self._context.free()
        self._gl.free()

    def _draw(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Camera | None, lines: Sequence[Line]) -> None:
        self._gl.make_current()
        camera = camera or default_camera()
        model.vis.global_.fovy = camera.field_of_view
        every = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(model, data, self._option, None, free_camera(camera), every, self._scene)
        for line in lines:
            add_line(self._scene, line)
        mujoco.mjr_render(self._area, self._scene, self._context)


def free_camera(camera: Camera) -> mujoco.MjvCamera:
    """MuJoCo's free camera at the same place, looking the same way."""
    view = mujoco.MjvCamera()
    away = np.subtract(camera.look_at, camera.position)
    view.type = mujoco.mjtCamera.mjCAMERA_FREE
    view.lookat[:] = camera.look_at
    view.distance = float(np.linalg.norm(away))
    view.azimuth = float(np.degrees(np.arctan2(away[1], away[0])))
    view.elevation = float(np.degrees(np.arcsin(away[2] / view.distance)))
    return view


def add_line(scene: mujoco.MjvScene, line: Line) -> None:
    """Add a polyline to a scene, as far as there is room for its segments."""
    points: Array = np.asarray(line.points, dtype=np.float64).reshape(-1, 3)
    for start, end in pairwise(points):
        if scene.ngeom >= scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        color = np.array([*line.color, 1.0], dtype=np.float32)
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).reshape(-1), color)
        mujoco.mjv_connector(geom, kind, line.radius, start, end)
        scene.ngeom += 1


def _context_class() -> type[Any]:
    """EGL where there is no display and nobody chose otherwise, whatever MuJoCo chose when it was imported."""
    no_display = sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
    if no_display and not os.environ.get("MUJOCO_GL"):
        from mujoco.egl import GLContext
    else:
        from mujoco.gl_context import GLContext
    return GLContext  # type: ignore[no-any-return]
