"""Spheres around all that moves with an arm, and how far they move with its joints."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.geometry import Array


class ArmSpheres(NamedTuple):
    """Spheres that together hold all that moves with an arm.

    Attributes:
        bodies: (n,) the body of each sphere.
        middles: (n, 3) their middles in the frames of these bodies, metres.
        radii: (n,) radii, metres.
        levers: (n, joints) maximum motion of their middles with each joint, metres per radian or metre.
        slides: (joints,) mask of the joints that slide.
    """

    bodies: npt.NDArray[np.int64]
    middles: Array
    radii: Array
    levers: Array
    slides: npt.NDArray[np.bool_]

    @property
    def frames(self) -> slice:
        """The bodies whose poses place the spheres."""
        return slice(int(self.bodies.max()) + 1)


def arm_spheres(model: mujoco.MjModel, joints: int) -> ArmSpheres:
    """Return spheres around all that moves with an arm; a capsule gets three."""
    moving = np.flatnonzero(model.body_treeid[model.geom_bodyid] == model.body_treeid[model.jnt_bodyid[0]])
    middles, radii, bodies = [], [], []
    for geom in moving.tolist():
        radius, thirds = float(model.geom_rbound[geom]), [0.0]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CAPSULE:
            third = float(model.geom_size[geom, 1]) / 3
            radius, thirds = float(model.geom_size[geom, 0]) + third, [-2 * third, 0.0, 2 * third]
        axis = np.empty(3)
        mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), model.geom_quat[geom])
        for offset in thirds:
            middles.append(model.geom_pos[geom] + offset * axis)
            radii.append(radius + float(model.geom_margin[geom] + model.geom_gap[geom]))
            bodies.append(int(model.geom_bodyid[geom]))
    levers = np.array([_levers(model, joints, body, middle) for body, middle in zip(bodies, middles, strict=True)])
    slides = np.asarray(model.jnt_type[:joints] == mujoco.mjtJoint.mjJNT_SLIDE)
    return ArmSpheres(np.array(bodies), np.array(middles), np.array(radii), levers, slides)


def _levers(model: mujoco.MjModel, joints: int, body: int, middle: Array) -> Array:
    """Return the maximum motion (joints,) of a point in the frame of a body, in any configuration."""
    levers, reach = np.zeros(joints), float(np.linalg.norm(middle))
    while body:
        for joint in range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]):
            slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
            levers[joint] = 1.0 if slides else reach + float(np.linalg.norm(model.jnt_pos[joint]))
        reach += float(np.linalg.norm(model.body_pos[body]))
        body = int(model.body_parentid[body])
    return levers
