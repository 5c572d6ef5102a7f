"""Map of the wrist camera's observations in an episode: surface points, and the space it looked through."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from greenhouse_gym.envs.features import feature_slices
from greenhouse_gym.envs.image_observations import DepthObservation
from greenhouse_gym.envs.tasks import TomatoReach
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmSpheres
from greenhouse_gym.motion.voxel_map import VoxelBox
from greenhouse_gym.rendering.cameras import MAX_RANGE, TIP_FROM_WRIST, DepthCamera
from greenhouse_gym.rendering.depth_reading import perfect_reading, stereo_reading
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, joint_frames

_BOX = VoxelBox((-0.4, -1.1, -0.8), (38, 55, 48), 0.04)  # cells that are observed or not
_POINTS = VoxelBox(_BOX.low, (127, 184, 161), 0.012)  # cells that keep one point each
_ARM, _TARGET = 0.008, 0.006  # metres: points so near to the surface of the arm or the target belong to it
_STAND, _BASE = 0.25, 0.12  # metres: radius and height of the arm's stand and base
_EVERY_RAY = 5  # one ray in so many marks cells; it does not divide the image's width, so the columns vary by row


class WristReading(NamedTuple):
    """Content of ``observation="depth"`` for an arm of j joints.

    Attributes:
        depth: (h, w) depth along the view, metres; 0 without a reading.
        joints: (j,) joint positions, radians.
        command: (j,) commanded joint positions, radians.
        target: (3,) the target's center in the frame of the arm's base, metres.
    """

    depth: npt.NDArray[np.float32]
    joints: Array
    command: Array
    target: Array


def wrist_reading(observation: Mapping[str, Any], robot: Robot) -> WristReading:
    """Decode an observation of ``observation="depth"`` of an arm."""
    state = observation["state"].astype(np.float64)
    features = _features_of(robot)
    joints, command_error, target = (
        state[features[name]] for name in ("joint_position", "command_error", "target_position")
    )
    command = np.clip(joints + command_error, robot.lower, robot.upper)
    return WristReading(observation["depth"][0] * MAX_RANGE, joints, command, target)


@lru_cache(maxsize=8)
def _features_of(robot: Robot) -> Mapping[str, slice]:
    return feature_slices(DepthObservation()(robot, TomatoReach()).layout)


def wrist_camera(chain: Chain, configurations: Array) -> tuple[Array, Array]:
    """Return rotations (m, 3, 3) and positions (m, 3), metres, of the wrist camera in configurations (m, j)."""
    rotation, position = (frames[-1] for frames in joint_frames(chain, configurations))
    return rotation @ TIP_FROM_WRIST[:3, :3], position + rotation @ TIP_FROM_WRIST[:3, 3]


class OccupancyMap:
    """Surface points and observed cells in the frame of the arm's base.

    Args:
        arm: The arm, whose own surface is left out.
        camera: The camera at its wrist.
        target: (3,) the target's center, metres; the target is left out, too.
        radius: The target's radius, metres.
        noisy: Whether the images have the noise of a D435.

    Attributes:
        points: (n, 3) points on surfaces, one per cell of 12 mm, metres.
        uncertainty: (n,) their error bounds, metres.
    """

    def __init__(self, arm: ArmSpheres, camera: DepthCamera, target: Array, radius: float, noisy: bool = False):
        self._arm, self._camera, self._target, self._radius, self._noisy = arm, camera, target, radius, noisy
        self.points: Array = np.empty((0, 3))
        self.uncertainty: Array = np.empty(0)
        self._has_point = np.zeros(_POINTS.size, dtype=np.bool_)
        self._observed = np.zeros(_BOX.size, dtype=np.bool_)

    def observed(self, points: Array) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3) the camera has looked at or through; false outside of the mapped space."""
        cells = _BOX.indices(points)
        return np.asarray((cells >= 0) & self._observed[cells])

    def add(self, depth: npt.NDArray[np.float32], joints: Array) -> None:
        """Add a depth image (h, w), metres along the view, 0 without a reading, taken in a configuration (j,)."""
        turn, origin = (poses[0] for poses in wrist_camera(self._arm.chain, joints[None]))
        rays = self._camera.rays @ turn.T
        reading = stereo_reading(depth, self._camera) if self._noisy else perfect_reading(depth)
        z, uncertainty = reading.depth.reshape(-1), reading.uncertainty.reshape(-1)
        subset, free = rays[::_EVERY_RAY], reading.free.reshape(-1)[::_EVERY_RAY]
        if self._noisy:  # the arm is too near for a reading
            free = np.where(self._meets_arm(origin, subset, joints), 0.0, free)
        self._observed |= _BOX.looked_through(origin, subset, free)
        points, uncertainty = origin + z[z > 0, None] * rays[z > 0], uncertainty[z > 0]
        foreign = self._foreign(points, uncertainty, joints)
        self._keep(points[foreign], uncertainty[foreign])

    def _meets_arm(self, origin: Array, rays: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Return which rays (k, 3) from a point (3,) meet the arm in a configuration (j,)."""
        offset = self._arm.centers(joints[None])[0] - origin
        along = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ offset.T
        squared = (offset * offset).sum(axis=1) - along**2
        return np.asarray(((along > 0) & (squared < (self._arm.radius + _ARM) ** 2)).any(axis=1))

    def _foreign(self, points: Array, uncertainty: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Return which points (k, 3) lie in the mapped space and on neither the arm, its stand nor the target."""
        inside = _BOX.indices(points) >= 0
        stand = (points[:, 2] < _BASE) & ((points[:, :2] ** 2).sum(axis=1) < _STAND**2)
        target = ((points - self._target) ** 2).sum(axis=1) < (self._radius + _TARGET + uncertainty) ** 2
        foreign = inside & ~stand & ~target
        candidates = np.flatnonzero(foreign)
        foreign[candidates[self._arm.near(points[candidates], joints[None], _ARM)]] = False
        return foreign

    def _keep(self, points: Array, uncertainty: Array) -> None:
        """Keep the first point of each cell that has none yet."""
        cells = _POINTS.indices(points)
        new = np.flatnonzero(~self._has_point[cells])
        first = new[np.unique(cells[new], return_index=True)[1]]
        self._has_point[cells[new]] = True
        self.points = np.concatenate([self.points, points[first]])
        self.uncertainty = np.concatenate([self.uncertainty, uncertainty[first]])
