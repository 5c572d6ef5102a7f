"""Viewer of an environment: images by OpenGL where available, else by ray casting, or an interactive window."""

from __future__ import annotations

import os
import sys
import threading
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import GreenhouseError, InvalidValueError, require_choice
from greenhouse_gym.geometry import Array, rotation_about
from greenhouse_gym.rendering.opengl import OpenGLMissingError, OpenGLRenderer, add_line, free_camera
from greenhouse_gym.rendering.renderer import Line, Viewpoint, render_depth, render_scene
from greenhouse_gym.rendering.task_pictures import task_lines
from greenhouse_gym.scene.obstacles import ArmPlacement

RENDER_MODES = ("rgb_array", "human", "depth_array")

CAMERAS: Mapping[str, tuple[Sequence[float], Sequence[float]]] = {
    "aisle": ([-1.15, -1.9, 1.7], [0.3, 0.05, 1.3]),
    "behind": ([-1.6, 0.0, 1.9], [0.6, 0.0, 1.2]),
    "side": ([0.2, -2.2, 1.4], [0.4, 0.0, 1.2]),
    "top": ([0.2, 0.0, 3.4], [0.45, 0.0, 1.0]),
}
"""Cameras by name: position and point to look at, relative to the arm's placement, metres."""

MAX_SIZE = 4096
"""Largest width and height of an image, pixels."""


class RenderingWarning(UserWarning):
    """Images are drawn by ray casting instead of OpenGL: more slowly, and a little different."""


class NoDisplayError(GreenhouseError, RuntimeError):
    """Raised if a window is requested without a display."""


@dataclass(frozen=True)
class Picture:
    """Size and camera of the images of an environment.

    Attributes:
        width: Pixels.
        height: Pixels.
        camera: A name of `CAMERAS`, or a `Viewpoint` in the scene.
    """

    width: int = 640
    height: int = 480
    camera: str | Viewpoint = "aisle"

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
            if not whole or not 1 <= value <= MAX_SIZE:
                raise InvalidValueError(f"{name} must be pixels from 1 to {MAX_SIZE}, got {value!r}")
        if not isinstance(self.camera, Viewpoint):
            require_choice("camera", self.camera, CAMERAS)
        elif not np.hypot(*np.subtract(self.camera.look_at, self.camera.position)[:2]) > 0:
            raise InvalidValueError(f"a camera must not look straight up or down, got {self.camera}")

    def viewpoint(self, placement: ArmPlacement) -> Viewpoint:
        """Return the viewpoint in a scene with this placement of the arm."""
        if isinstance(self.camera, Viewpoint):
            return self.camera
        turn = rotation_about([0.0, 0.0, 1.0], placement.yaw)
        position, look_at = ((turn @ point + placement.position).tolist() for point in CAMERAS[self.camera])
        return Viewpoint(tuple(position), tuple(look_at))


class Viewer:
    """Viewer of simulations whose models share a layout.

    Args:
        mode: One of `RENDER_MODES`.
        picture: Size and camera.
    """

    def __init__(self, mode: str, picture: Picture | None = None):
        self.mode, self.picture = mode, picture or Picture()
        # an OpenGL context works only in the thread that created it
        self._of_thread = threading.local()
        self._gl_works = mode == "rgb_array"
        self._window: Any = None
        self._shown: tuple[mujoco.MjModel, mujoco.MjData] | None = None

    def __deepcopy__(self, memo: dict[int, Any]) -> Viewer:
        """Return a viewer with its own window and context."""
        return Viewer(self.mode, self.picture)

    def draw(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        placement: ArmPlacement,
        tip: Array,
        target: Array,
        trace: list[Array],
    ) -> npt.NDArray[Any] | None:
        """Return an image (h, w, 3) uint8 or depth (h, w) float32 in metres; None after updating the window.

        Args:
            model: The simulation's model.
            data: Its state.
            placement: The arm's placement.
            tip: (3,) start of the red line, metres.
            target: (3,) end of the red line, metres.
            trace: Earlier positions (3,) of the tip, drawn in pink, metres.

        Raises:
            NoDisplayError: Mode "human" without a display.
        """
        camera, lines = self.picture.viewpoint(placement), task_lines(tip, target, trace)
        size = self.picture.width, self.picture.height
        if self.mode == "depth_array":
            return render_depth(model, data, camera, *size)
        if self.mode == "human":
            self._show(model, data, camera, lines)
            return None
        if self._gl_works:
            try:
                if self._gl is None:
                    self._of_thread.gl = OpenGLRenderer(model, *size)
                assert self._gl is not None
                return self._gl.picture(model, data, camera, lines)
            except OpenGLMissingError as error:
                self._gl_works = False
                warnings.warn(f"images are drawn by ray casting from here on: {error}", RenderingWarning, stacklevel=3)
        return render_scene(model, data, camera, *size, lines, samples=1)

    def close(self) -> None:
        """Close the window and free this thread's context; the next drawing creates new ones."""
        if self._gl is not None:
            self._gl.close()
        if self._window is not None:
            self._window.close()
        self._of_thread.gl = self._window = self._shown = None

    @property
    def _gl(self) -> OpenGLRenderer | None:
        """Renderer of this thread."""
        return getattr(self._of_thread, "gl", None)

    def _show(self, model: mujoco.MjModel, data: mujoco.MjData, camera: Viewpoint, lines: list[Line]) -> None:
        if not _has_display():
            raise NoDisplayError('render_mode="human" needs a display; choose "rgb_array" or "depth_array" here')
        import mujoco.viewer

        if self._window is None:
            self._shown = (model, data)
            self._window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
            view = free_camera(camera)
            for name in ("lookat", "distance", "azimuth", "elevation"):
                setattr(self._window.cam, name, getattr(view, name))
        assert self._shown is not None
        shown_model, shown_data = self._shown
        with self._window.lock():
            for name in ("geom_type", "geom_size", "geom_pos", "geom_quat", "geom_rgba", "body_pos", "body_quat"):
                getattr(shown_model, name)[:] = getattr(model, name)
            shown_data.qpos[:] = data.qpos
            mujoco.mj_forward(shown_model, shown_data)
            self._window.user_scn.ngeom = 0
            for line in lines:
                add_line(self._window.user_scn, line)
        self._window.sync()


def available_modes() -> list[str]:
    """Return the `RENDER_MODES` that work on this machine: no window without a display."""
    return [mode for mode in RENDER_MODES if mode != "human" or _has_display()]


def _has_display() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
