"""URDF and SDF of a scene with an arm."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree as Tree

import numpy as np

from greenhouse_gym.export.arm import Link, links_of
from greenhouse_gym.export.primitives import Primitive, primitives, roll_pitch_yaw, without_capsules, without_ellipsoids
from greenhouse_gym.geometry import Array, pose, rotation_about
from greenhouse_gym.robots import Robot
from greenhouse_gym.scene import Scene
from greenhouse_gym.scene.mjcf import base_position

_EFFORT = 150.0
"""Maximum torque or force of a joint, N m or N; URDF requires one, but the scenes' servos have none."""


def arm_pose(scene: Scene, robot: Robot) -> Array:
    """Return the pose (4, 4) of the arm's base in the scene, without the rotation in the arm's own file."""
    return pose(rotation_about([0.0, 0.0, 1.0], scene.placement.yaw), base_position(scene, robot))


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
