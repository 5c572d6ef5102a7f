"""Observations with camera images by ray casting (without OpenGL), and the arm's own state."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from greenhouse_gym.envs.features import MAX_OFFSET, FeatureVector
from greenhouse_gym.envs.observations import REACH, ObservationSpec, Observed, body_features
from greenhouse_gym.envs.state import State
from greenhouse_gym.envs.task import Task
from greenhouse_gym.rendering.cameras import MAX_RANGE, DepthCamera
from greenhouse_gym.robots import Robot


class _WithImages(ObservationSpec, ABC):
    """Joints and features of the task; subclasses add the images of one camera."""

    def __init__(self, robot: Robot, task: Task, camera: DepthCamera, images: dict[str, spaces.Space[Any]]):
        self._vector = FeatureVector(robot, body_features(task))
        self.layout = self._vector.layout
        self.cameras = (camera,)
        self.space = spaces.Dict({**images, "state": self._vector.space})


@dataclass(frozen=True)
class DepthObservation:
    """Settings of the observation ``depth``: a depth image and the arm's own state.

    Attributes:
        camera: The camera.
    """

    camera: DepthCamera = field(default_factory=DepthCamera)

    def __call__(self, robot: Robot, task: Task = REACH) -> _Depth:
        """Return the observation for an arm and a task."""
        return _Depth(robot, task, self.camera)


@dataclass(frozen=True)
class PointsObservation:
    """Settings of the observation ``points``: a point cloud without the arm, and the arm's own state.

    Attributes:
        camera: The camera; the cloud has one point per pixel.
    """

    camera: DepthCamera = field(default_factory=lambda: DepthCamera("mast", 32, 24))

    def __call__(self, robot: Robot, task: Task = REACH) -> _Points:
        """Return the observation for an arm and a task."""
        return _Points(robot, task, self.camera)


@dataclass(frozen=True)
class RgbObservation:
    """Settings of the observations ``rgb`` and ``rgbd``: a color image and the arm's own state.

    Attributes:
        camera: The camera.
        depth: Include a depth image as well.
    """

    camera: DepthCamera = field(default_factory=DepthCamera)
    depth: bool = False

    def __call__(self, robot: Robot, task: Task = REACH) -> _Rgb:
        """Return the observation for an arm and a task."""
        return _Rgb(robot, task, self.camera, self.depth)


class _Depth(_WithImages):
    renders_arm = True

    def __init__(self, robot: Robot, task: Task, camera: DepthCamera):
        super().__init__(robot, task, camera, {"depth": _depth_space(camera)})

    def __call__(self, state: State) -> Observed:
        return {"depth": _depth_image(state), "state": self._vector(state)}


class _Points(_WithImages):
    def __init__(self, robot: Robot, task: Task, camera: DepthCamera):
        self._rays = camera.rays
        cloud = spaces.Box(-MAX_OFFSET, MAX_OFFSET, (len(self._rays), 3), dtype=np.float32)
        super().__init__(robot, task, camera, {"points": cloud})

    def __call__(self, state: State) -> Observed:
        depth = state.depth.reshape(len(state.depth), -1, 1)
        view = state.views[:, 0]
        inside = depth * self._rays  # camera frame
        points = inside @ view[:, :3, :3].transpose(0, 2, 1) + view[:, None, :3, 3]
        cloud = np.where(depth > 0, np.clip(points, -MAX_OFFSET, MAX_OFFSET), 0.0).astype(np.float32)
        return {"points": cloud, "state": self._vector(state)}


class _Rgb(_WithImages):
    renders_arm = renders_color = True

    def __init__(self, robot: Robot, task: Task, camera: DepthCamera, depth: bool):
        color = spaces.Box(0, 255, (3, camera.height, camera.width), dtype=np.uint8)
        super().__init__(robot, task, camera, {"rgb": color, **({"depth": _depth_space(camera)} if depth else {})})
        self._with_depth = depth

    def __call__(self, state: State) -> Observed:
        color = np.ascontiguousarray(state.color[:, 0].transpose(0, 3, 1, 2))
        depth = {"depth": _depth_image(state)} if self._with_depth else {}
        return {**depth, "rgb": color, "state": self._vector(state)}


def _depth_space(camera: DepthCamera) -> spaces.Box:
    return spaces.Box(0.0, 1.0, (1, camera.height, camera.width), dtype=np.float32)


def _depth_image(state: State) -> npt.NDArray[np.float32]:
    return state.depth / np.float32(MAX_RANGE)
