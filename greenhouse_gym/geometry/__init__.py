"""Spheres, ellipsoids, capsules and boxes, distances to them, and poses.

Lengths are metres. A pose is a 4x4 matrix named ``target_from_source``: ``world_from_camera @ point_in_camera``.
"""

from greenhouse_gym.geometry.arrays import Array, Rotation, Vector, numbers_of
from greenhouse_gym.geometry.distances import (
    bounding_balls,
    closest_on_segments,
    distance_to_boxes,
    distance_to_capsules,
    distance_to_ellipsoids,
    distance_to_nearest,
    distance_to_shapes,
    distance_to_spheres,
)
from greenhouse_gym.geometry.poses import (
    frame_along,
    invert,
    is_pose,
    is_rotation,
    pose,
    quaternions_from,
    rotation_about,
    rotation_angle,
    rotations_from,
    transform,
)
from greenhouse_gym.geometry.shape_arrays import ShapeArrays, arrays_of, shapes_from
from greenhouse_gym.geometry.shapes import (
    Box,
    Capsule,
    Ellipsoid,
    Shape,
    Sphere,
    centered_at,
    checked_columns,
    transformed,
    unchecked,
)

__all__ = [
    "Array",
    "Box",
    "Capsule",
    "Ellipsoid",
    "Rotation",
    "Shape",
    "ShapeArrays",
    "Sphere",
    "Vector",
    "arrays_of",
    "bounding_balls",
    "centered_at",
    "checked_columns",
    "closest_on_segments",
    "distance_to_boxes",
    "distance_to_capsules",
    "distance_to_ellipsoids",
    "distance_to_nearest",
    "distance_to_shapes",
    "distance_to_spheres",
    "frame_along",
    "invert",
    "is_pose",
    "is_rotation",
    "numbers_of",
    "pose",
    "quaternions_from",
    "rotation_about",
    "rotation_angle",
    "rotations_from",
    "shapes_from",
    "transform",
    "transformed",
    "unchecked",
]
