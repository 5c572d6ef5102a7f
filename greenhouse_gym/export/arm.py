"""An arm as a tree of links and joints, read from its MuJoCo model, for formats other than MJCF."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.export.primitives import Kind, Primitive
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.robot import TIP_SITE

_KINDS: dict[int, Kind] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}


@dataclass(frozen=True, eq=False)
class Joint:
    """Motion of a link relative to its parent.

    Attributes:
        name: Name of the joint.
        kind: "revolute", "prismatic" or "fixed".
        axis: (3,) in the link's frame, whose origin is the joint.
        lower: Lower limit, radians or metres.
        upper: Upper limit, radians or metres.
        velocity: Speed limit, radians or metres per second.
    """

    name: str
    kind: str
    axis: Array
    lower: float = 0.0
    upper: float = 0.0
    velocity: float = 0.0


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid part of an arm.

    Attributes:
        name: Name of the link.
        parent: Name of its parent; None for the base.
        pose: (4, 4) pose in the parent's frame when the joint is at 0.
        joint: Joint to the parent.
        parts: Shapes in the link's frame.
        mass: Mass, kilograms.
        center: (4, 4) pose of the frame in which the inertia is diagonal.
        inertia: (3,) diagonal of the inertia, kg m^2.
    """

    name: str
    parent: str | None
    pose: Array
    joint: Joint
    parts: tuple[Primitive, ...]
    mass: float
    center: Array
    inertia: Array


def links_of(robot: Robot) -> list[Link]:
    """Return an arm's links, parents before children, and last a fixed, empty link ``tip``."""
    model = robot.spec().compile()
    links = []
    for body in range(1, model.nbody):
        parent = int(model.body_parentid[body])
        joint = _joint(model, robot, body)
        anchor = np.zeros(3) if joint.kind == "fixed" else model.jnt_pos[int(model.body_jntadr[body])]
        assert int(model.body_jntnum[body]) <= 1, "an arm's body has one joint at most"
        assert np.abs(anchor).max() < 1e-9, "an arm's joints are at the origins of their bodies"
        links.append(
            Link(
                name=model.body(body).name or f"link_{body}",
                parent=None if parent == 0 else model.body(parent).name or f"link_{parent}",
                pose=_pose(model.body_pos[body], model.body_quat[body]),
                joint=joint,
                parts=tuple(_part(model, geom) for geom in np.flatnonzero(model.geom_bodyid == body).tolist()
                            if int(model.geom_type[geom]) in _KINDS),
                mass=float(model.body_mass[body]),
                center=_pose(model.body_ipos[body], model.body_iquat[body]),
                inertia=model.body_inertia[body].copy(),
            )
        )  # fmt: skip
    tip = model.site(TIP_SITE)
    links.append(
        Link(
            "tip", model.body(int(tip.bodyid[0])).name, _pose(tip.pos, tip.quat),
            Joint("tip_joint", "fixed", np.array([0.0, 0.0, 1.0])), (), 0.0, np.eye(4), np.zeros(3),
        )
    )  # fmt: skip
    return links


def _joint(model: mujoco.MjModel, robot: Robot, body: int) -> Joint:
    if not int(model.body_jntnum[body]):
        return Joint(f"{model.body(body).name}_joint", "fixed", np.array([0.0, 0.0, 1.0]))
    j = int(model.body_jntadr[body])
    slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
    k = robot.joints.index(model.joint(j).name)
    limits = (robot.lower[k], robot.upper[k], robot.velocity_limits[k])
    return Joint(
        model.joint(j).name, "prismatic" if slides else "revolute", model.jnt_axis[j].copy(), *map(float, limits)
    )


def _part(model: mujoco.MjModel, geom: int) -> Primitive:
    kind = _KINDS[int(model.geom_type[geom])]
    size = model.geom_size[geom]
    sizes: dict[str, tuple[float, ...]] = {
        "sphere": (size[0],),
        "capsule": (size[0], 2 * size[1]),
        "cylinder": (size[0], 2 * size[1]),
    }
    color = model.geom_rgba[geom, :3]
    return Primitive(
        model.geom(geom).name or f"geom_{geom}",
        kind,
        tuple(map(float, sizes.get(kind, tuple(size)))),
        _pose(model.geom_pos[geom], model.geom_quat[geom]),
        (float(color[0]), float(color[1]), float(color[2])),
    )


def _pose(position: Array, quaternion: Array) -> Array:
    return pose(Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), position)
