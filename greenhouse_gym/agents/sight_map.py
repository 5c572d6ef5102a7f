"""What an arm has seen so far in an episode: points on surfaces, and the space that its camera looked through."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from greenhouse_gym.agents.depth_reading import perfect_reading, stereo_reading
from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.arm_spheres import ArmBalls
from greenhouse_gym.rendering.cameras import MAX_RANGE, TIP_FROM_WRIST, DepthCamera
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, joint_frames

FAR = 0.025
"""Clearances are told up to here, metres."""

_LOW, _HIGH = np.array([-0.4, -1.1, -0.8]), np.array([1.1, 1.1, 1.1])  # of the space that is kept, metres
_NEAR, _CELL = 0.015, 0.04  # sizes of the cells that know the point nearest to them, and of those seen or not, metres
_NEAR_SHAPE, _SHAPE = (np.ceil((_HIGH - _LOW) / size).astype(np.int64) for size in (_NEAR, _CELL))
_POINT = 0.012  # size of the cells that hold one point, metres
_FINE, _BITS, _NONE = 1e9, 24, np.iinfo(np.int64).max  # squared distances in mm^2 / 1000; bits of a point's index
_OWN, _TARGET = 0.008, 0.006  # what is so near to the arm's own surface, or to the target's, is it, metres
_STAND, _BASE = 0.25, 0.12  # up to this height, the arm's stand and base are within this distance of its axis, metres
_EVERY_RAY = 5  # one ray in so many says what was seen: no divisor of an image's width, so not always the same columns


class Sensed(NamedTuple):
    """What ``observation="depth"`` tells an arm of j joints.

    Attributes:
        depth: (h, w) metres along the view, 0 without a reading.
        joints: (j,) where the joints are, radians.
        command: (j,) where they are told to be, radians.
        target: (3,) the target's center in the frame of the arm's base, metres.
    """

    depth: npt.NDArray[np.float32]
    joints: Array
    command: Array
    target: Array


def sensed(observation: Mapping[str, Any], robot: Robot) -> Sensed:
    """What an observation with a depth image tells an arm."""
    state, count = observation["state"].astype(np.float64), len(robot.joints)
    joints, lead = state[:count], state[2 * count : 3 * count]
    command = np.clip(joints + lead, robot.lower, robot.upper)
    return Sensed(observation["depth"][0] * MAX_RANGE, joints, command, state[-3:])


def wrist_camera(chain: Chain, configurations: Array) -> tuple[Array, Array]:
    """Rotations (m, 3, 3) and places (m, 3), metres, of the camera of an arm in configurations (m, j)."""
    rotation, position = (frames[-1] for frames in joint_frames(chain, configurations))
    return rotation @ TIP_FROM_WRIST[:3, :3], position + rotation @ TIP_FROM_WRIST[:3, 3]


class Around(NamedTuple):
    """What is around the b balls of an arm in m configurations.

    Attributes:
        clearance: (m, b) distance to what was seen and, but for the cup's, to the target, metres up to `FAR`; negative
            inside.
        unknown: (m, b) which are in space not seen.
        centers: (m, b, 3) where they are, metres.
    """

    clearance: Array
    unknown: npt.NDArray[np.bool_]
    centers: Array


class SightMap:
    """What was seen, in the frame of the arm's base.

    Args:
        arm: The arm, which is no obstacle to itself.
        camera: The camera at its wrist.
        target: (3,) the target's center, metres: known without seeing it.
        radius: The target's radius, metres.
        noisy: Whether the images have the noise of a D435.

    Attributes:
        arm: The arm.
        doubt: (n,) by how much the points may be wrong, metres.
        version: Changes with what was seen on surfaces.
    """

    def __init__(self, arm: ArmBalls, camera: DepthCamera, target: Array, radius: float, noisy: bool = False):
        self.version = 0
        self.arm, self._camera, self._target, self._radius, self._noisy = arm, camera, target, radius, noisy
        self._points: Array = np.full((1, 3), np.inf)  # the first stands for none
        self.doubt: Array = np.empty(0)
        self._keys = np.empty(0, dtype=np.int64)
        self._reach = int((FAR + float(arm.radius.max())) / _NEAR) + 1
        self._shape = tuple(_NEAR_SHAPE + 2 * self._reach)
        self._nearest = np.full(int(np.prod(self._shape)), _NONE)  # squared distance of a point, then its index
        cube = np.indices((2 * self._reach + 1,) * 3).reshape(3, -1) - self._reach
        cube = cube[:, (cube * cube).sum(axis=0) <= self._reach**2]
        self._ball = _NEAR * cube
        self._steps = np.ravel_multi_index(tuple(cube + self._reach), self._shape)
        self._seen = np.zeros(int(_SHAPE.prod()), dtype=np.bool_)

    @property
    def points(self) -> Array:
        """(n, 3) points on surfaces, one for each cell of 12 mm, metres."""
        return self._points[1:]

    def seen(self, points: Array) -> npt.NDArray[np.bool_]:
        """Which of points (n, 3) the camera has looked at or through, (n,); those outside of what is kept were not."""
        kept = ((points > _LOW) & (points < _HIGH)).all(axis=1)
        return np.asarray(kept & self._seen[_cells(points)])

    def add(self, depth: npt.NDArray[np.float32], joints: Array) -> None:
        """Take in a depth image (h, w) along the view, metres, 0 without a reading, from a configuration (j,)."""
        turn, origin = (poses[0] for poses in wrist_camera(self.arm.chain, joints[None]))
        rays = self._camera.rays @ turn.T
        reading = stereo_reading(depth, self._camera) if self._noisy else perfect_reading(depth)
        z, doubt = reading.depth.reshape(-1), reading.doubt.reshape(-1)
        few, through = rays[::_EVERY_RAY], reading.through.reshape(-1)[::_EVERY_RAY]
        if self._noisy:  # the arm is too near for a reading
            through = np.where(self._meets_arm(origin, few, joints), 0.0, through)
        shares = np.arange(0.5, MAX_RANGE / _CELL) * _CELL
        ahead = np.nonzero(shares < through[:, None])
        self._seen[_cells(origin + shares[ahead[1], None] * few[ahead[0]])] = True
        points, doubt = origin + z[z > 0, None] * rays[z > 0], doubt[z > 0]
        foreign = self._foreign(points, doubt, joints)
        self._keep(points[foreign], doubt[foreign])

    def _meets_arm(self, origin: Array, rays: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Which of rays (k, 3) from a place (3,) meet the arm in a configuration (j,)."""
        off = self.arm.centers(joints[None])[0] - origin
        along = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ off.T
        beside = (off * off).sum(axis=1) - along**2
        return np.asarray(((along > 0) & (beside < (self.arm.radius + _OWN) ** 2)).any(axis=1))

    def _foreign(self, points: Array, doubt: Array, joints: Array) -> npt.NDArray[np.bool_]:
        """Which points (k, 3) belong neither to the arm, nor to its stand, nor to the target, and are near."""
        inside = ((points > _LOW) & (points < _HIGH)).all(axis=1)
        stand = (points[:, 2] < _BASE) & ((points[:, :2] ** 2).sum(axis=1) < _STAND**2)
        target = ((points - self._target) ** 2).sum(axis=1) < (self._radius + _TARGET + doubt) ** 2
        foreign = inside & ~stand & ~target
        centers = self.arm.centers(joints[None])[0]
        near = np.flatnonzero(foreign)
        gap = cdist(points[near], centers) - self.arm.radius
        foreign[near[gap.min(axis=1) < _OWN]] = False
        return foreign

    def _keep(self, points: Array, doubt: Array) -> None:
        cells = np.floor((points - _LOW) / _POINT).astype(np.int64)
        keys = (cells[:, 0] << 40) | (cells[:, 1] << 20) | cells[:, 2]
        keys, first = np.unique(keys, return_index=True)
        first = first[~np.isin(keys, self._keys, assume_unique=True)]
        fresh = points[first]
        self._keys = np.union1d(self._keys, keys)
        self._points, self.doubt = np.concatenate([self._points, fresh]), np.concatenate([self.doubt, doubt[first]])
        self.version += bool(len(fresh))
        cell = ((fresh - _LOW) / _NEAR).astype(np.int64)
        off = _LOW + (cell + 0.5) * _NEAR - fresh
        squared = (off * off).sum(axis=1)[:, None] + 2.0 * (off @ self._ball) + (self._ball * self._ball).sum(axis=0)
        index = np.arange(len(self._points) - len(fresh), len(self._points))
        keys = ((squared * _FINE).astype(np.int64) << _BITS) | index[:, None]
        places = np.ravel_multi_index(tuple(cell.T), self._shape)[:, None] + self._steps
        np.minimum.at(self._nearest, places.reshape(-1), keys.reshape(-1))

    def around(self, configurations: Array) -> Around:
        """What is around the arm's balls in configurations (m, j), radians."""
        centers = self.arm.centers(configurations)
        flat, shape = centers.reshape(-1, 3), centers.shape[:2]
        cells = np.clip(((flat - _LOW) / _NEAR).astype(np.int64), -self._reach, _NEAR_SHAPE + self._reach - 1)
        known = self._nearest[np.ravel_multi_index(tuple((cells + self._reach).T), self._shape)]
        nearest = self._points[np.where(known == _NONE, 0, known & (2**_BITS - 1))]
        away = np.sqrt(((flat - nearest) ** 2).sum(axis=1)).reshape(shape)
        target = np.sqrt(((flat - self._target) ** 2).sum(axis=1)) - self._radius
        away = np.minimum(away, np.where(self.arm.cup, np.inf, target.reshape(shape)))
        unknown = ~self._seen[_cells(flat)].reshape(shape)
        return Around(np.minimum(away - self.arm.radius, FAR), unknown, centers)


def _cells(points: Array) -> npt.NDArray[np.int64]:
    """Indices of the cells of points (k, 3); those outside count as in the cells at the edge."""
    cells = np.clip(((points - _LOW) / _CELL).astype(np.int64), 0, _SHAPE - 1)
    return np.asarray((cells[:, 0] * _SHAPE[1] + cells[:, 1]) * _SHAPE[2] + cells[:, 2])
