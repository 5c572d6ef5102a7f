"""Spheres, ellipsoids, capsules and boxes; lengths are metres."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry.arrays import MATRIX, VECTOR, Array, JsonArray, Rotation, Vector
from greenhouse_gym.geometry.poses import are_rotations, is_rotation, transform

_RADIUS_TOLERANCE = 1e-4  # metres by which the radius of an ellipsoid may be rounded


def _parse(shape: Any, **kinds: JsonArray | None) -> None:
    """Convert fields of a frozen shape to read-only arrays of their kinds, or, without a kind, to a positive number.

    Raises:
        InvalidValueError: A field cannot be converted.
    """
    for name, kind in kinds.items():
        value = getattr(shape, name)
        object.__setattr__(shape, name, _positive(name, value) if kind is None else kind.parse(value))


def _positive(name: str, value: Any) -> float:
    number = float(value)
    if not (np.isfinite(number) and number > 0):
        raise InvalidValueError(f"{name} must be a positive number of metres, got {value!r}")
    return number


def _check_rotated(name: str, sizes: Array, rotation: Array) -> None:
    """Check the sizes (3,) and the rotation (3, 3) of a shape.

    Raises:
        InvalidValueError: A size is not positive, or the matrix is not a rotation.
    """
    if (sizes <= 0).any():
        raise InvalidValueError(f"{name} must be positive, got {sizes.tolist()}")
    if not is_rotation(rotation):
        raise InvalidValueError(f"rotation must be orthonormal with determinant 1, got {rotation.tolist()}")


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere: ``center`` (3,) and ``radius``, metres."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    center: Vector
    radius: float

    def __post_init__(self) -> None:
        _parse(self, center=VECTOR, radius=None)


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """An ellipsoid.

    Attributes:
        center: (3,) metres.
        semi_axes: (3,) metres.
        rotation: (3, 3) world_from_ellipsoid.
        radius: Radius of the sphere of the same volume, metres. Computed if omitted; files round it by itself.
    """

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    center: Vector
    semi_axes: Vector
    rotation: Rotation
    radius: float = 0.0

    def __post_init__(self) -> None:
        _parse(self, center=VECTOR, semi_axes=VECTOR, rotation=MATRIX)
        _check_rotated("semi_axes", self.semi_axes, self.rotation)
        exact = float(np.cbrt(self.semi_axes.prod()))
        object.__setattr__(self, "radius", float(self.radius) or exact)
        if not abs(self.radius - exact) <= _RADIUS_TOLERANCE:
            raise InvalidValueError(f"radius must be that of the same volume, {exact:.5f}, got {self.radius!r}")


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within ``radius`` of the segment from ``start`` (3,) to ``end`` (3,), metres."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    start: Vector
    end: Vector
    radius: float

    def __post_init__(self) -> None:
        _parse(self, start=VECTOR, end=VECTOR, radius=None)

    @property
    def length(self) -> float:
        """Length of the axis without the round ends, metres."""
        return float(np.linalg.norm(self.end - self.start))


@dataclass(frozen=True, eq=False)
class Box:
    """A box: ``center`` (3,), ``half_extents`` (3,) metres, ``rotation`` (3, 3) world_from_box."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    center: Vector
    half_extents: Vector
    rotation: Rotation

    def __post_init__(self) -> None:
        _parse(self, center=VECTOR, half_extents=VECTOR, rotation=MATRIX)
        _check_rotated("half_extents", self.half_extents, self.rotation)


Shape: TypeAlias = Sphere | Ellipsoid | Capsule | Box
AnyShape = TypeVar("AnyShape", bound=Shape)
Made = TypeVar("Made")


def checked_columns(shape_type: type[Shape], columns: Mapping[str, Sequence[Any]]) -> dict[str, Array]:
    """Return the fields of shapes of one type as arrays, checked all at once.

    Args:
        shape_type: The type.
        columns: Values of each field of numbers.

    Raises:
        InvalidValueError: A shape is impossible; constructing it alone names the value.
        TypeError, ValueError: A value is no number, or an array has another length.
    """
    arrays = {name: np.array(values, dtype=np.float64) for name, values in columns.items()}
    for name, array in arrays.items():
        expected = {"radius": (), "rotation": (3, 3)}.get(name, (3,))
        positive = name in ("radius", "half_extents", "semi_axes")
        if array.shape[1:] != expected or not np.isfinite(array).all() or (positive and not (array > 0).all()):
            raise InvalidValueError(f"{name}: expected numbers of shape {expected}, and positive sizes")
    if "rotation" in arrays and not are_rotations(arrays["rotation"]).all():
        raise InvalidValueError("rotations must be orthonormal with determinant 1")
    if shape_type is Ellipsoid:
        exact = np.cbrt(arrays["semi_axes"].prod(axis=1))
        if not (np.abs(arrays["radius"] - exact) <= _RADIUS_TOLERANCE).all():
            raise InvalidValueError("radius must be that of the same volume")
    return arrays


def unchecked(kind: type[Made], fields: Iterable[str], rows: Iterable[Iterable[Any]]) -> list[Made]:
    """Return instances of a dataclass with rows of values that were already checked."""
    names, made = tuple(fields), []
    for row in rows:
        instance = object.__new__(kind)
        instance.__dict__.update(zip(names, row, strict=True))
        made.append(instance)
    return made


def transformed(shape: AnyShape, target_from_source: Array) -> AnyShape:
    """Express a shape in another frame, given by a pose (4, 4)."""
    if isinstance(shape, Capsule):
        start, end = transform(target_from_source, [shape.start, shape.end])
        return replace(shape, start=start, end=end)
    center = transform(target_from_source, shape.center[None])[0]
    if isinstance(shape, Sphere):
        return replace(shape, center=center)
    return replace(shape, center=center, rotation=target_from_source[:3, :3] @ shape.rotation)


def mirrored(shape: AnyShape, flip: Array, shift: Array) -> AnyShape:
    """Return a mirrored and then shifted shape.

    Args:
        shape: The shape.
        flip: (3,) -1 for each mirrored axis, else 1.
        shift: (3,) shift, metres.
    """
    if isinstance(shape, Capsule):
        return replace(shape, start=shape.start * flip + shift, end=shape.end * flip + shift)
    center = shape.center * flip + shift
    if isinstance(shape, Sphere):
        return replace(shape, center=center)
    # a box or an ellipsoid is its own mirror image, so mirroring its frame on both sides gives a rotation
    return replace(shape, center=center, rotation=shape.rotation * np.outer(flip, flip))


def centered_at(shape: Sphere | Box, center: Array) -> Sphere | Box:
    """Return a sphere or box moved to a center (3,); its other fields are not checked again."""
    moved = copy.copy(shape)
    object.__setattr__(moved, "center", VECTOR.parse(center))
    return moved
