"""Shapes of a scene as named primitives with poses, the input of every export format, and as triangle meshes."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from greenhouse_gym.crops.parts import Stem, Tomato
from greenhouse_gym.geometry import Array, Box, Capsule, Ellipsoid, Shape, frame_along, pose
from greenhouse_gym.scene.obstacles import Shapes

if TYPE_CHECKING:
    from trimesh import Trimesh


Kind = Literal["sphere", "ellipsoid", "capsule", "cylinder", "box"]
Color = tuple[float, float, float]

RED, GREEN_FRUIT, STEM, CLUTTER = (0.85, 0.13, 0.10), (0.45, 0.60, 0.20), (0.33, 0.48, 0.20), (0.25, 0.50, 0.22)

FINENESS = 2
"""Subdivisions of round shapes: a sphere has 20 * 4**2 triangles, a cylinder 4 * 2**2 corners around its axis."""


class Primitive(NamedTuple):
    """A shape with a pose; lengths in metres.

    Attributes:
        name: Unique name within the scene.
        kind: Kind of shape.
        size: (radius,) of a sphere; the semi-axes of an ellipsoid; (radius, length without caps) of a capsule, (radius,
            length) of a cylinder, both along z; the half extents of a box.
        pose: (4, 4) pose in the frame of its world or link.
        color: RGB in [0, 1].
    """

    name: str
    kind: Kind
    size: tuple[float, ...]
    pose: Array
    color: Color

    @property
    def position(self) -> Array:
        """Position (3,), metres."""
        return self.pose[:3, 3]

    @property
    def quaternion(self) -> Array:
        """Orientation (4,) as x, y, z, w."""
        return Rotation.from_matrix(self.pose[:3, :3]).as_quat()

    @property
    def roll_pitch_yaw(self) -> Array:
        """Orientation (3,), radians; see `roll_pitch_yaw`."""
        return roll_pitch_yaw(self.pose)

    def moved(self, target_from_source: Array) -> Primitive:
        """Return the primitive in another frame."""
        return self._replace(pose=target_from_source @ self.pose)


def roll_pitch_yaw(frame: Array) -> Array:
    """Return a pose's rotations (3,) about the fixed x, y and z axes, in this order, radians."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gimbal lock: any angles that give the rotation will do
        return Rotation.from_matrix(frame[:3, :3]).as_euler("xyz")


def primitives(shapes: Shapes) -> list[Primitive]:
    """Return tomatoes, stems and clutter of a scene or its truth, in order and named as in its MJCF."""
    found = [_primitive(f"tomato_{k}", tomato.shape, _fruit_color(tomato)) for k, tomato in enumerate(shapes.tomatoes)]
    found += [_primitive(f"stem_{k}_{stem.kind}", stem, STEM) for k, stem in enumerate(shapes.stems)]
    return found + [_primitive(f"clutter_{k}", shape, CLUTTER) for k, shape in enumerate(shapes.clutter)]


def _fruit_color(tomato: Tomato) -> Color:
    ripe = 1.0 if tomato.ripeness is None else tomato.ripeness
    red, green, blue = (ripe * r + (1 - ripe) * g for r, g in zip(RED, GREEN_FRUIT, strict=True))
    return red, green, blue


def _primitive(name: str, shape: Shape | Stem, color: Color) -> Primitive:
    if isinstance(shape, Box):
        return Primitive(name, "box", tuple(shape.half_extents.tolist()), pose(shape.rotation, shape.center), color)
    if isinstance(shape, Capsule):
        middle = (shape.start + shape.end) / 2
        if shape.length < 1e-6:
            return Primitive(name, "sphere", (shape.radius,), pose(translation=middle), color)
        frame = frame_along(shape.end - shape.start)
        return Primitive(name, "capsule", (shape.radius, shape.length), pose(frame, middle), color)
    if isinstance(shape, Ellipsoid):
        return Primitive(name, "ellipsoid", tuple(shape.semi_axes.tolist()), pose(shape.rotation, shape.center), color)
    return Primitive(name, "sphere", (shape.radius,), pose(translation=shape.center), color)


def without_capsules(primitive: Primitive) -> Iterator[Primitive]:
    """Yield the same shape for formats without capsules: a cylinder and a sphere at each end."""
    if primitive.kind != "capsule":
        yield primitive
        return
    radius, length = primitive.size
    yield primitive._replace(kind="cylinder")
    for k, along in enumerate((-length / 2, length / 2)):
        end = primitive.pose @ pose(translation=[0.0, 0.0, along])
        yield primitive._replace(name=f"{primitive.name}_end_{k}", kind="sphere", size=(radius,), pose=end)


def without_ellipsoids(primitive: Primitive) -> Primitive:
    """Return the enclosing sphere of an ellipsoid, for formats without ellipsoids, or any other shape as it is."""
    if primitive.kind != "ellipsoid":
        return primitive
    return primitive._replace(kind="sphere", size=(max(primitive.size),))


def mesh_of(primitive: Primitive, fineness: int = FINENESS) -> Trimesh:
    """Return a primitive as a closed mesh in its world's frame, with vertices on its surface and triangles outward."""
    from trimesh import creation  # takes a second

    around = 4 * 2**fineness
    if primitive.kind == "box":
        mesh = creation.box(2 * np.array(primitive.size))
    elif primitive.kind in ("sphere", "ellipsoid"):
        mesh = creation.icosphere(fineness)
        mesh.vertices *= primitive.size
    elif primitive.kind == "capsule":
        radius, length = primitive.size
        mesh = creation.capsule(length, radius, count=[around // 2, around])
    else:
        radius, length = primitive.size
        mesh = creation.cylinder(radius, length, sections=around)
    mesh.apply_transform(primitive.pose)
    mesh.visual.vertex_colors = [*primitive.color, 1.0]
    return mesh


def ply(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one binary PLY file with colored vertices."""
    return bytes(_joined(parts).export(file_type="ply"))


def stl(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one binary STL file."""
    return bytes(_joined(parts).export(file_type="stl"))


def obj(parts: Sequence[Primitive]) -> bytes:
    """Return all primitives as one OBJ file, one named object per primitive."""
    from trimesh import Scene
    from trimesh.exchange.obj import export_obj

    text = export_obj(
        Scene({part.name: mesh_of(part) for part in parts}), include_color=False, digits=5, header="metres, z up"
    )
    return str(text).encode()


def _joined(parts: Sequence[Primitive]) -> Trimesh:
    from trimesh import util

    return util.concatenate([mesh_of(part) for part in parts])
