"""Views that a task takes with a camera of its own, independent of the agents' observations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.setups import Setup
from greenhouse_gym.geometry import Array, invert, transform
from greenhouse_gym.rendering.cameras import CameraRig, DepthCamera, scene_from_bases
from greenhouse_gym.rendering.depth_reading import DepthReading, perfect_reading, stereo_reading, visible_fractions
from greenhouse_gym.rendering.raycaster import RayCaster


@dataclass(frozen=True, eq=False)
class View:
    """View of a simulation through the camera of its task.

    Attributes:
        camera: The camera.
        reading: Depth image, its error bounds and the free space in front of it.
        pose: (4, 4) base_from_camera.
        tomato: (h, w) index of the simulated tomato at each pixel; -1 elsewhere.
        on_arm: (h, w) whether a pixel shows the arm.
    """

    camera: DepthCamera
    reading: DepthReading
    pose: Array
    tomato: npt.NDArray[np.int64]
    on_arm: npt.NDArray[np.bool_]
    _caster: RayCaster
    _model: mujoco.MjModel
    _joints: Array
    _setup: Setup
    _scene_from_camera: Array

    def visible_fractions(self, tomatoes: npt.NDArray[np.int64], depths: tuple[float, float]) -> Array:
        """Return the visible fraction (k,) of the silhouettes of simulated tomatoes.

        Args:
            tomatoes: (k,) their indices.
            depths: Smallest and largest depth along the view at which they count as visible, metres.
        """
        compiled, view = self._setup.world.compiled, self._scene_from_camera
        shapes = [compiled.scene.tomatoes[k] for k in tomatoes.tolist()]
        centers = transform(invert(view), np.array([each.center for each in shapes]).reshape(-1, 3))
        spheres = np.column_stack([centers, [each.radius for each in shapes]])

        def cast(rays: Array) -> npt.NDArray[np.int64]:
            unit = rays / np.sqrt((rays * rays).sum(axis=1))[:, None]
            turned = (unit[:, None, :] * view[:3, :3]).sum(axis=-1)
            return self._caster.cast(self._model, self._joints, view[:3, 3].copy(), turned, 2 * depths[1]).geom

        return visible_fractions(self.camera, spheres, compiled.obstacle_geoms.start + tomatoes, depths, cast)


class TaskCamera:
    """Camera of a task in n simulations whose models share a layout.

    Args:
        camera: The camera.
        setup: Setup of any of the simulations.
        threads: Number of threads for ray casting.
    """

    def __init__(self, camera: DepthCamera, setup: Setup, threads: int):
        compiled = setup.world.compiled
        self._camera, self._tomatoes, self._arm = camera, compiled.obstacle_geoms.start, compiled.obstacle_geoms.stop
        self._rig = CameraRig((camera,), compiled, threads, renders_arm=True, renders_geoms=True)
        self._caster = RayCaster(compiled)

    def take(
        self,
        models: Sequence[mujoco.MjModel],
        joints: Array,
        frame: Array,
        tip: Array,
        tool: Array,
        setups: Sequence[Setup],
    ) -> list[View]:
        """Take a view in each of k simulations; see `CameraRig.render` for the arguments."""
        noises = [setup.disturbance.noise for setup in setups]
        images = self._rig.render(models, joints, frame, tip, tool, noises)
        scene_from_camera = scene_from_bases(frame) @ images.views[:, 0]
        views = []
        for k, setup in enumerate(setups):
            depth, geom = images.depth[k, 0], images.geom[k, 0]
            reading = perfect_reading(depth) if noises[k] is None else stereo_reading(depth, self._camera)
            tomato, count = geom - self._tomatoes, len(setup.world.compiled.scene.tomatoes)
            tomato = np.where((tomato >= 0) & (tomato < count), tomato, -1)
            view = View(
                self._camera, reading, images.views[k, 0], tomato, geom >= self._arm,
                self._caster, models[k], joints[k], setup, scene_from_camera[k],
            )  # fmt: skip
            views.append(view)
        return views

    def close(self) -> None:
        """Shut down the threads."""
        self._rig.close()
