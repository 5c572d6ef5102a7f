"""URDF and SDF of a scene with an arm, which is read from its MuJoCo model as a tree of links and joints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from xml.etree import ElementTree as Tree

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.export.primitives import (
    Kind,
    Primitive,
    primitives,
    roll_pitch_yaw,
    without_capsules,
    without_ellipsoids,
)
from greenhouse_gym.geometry import Array, pose
from greenhouse_gym.robots import Robot
from greenhouse_gym.robots.robot import TIP_SITE
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import arm_pose

_KINDS: dict[int, Kind] = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
}

_EFFORT = 150.0
"""Maximum torque or force of a joint, N m or N; URDF requires one, but the scenes' servos have none."""


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


def urdf(scene: Scene, robot: Robot) -> bytes:
    """Return a URDF with the scene as the link ``world`` and the arm on it.

    URDF has no capsules and no ellipsoids: a capsule becomes a cylinder and two spheres, which is exact, an ellipsoid
    its enclosing sphere.
    """
    root = Tree.Element("robot", name=scene.name)
    world = Tree.SubElement(root, "link", name="world")
    for part in _plain(primitives(scene)):
        _urdf_shape(world, part)
    for link in links_of(robot):
        own = Tree.SubElement(root, "link", name=link.name)
        if link.mass > 0:
            inertial = Tree.SubElement(own, "inertial")
            _origin(inertial, link.center)
            Tree.SubElement(inertial, "mass", value=_numbers(link.mass))
            ixx, iyy, izz = map(_numbers, link.inertia)
            Tree.SubElement(inertial, "inertia", ixx=ixx, iyy=iyy, izz=izz, ixy="0", ixz="0", iyz="0")
        for part in _plain(link.parts):
            _urdf_shape(own, part)
        joint = Tree.SubElement(root, "joint", name=link.joint.name, type=link.joint.kind)
        Tree.SubElement(joint, "parent", link=link.parent or "world")
        Tree.SubElement(joint, "child", link=link.name)
        _origin(joint, link.pose if link.parent else arm_pose(scene, robot) @ link.pose)
        if link.joint.kind != "fixed":
            Tree.SubElement(joint, "axis", xyz=_numbers(*link.joint.axis))
            lower, upper, velocity = map(_numbers, (link.joint.lower, link.joint.upper, link.joint.velocity))
            Tree.SubElement(joint, "limit", lower=lower, upper=upper, velocity=velocity, effort=_numbers(_EFFORT))
    return _text(root)


def sdf(scene: Scene, robot: Robot) -> bytes:
    """Return a world with two models, the static scene and the arm; SDF has capsules and ellipsoids."""
    root = Tree.Element("sdf", version="1.9")
    world = Tree.SubElement(root, "world", name=scene.name)
    plants = Tree.SubElement(world, "model", name="plants")
    Tree.SubElement(plants, "static").text = "true"
    body = Tree.SubElement(plants, "link", name="plants")
    for part in primitives(scene):
        _sdf_shape(body, part)
    arm = Tree.SubElement(world, "model", name=robot.name)
    _sdf_pose(arm, arm_pose(scene, robot))
    for link in links_of(robot):
        own = Tree.SubElement(arm, "link", name=link.name)
        _sdf_pose(own, link.pose, link.parent)
        if link.mass > 0:
            _sdf_inertial(own, link)
        for part in link.parts:
            _sdf_shape(own, part)
        joint = Tree.SubElement(arm, "joint", name=link.joint.name, type=link.joint.kind)
        Tree.SubElement(joint, "parent").text = link.parent or "world"
        Tree.SubElement(joint, "child").text = link.name
        if link.joint.kind != "fixed":
            axis = Tree.SubElement(joint, "axis")
            Tree.SubElement(axis, "xyz").text = _numbers(*link.joint.axis)
            limit = Tree.SubElement(axis, "limit")
            for name in ("lower", "upper", "velocity"):
                Tree.SubElement(limit, name).text = _numbers(getattr(link.joint, name))
    return _text(root)


def _plain(parts: Iterable[Primitive]) -> Iterable[Primitive]:
    return (piece for part in parts for piece in without_capsules(without_ellipsoids(part)))


def _urdf_shape(link: Tree.Element, part: Primitive) -> None:
    for use in ("visual", "collision"):
        element = Tree.SubElement(link, use, name=part.name)
        _origin(element, part.pose)
        geometry = Tree.SubElement(element, "geometry")
        if part.kind == "sphere":
            Tree.SubElement(geometry, "sphere", radius=_numbers(*part.size))
        elif part.kind == "cylinder":
            Tree.SubElement(geometry, "cylinder", radius=_numbers(part.size[0]), length=_numbers(part.size[1]))
        else:
            Tree.SubElement(geometry, "box", size=_numbers(*(2 * np.array(part.size))))
        if use == "visual":
            material = Tree.SubElement(element, "material", name=_material(part))
            Tree.SubElement(material, "color", rgba=_numbers(*part.color, 1.0))


def _material(part: Primitive) -> str:
    return "color_" + "_".join(f"{round(255 * value):02x}" for value in part.color)


def _sdf_shape(link: Tree.Element, part: Primitive) -> None:
    for use in ("visual", "collision"):
        element = Tree.SubElement(link, use, name=part.name)
        _sdf_pose(element, part.pose)
        shape = Tree.SubElement(Tree.SubElement(element, "geometry"), part.kind)
        if part.kind == "box":
            Tree.SubElement(shape, "size").text = _numbers(*(2 * np.array(part.size)))
        elif part.kind == "ellipsoid":
            Tree.SubElement(shape, "radii").text = _numbers(*part.size)
        else:
            for name, value in zip(("radius", "length"), part.size, strict=False):
                Tree.SubElement(shape, name).text = _numbers(value)
        if use == "visual":
            material = Tree.SubElement(element, "material")
            for name in ("ambient", "diffuse"):
                Tree.SubElement(material, name).text = _numbers(*part.color, 1.0)


def _sdf_inertial(element: Tree.Element, link: Link) -> None:
    inertial = Tree.SubElement(element, "inertial")
    _sdf_pose(inertial, link.center)
    Tree.SubElement(inertial, "mass").text = _numbers(link.mass)
    inertia = Tree.SubElement(inertial, "inertia")
    for name, value in zip(("ixx", "iyy", "izz"), link.inertia, strict=True):
        Tree.SubElement(inertia, name).text = _numbers(value)


def _origin(element: Tree.Element, frame: Array) -> None:
    Tree.SubElement(element, "origin", xyz=_numbers(*frame[:3, 3]), rpy=_numbers(*roll_pitch_yaw(frame)))


def _sdf_pose(element: Tree.Element, frame: Array, relative_to: str | None = None) -> None:
    pose_element = Tree.SubElement(element, "pose")
    if relative_to:
        pose_element.set("relative_to", relative_to)
    pose_element.text = _numbers(*frame[:3, 3], *roll_pitch_yaw(frame))


def _numbers(*values: float) -> str:
    return " ".join(f"{float(value) + 0.0:.9g}" for value in values)


def _text(root: Tree.Element) -> bytes:
    Tree.indent(root)
    return b'<?xml version="1.0"?>\n' + Tree.tostring(root) + b"\n"
