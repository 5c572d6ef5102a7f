"""The links of an arm covered by spheres, placed for many configurations at once in the frame of its base."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array
from greenhouse_gym.motion.collision import CollisionChecker
from greenhouse_gym.motion.joint_reaches import arm_reaches
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.kinematics import Chain, joint_frames, tool_chain
from greenhouse_gym.scene.mjcf import base_position, compile_scene
from greenhouse_gym.scene.obstacles import Surroundings

SPACING = 0.8
"""Distance between the centers of spheres along a link, in radii."""

_WAIST = float(np.sqrt(1 - (SPACING / 2) ** 2))  # smallest radius of the union of a row of unit spheres


@dataclass(frozen=True, eq=False)
class ArmSpheres:
    """Spheres that cover an arm, and its model without obstacles other than its stand and the floor.

    Attributes:
        chain: Its joints, in the frame of its base.
        owner: (b,) the joint that moves each sphere.
        inside: (b, 3) centers in the frames of these joints, metres.
        radius: (b,) metres.
        moving: (b,) false for the spheres of the first joint's link, which stays in place.
        checker: Checks for contacts of the arm with itself, the stand and the floor.
    """

    chain: Chain
    owner: npt.NDArray[np.int64]
    inside: Array
    radius: Array
    moving: npt.NDArray[np.bool_]
    checker: CollisionChecker

    def centers(self, configurations: Array) -> Array:
        """Return the centers (m, b, 3) of the spheres in configurations (m, j), metres."""
        rotation, position = joint_frames(self.chain, configurations)
        turned = np.einsum("bmxy,by->mbx", rotation[self.owner], self.inside)
        return np.asarray(position[self.owner].transpose(1, 0, 2) + turned)

    def near(self, points: Array, configurations: Array, limit: float, moving: bool = False) -> npt.NDArray[np.bool_]:
        """Return which points (n, 3) are within a distance of an arm in any of some configurations (m, j), (n,).

        Args:
            points: Metres.
            configurations: Radians.
            limit: The distance, metres.
            moving: Leave out the spheres that stay in place.
        """
        from greenhouse_gym.motion.sphere_kernels import mark_near  # loads numba

        centers, radius = self.centers(configurations), self.radius
        if moving:
            centers, radius = centers[:, self.moving], radius[self.moving]
        near = np.empty(len(points), dtype=np.bool_)
        mark_near(np.ascontiguousarray(points), np.ascontiguousarray(centers), radius, limit, near)
        return near


@lru_cache(maxsize=8)
def arm_spheres(robot: Robot) -> ArmSpheres:
    """Return the spheres of an arm; the last results are cached."""
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
    owners, insides, radii = [], [], []
    for geom in np.flatnonzero(model.geom_bodyid > 0).tolist():
        body = int(model.geom_bodyid[geom])
        while body and not model.body_jntnum[body]:
            body = int(model.body_parentid[body])
        if not body:
            continue
        joint, points, radius = int(model.body_jntadr[body]), *_covering(model, data, geom)
        owners += [joint] * len(points)
        insides += list((points - base - position[joint, 0]) @ rotation[joint, 0])
        radii += [radius] * len(points)
    owner = np.array(owners)
    checker = CollisionChecker(model, arm_reaches(robot))
    return ArmSpheres(chain, owner, np.array(insides), np.array(radii), owner > 0, checker)


def _covering(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> tuple[Array, float]:
    """Return centers (k, 3) and the radius of spheres that cover a geom, in a row along its axis if it is long."""
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
