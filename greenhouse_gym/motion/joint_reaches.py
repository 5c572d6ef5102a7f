"""Bounds on the motion of an arm's points per joint motion, used to prove motions between two configurations."""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np

from greenhouse_gym.geometry import Array
from greenhouse_gym.robots import Robot


@lru_cache(maxsize=32)
def arm_reaches(robot: Robot) -> Array:
    """Return the `joint_reaches` of an arm, read-only: they are the same in all scenes."""
    reaches = joint_reaches(robot.spec().compile())
    reaches.setflags(write=False)
    return reaches


def joint_reaches(model: mujoco.MjModel) -> Array:
    """Return the largest motion (joints,) of any point of the arm per radian or metre of each joint, metres.

    For a slide it is 1. For a hinge it is the largest distance of a moved point from its axis, computed from the tool
    inwards: parts that turn with a joint and no later one are measured in place; everything beyond the next joint lies
    within the distance between the two anchors plus the reach of the next anchor, plus the travel of slides.
    """
    n = int(model.njnt)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    owner = {int(model.jnt_bodyid[j]): j for j in range(n)}

    def last_joint(body: int) -> int:
        while body and body not in owner:
            body = int(model.body_parentid[body])
        return owner.get(body, -1)

    parts: list[list[int]] = [[] for _ in range(n)]
    for moving in np.flatnonzero(model.geom_bodyid > 0).tolist():
        if (joint := last_joint(int(model.geom_bodyid[moving]))) >= 0:
            parts[joint].append(moving)
    sliding = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    travel = np.where(sliding, np.abs(model.jnt_range - model.qpos0[:, None]).max(axis=1), 0.0)
    from_axis, from_anchor = np.zeros(n), np.zeros(n)
    beyond = 0.0
    for j in reversed(range(n)):
        anchor, axis = data.xanchor[j], data.xaxis[j]
        for geom in parts[j]:
            for point, radius in _geom_points(model, data, geom):
                arm = point - anchor
                from_axis[j] = max(from_axis[j], float(np.linalg.norm(np.cross(axis, arm))) + radius)
                from_anchor[j] = max(from_anchor[j], float(np.linalg.norm(arm)) + radius)
        if j + 1 < n:
            gap = data.xanchor[j + 1] - anchor
            from_axis[j] = max(from_axis[j], float(np.linalg.norm(np.cross(axis, gap))) + beyond)
            from_anchor[j] = max(from_anchor[j], float(np.linalg.norm(gap)) + beyond)
        # relative to the previous joint, a slide's anchor stays in place and its parts travel
        beyond = from_anchor[j] + travel[j]
    return np.where(sliding, 1.0, from_axis)


def _geom_points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> list[tuple[Array, float]]:
    """Return centers and radii of spheres whose hull contains a geom: a capsule's ends, or the bounding sphere."""
    center = data.geom_xpos[geom]
    if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_CAPSULE:
        return [(center, float(model.geom_rbound[geom]))]
    radius, half = model.geom_size[geom, :2]
    along = half * data.geom_xmat[geom].reshape(3, 3)[:, 2]
    return [(center - along, float(radius)), (center + along, float(radius))]
