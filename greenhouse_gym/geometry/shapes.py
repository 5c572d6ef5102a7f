"""Spheres, ellipsoids, capsules and boxes; lengths are metres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry.arrays import MATRIX, VECTOR, Rotation, Vector
from greenhouse_gym.geometry.poses import is_rotation


def _positive(name: str, value: Any) -> float:
    number = float(value)
    if not (np.isfinite(number) and number > 0):
        raise InvalidValueError(f"{name} must be a positive number of metres, got {value!r}")
    return number


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """A stretched ball: ``center`` (3,), ``semi_axes`` (3,) metres, ``rotation`` (3, 3) world_from_ellipsoid."""

    center: Vector
    semi_axes: Vector
    rotation: Rotation

    def __post_init__(self) -> None:
        for name, kind in (("center", VECTOR), ("semi_axes", VECTOR), ("rotation", MATRIX)):
            object.__setattr__(self, name, kind.parse(getattr(self, name)))
        if (self.semi_axes <= 0).any():
            raise InvalidValueError(f"semi_axes must be positive, got {self.semi_axes.tolist()}")
        if not is_rotation(self.rotation):
            raise InvalidValueError(f"rotation must be orthonormal with determinant 1, got {self.rotation.tolist()}")

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
        object.__setattr__(self, "center", VECTOR.parse(self.center))
        object.__setattr__(self, "radius", _positive("radius", self.radius))

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
        object.__setattr__(self, "start", VECTOR.parse(self.start))
        object.__setattr__(self, "end", VECTOR.parse(self.end))
        object.__setattr__(self, "radius", _positive("radius", self.radius))

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
        object.__setattr__(self, "center", VECTOR.parse(self.center))
        object.__setattr__(self, "half_extents", VECTOR.parse(self.half_extents))
        object.__setattr__(self, "rotation", MATRIX.parse(self.rotation))
        if (self.half_extents <= 0).any():
            raise InvalidValueError(f"half_extents must be positive, got {self.half_extents.tolist()}")
        if not is_rotation(self.rotation):
            raise InvalidValueError(f"rotation must be orthonormal with determinant 1, got {self.rotation.tolist()}")


Shape: TypeAlias = Sphere | Capsule | Box
