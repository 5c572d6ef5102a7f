"""An arm as balls: where its links are in many configurations at once, in the frame of its base."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.motion.reach import arm_reaches
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, joint_frames, tool_chain
from greenhouse_gym.scene.mjcf import base_position, compile_scene
from greenhouse_gym.scene.obstacles import Surroundings

SPACING = 0.8
"""Distance between the balls along a link, in its radii."""

_WAIST = float(np.sqrt(1 - (SPACING / 2) ** 2))  # radius of a row of balls where it is thinnest, in theirs

PARTS = ("tool", "wrist", "arm")
"""What the balls belong to: what turns with the last joint, with one of the two before it, or with an earlier one. The
first joint's link stays where it is, and belongs to none."""


@dataclass(frozen=True, eq=False)
class ArmBalls:
    """An arm with nothing around it but its stand and the floor.

    Attributes:
        chain: Its joints, in the frame of its base.
        owner: (b,) the joint that moves each ball.
        inside: (b, 3) the balls' centers in the frames of their joints, metres.
        radius: (b,) metres.
        part: (b,) index into `PARTS`, -1 for those that stay where they are.
        cup: (b,) which are the cup's, which may touch the target.
        checker: Says where the arm touches itself, the stand or the floor.
    """

    chain: Chain
    owner: npt.NDArray[np.int64]
    inside: Array
    radius: Array
    part: npt.NDArray[np.int64]
    cup: npt.NDArray[np.bool_]
    checker: CollisionChecker

    def centers(self, configurations: Array) -> Array:
        """(m, b, 3) where the balls are in configurations (m, j), metres."""
        rotation, position = joint_frames(self.chain, configurations)
        turned = np.einsum("bmxy,by->mbx", rotation[self.owner], self.inside)
        return np.asarray(position[self.owner].transpose(1, 0, 2) + turned)


@lru_cache(maxsize=8)
def arm_balls(robot: Robot) -> ArmBalls:
    """The balls of an arm, made once."""
    empty = Surroundings(name="alone")
    compiled = compile_scene(empty, robot)
    model, base = compiled.model, base_position(empty, robot)
    chain = tool_chain(model, compiled.tip_site)
    offsets = chain.offsets.copy()
    offsets[0, :3, 3] -= base
    chain = Chain(offsets, chain.axes, chain.sliding)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation, position = joint_frames(chain, data.qpos[None])
    owners, insides, radii, cups = [], [], [], []
    for geom in np.flatnonzero(model.geom_bodyid > 0).tolist():
        body = int(model.geom_bodyid[geom])
        while body and not model.body_jntnum[body]:
            body = int(model.body_parentid[body])
        if not body:
            continue
        joint, points, radius = int(model.body_jntadr[body]), *_along(model, data, geom)
        owners += [joint] * len(points)
        insides += list((points - base - position[joint, 0]) @ rotation[joint, 0])
        radii += [radius] * len(points)
        cups += [geom == compiled.cup_geom] * len(points)
    owner, last = np.array(owners), len(robot.joints) - 1
    part = np.where(owner == last, 0, np.where(owner >= last - 2, 1, np.where(owner > 0, 2, -1)))
    checker = CollisionChecker(model, arm_reaches(robot))
    return ArmBalls(chain, owner, np.array(insides), np.array(radii), part, np.array(cups), checker)


def _along(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Array, float]:
    """Centers (k, 3) of balls that cover a geom, and their radius, metres: along its axis, if it is long."""
    center, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
        radius, half = (float(size) for size in model.geom_size[geom, :2])
        axis = turn[:, 2]
    else:
        middle, extents = model.geom_aabb[geom].reshape(2, 3)
        longest = int(extents.argmax())
        across = float(np.linalg.norm(np.delete(extents, longest)))
        if extents[longest] < across:
            return np.array([center]), float(model.geom_rbound[geom])
        center, axis, half = center + turn @ middle, turn[:, longest], float(extents[longest])
        radius = across / _WAIST
    count = 2 + int(2 * half / (SPACING * radius))
    return center + np.linspace(-half, half, count)[:, None] * axis, radius
