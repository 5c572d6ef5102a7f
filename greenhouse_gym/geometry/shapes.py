"""Spheres, ellipsoids, capsules and boxes; lengths are metres."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry.arrays import MATRIX, VECTOR, Array, JsonArray, Rotation, Vector
from greenhouse_gym.geometry.poses import is_rotation


def _parse(shape: Any, **kinds: JsonArray | None) -> None:
    """Turn fields of a frozen shape into read-only arrays of their kinds, or, without one, a positive number.

    Raises:
        InvalidValueError: A field is no such array, or no such number.
    """
    for name, kind in kinds.items():
        value = getattr(shape, name)
        object.__setattr__(shape, name, _positive(name, value) if kind is None else kind.parse(value))


def _positive(name: str, value: Any) -> float:
    number = float(value)
    if not (np.isfinite(number) and number > 0):
        raise InvalidValueError(f"{name} must be a positive number of metres, got {value!r}")
    return number


def _check_turned(name: str, sizes: Array, rotation: Array) -> None:
    """Refuse sizes (3,) that are not positive, and a rotation (3, 3) that is none.

    Raises:
        InvalidValueError: As said above.
    """
    if (sizes <= 0).any():
        raise InvalidValueError(f"{name} must be positive, got {sizes.tolist()}")
    if not is_rotation(rotation):
        raise InvalidValueError(f"rotation must be orthonormal with determinant 1, got {rotation.tolist()}")


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """A stretched ball: ``center`` (3,), ``semi_axes`` (3,) metres, ``rotation`` (3, 3) world_from_ellipsoid."""

    center: Vector
    semi_axes: Vector
    rotation: Rotation

    def __post_init__(self) -> None:
        _parse(self, center=VECTOR, semi_axes=VECTOR, rotation=MATRIX)
        _check_turned("semi_axes", self.semi_axes, self.rotation)

    @property
    def radius(self) -> float:
        """Radius of the ball of the same volume, metres."""
        return float(np.cbrt(self.semi_axes.prod()))


@dataclass(frozen=True, eq=False)
class Sphere:
    """A ball: ``center`` (3,) and ``radius``, metres."""

    __pydantic_config__ = {"extra": "forbid"}  # noqa: RUF012

    center: Vector
    radius: float

    def __post_init__(self) -> None:
        _parse(self, center=VECTOR, radius=None)

    @property
    def ellipsoid(self) -> Ellipsoid | None:
        """What a kind of sphere that may be stretched really is; None for a ball."""
        return None


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
        """Length of the axis, metres (without the round ends)."""
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
        _check_turned("half_extents", self.half_extents, self.rotation)


Shape: TypeAlias = Sphere | Capsule | Box


def centered_at(shape: Sphere | Box, center: Array) -> Sphere | Box:
    """A ball or box elsewhere; sizes and turn, which were checked when it was made, are not checked again."""
    elsewhere = copy.copy(shape)
    object.__setattr__(elsewhere, "center", VECTOR.parse(center))
    return elsewhere
