"""Batched forward kinematics and Jacobians of the tool of an arm, in numpy, read from its MuJoCo model.

The grasp point lies a given distance ahead of the tip along the tool axis (the z axis of the tip site).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array, pose


@dataclass(frozen=True, eq=False)
class Chain:
    """Chain of n joints from the world to the tip: fixed pose, joint, fixed pose, joint, ..., fixed pose.

    Attributes:
        offsets: (n + 1, 4, 4) fixed poses: before each joint (its anchor at the origin), and from the last to the tip.
        axes: (n, 3) unit joint axes in the frame after the joint's offset.
        sliding: (n,) True for joints that slide along their axis instead of turning about it.
    """

    offsets: Array
    axes: Array
    sliding: npt.NDArray[np.bool_]

    @cached_property
    def table(self) -> Array:
        """(n, 16) the joints as `greenhouse_gym.motion.collision_kernels` wants them."""
        return np.column_stack([self.offsets[:-1, :3].reshape(-1, 12), self.axes, self.sliding])


class ToolState(NamedTuple):
    """Positions and derivatives of the tool in m configurations of a chain of n joints, world frame.

    Attributes:
        point: (m, 3) grasp points, metres.
        axis: (m, 3) unit tool axes.
        jacobian: (m, 3, n) derivative of the grasp point with respect to the joint positions, metres per radian (or
            metre).
        joint_axes: (m, 3, n) rotation of the tool with each joint, radians per radian: unit axes, zero for slides.
    """

    point: Array
    axis: Array
    jacobian: Array
    joint_axes: Array


def tool_chain(model: mujoco.MjModel, tip_site: int) -> Chain:
    """Read the chain of joints that leads to a site; joints come in the order of ``qpos``."""
    bodies = []
    body = int(model.site_bodyid[tip_site])
    while body:
        bodies.append(body)
        body = int(model.body_parentid[body])
    offsets, axes, sliding = [], [], []
    rest = np.eye(4)
    for body in reversed(bodies):
        rest = rest @ _pose(model.body_pos[body], model.body_quat[body])
        first = int(model.body_jntadr[body])
        for joint in range(first, first + int(model.body_jntnum[body])):
            anchor = model.jnt_pos[joint]
            offsets.append(rest @ pose(translation=anchor))
            axes.append(model.jnt_axis[joint])
            sliding.append(model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE)
            rest = pose(translation=-anchor)
    offsets.append(rest @ _pose(model.site_pos[tip_site], model.site_quat[tip_site]))
    return Chain(np.array(offsets), np.array(axes), np.array(sliding))


def tool_state(chain: Chain, configurations: npt.ArrayLike, ahead: float = 0.0) -> ToolState:
    """Compute grasp points, tool axes and Jacobians of many configurations at once.

    Args:
        chain: The chain.
        configurations: (m, n) joint positions, radians or metres.
        ahead: Distance of the grasp point from the tip along the tool axis, metres.
    """
    q = np.asarray(configurations, dtype=np.float64)
    m, n = q.shape
    rotation: Array = np.broadcast_to(np.eye(3), (m, 3, 3))
    position = np.zeros((m, 3))
    anchors, axes = np.empty((n, m, 3)), np.empty((n, m, 3))
    for j in range(n):
        position = position + rotation @ chain.offsets[j, :3, 3]
        rotation = rotation @ chain.offsets[j, :3, :3]
        anchors[j] = position
        axes[j] = rotation @ chain.axes[j]
        if chain.sliding[j]:
            position = position + q[:, j, None] * axes[j]
        else:
            rotation = rotation @ _rotations(chain.axes[j], q[:, j])
    tip = chain.offsets[n]
    axis = rotation @ tip[:3, 2]
    point = position + rotation @ tip[:3, 3] + ahead * axis
    sliding = chain.sliding[:, None, None]
    jacobian = np.where(sliding, axes, np.cross(axes, point - anchors))
    axes = np.where(sliding, 0.0, axes)
    return ToolState(point, axis, np.moveaxis(jacobian, 0, -1), np.moveaxis(axes, 0, -1))


def joint_frames(chain: Chain, configurations: npt.ArrayLike) -> tuple[Array, Array]:
    """Compute the frames after each joint: rotations (n + 1, m, 3, 3) and positions (n + 1, m, 3), metres.

    The last frame is the tip's.

    Args:
        chain: The chain of n joints.
        configurations: (m, n) joint positions, radians or metres.
    """
    q = np.asarray(configurations, dtype=np.float64)
    m, n = q.shape
    rotations, positions = np.empty((n + 1, m, 3, 3)), np.empty((n + 1, m, 3))
    rotation: Array = np.broadcast_to(np.eye(3), (m, 3, 3))
    position = np.zeros((m, 3))
    for j in range(n + 1):
        position = position + rotation @ chain.offsets[j, :3, 3]
        rotation = rotation @ chain.offsets[j, :3, :3]
        if j < n and chain.sliding[j]:
            position = position + q[:, j, None] * (rotation @ chain.axes[j])
        elif j < n:
            rotation = rotation @ _rotations(chain.axes[j], q[:, j])
        rotations[j], positions[j] = rotation, position
    return rotations, positions


def _pose(position: Array, quaternion: Array) -> Array:
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return pose(matrix.reshape(3, 3), position)


def _rotations(axis: Array, angles: Array) -> Array:
    """Return rotations (m, 3, 3) about one axis by many angles (Rodrigues' formula)."""
    outer = np.outer(axis, axis)
    skew = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    cos, sin = np.cos(angles)[:, None, None], np.sin(angles)[:, None, None]
    return np.asarray(cos * (np.eye(3) - outer) + sin * skew + outer)
