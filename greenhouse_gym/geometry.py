"""Spheres, ellipsoids, capsules, boxes, poses, and vectorized distances between them. numpy only.

Lengths are metres. A pose is a 4x4 matrix named ``target_from_source``: ``world_from_camera @ point_in_camera``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError

Array: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True)
class _JsonArray:
    """Lets pydantic read a fixed-shape float array from nested lists and write it back as such."""

    shape: tuple[int, ...]

    def parse(self, value: Any) -> Array:
        """Turn nested sequences into a read-only float64 array of this shape with finite entries."""
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InvalidValueError(f"expected {self.shape} numbers, got {value!r}") from error
        if array.shape != self.shape:
            raise InvalidValueError(f"expected an array of shape {self.shape}, got shape {array.shape}")
        if not np.isfinite(array).all():
            raise InvalidValueError(f"expected finite numbers, got {array.tolist()}")
        array.setflags(write=False)
        return array

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from pydantic_core import core_schema

        return core_schema.no_info_plain_validator_function(
            self.parse, serialization=core_schema.plain_serializer_function_ser_schema(lambda array: array.tolist())
        )


_UNITY = np.eye(3)
_VECTOR, _MATRIX = _JsonArray((3,)), _JsonArray((3, 3))
Vector: TypeAlias = Annotated[Array, _VECTOR]
Rotation: TypeAlias = Annotated[Array, _MATRIX]


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
        for name, kind in (("center", _VECTOR), ("semi_axes", _VECTOR), ("rotation", _MATRIX)):
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
        object.__setattr__(self, "center", _VECTOR.parse(self.center))
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
        object.__setattr__(self, "start", _VECTOR.parse(self.start))
        object.__setattr__(self, "end", _VECTOR.parse(self.end))
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
        object.__setattr__(self, "center", _VECTOR.parse(self.center))
        object.__setattr__(self, "half_extents", _VECTOR.parse(self.half_extents))
        object.__setattr__(self, "rotation", _MATRIX.parse(self.rotation))
        if (self.half_extents <= 0).any():
            raise InvalidValueError(f"half_extents must be positive, got {self.half_extents.tolist()}")
        if not is_rotation(self.rotation):
            raise InvalidValueError(f"rotation must be orthonormal with determinant 1, got {self.rotation.tolist()}")


Shape: TypeAlias = Sphere | Capsule | Box


# -- poses ------------------------------------------------------------------------------------------------------------


def is_rotation(matrix: npt.ArrayLike, tolerance: float = 1e-5) -> bool:
    """Whether a (3, 3) matrix is orthonormal with determinant +1."""
    r = np.asarray(matrix, dtype=np.float64)
    # allclose, which takes a fifth of a millisecond, says the same
    return bool(
        r.shape == (3, 3)
        and (np.abs(r @ r.T - _UNITY) <= tolerance + 1e-5 * _UNITY).all()  # of no entry that is not finite
        and np.linalg.det(r) > 0
    )


def pose(rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike | None = None) -> Array:
    """A (4, 4) pose from a (3, 3) rotation and a (3,) translation, each the identity when left out."""
    result = np.eye(4)
    if rotation is not None:
        result[:3, :3] = rotation
    if translation is not None:
        result[:3, 3] = translation
    return result


def invert(target_from_source: npt.ArrayLike) -> Array:
    """Inverse of rigid poses, (..., 4, 4) to (..., 4, 4)."""
    t = np.asarray(target_from_source, dtype=np.float64)
    result = np.zeros_like(t)
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, t[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform(target_from_source: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Points (n, 3) of the source frame expressed in the target frame, (n, 3)."""
    t = np.asarray(target_from_source, dtype=np.float64)
    moved: Array = np.asarray(points, dtype=np.float64) @ t[:3, :3].T + t[:3, 3]
    return moved


def rotation_about(axis: npt.ArrayLike, angle: float) -> Array:
    """The (3, 3) rotation by ``angle`` radians about ``axis`` (3,) of any length (Rodrigues' formula).

    Raises:
        InvalidValueError: The axis has no direction.
    """
    a = np.asarray(axis, dtype=np.float64)
    length = np.linalg.norm(a)
    if a.shape != (3,) or not (np.isfinite(length) and length > 0):
        raise InvalidValueError(f"rotation_about: expected an axis (x, y, z) with a direction, got {axis!r}")
    a = a / length
    k = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def rotation_angle(rotation: npt.ArrayLike) -> float:
    """The angle in radians, 0 to pi, by which a (3, 3) rotation turns (stable near 0 and pi)."""
    r = np.asarray(rotation, dtype=np.float64)
    sine = 0.5 * np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(r) - 1.0)))


def quaternions_from(rotations: npt.ArrayLike) -> Array:
    """Unit quaternions (k, 4), w x y z with the largest entry positive, of rotations (k, 3, 3).

    The eigenvector to the largest eigenvalue of a symmetric matrix (Bar-Itzhack, New Method for Extracting the
    Quaternion from a Rotation Matrix, 2000), which is stable for every rotation.
    """
    r = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    k = np.empty((len(r), 4, 4))
    trace = np.trace(r, axis1=1, axis2=2)
    k[:, 0, 0] = trace
    k[:, 0, 1:] = np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    k[:, 1:, 0] = k[:, 0, 1:]
    k[:, 1:, 1:] = r + np.swapaxes(r, 1, 2) - trace[:, None, None] * np.eye(3)
    q = np.linalg.eigh(k)[1][..., -1]
    largest = np.take_along_axis(q, np.abs(q).argmax(axis=1)[:, None], axis=1)
    return np.asarray(q * np.sign(largest))


def rotations_from(quaternions: npt.ArrayLike) -> Array:
    """Rotations (k, 3, 3) of quaternions (k, 4), w x y z, of any length but 0.

    Raises:
        InvalidValueError: One has no length.
    """
    q = np.asarray(quaternions, dtype=np.float64).reshape(-1, 4)
    length = np.linalg.norm(q, axis=1)
    if (length < 1e-6).any():
        raise InvalidValueError("a quaternion of zeros is no rotation")
    w, x, y, z = (q / length[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def frame_along(direction: npt.ArrayLike) -> Array:
    """A (3, 3) rotation whose third column is the unit vector along ``direction`` (3,)."""
    z = np.asarray(direction, dtype=np.float64)
    z = z / np.linalg.norm(z)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


# -- distances --------------------------------------------------------------------------------------------------------


def distance_to_spheres(points: npt.ArrayLike, centers: npt.ArrayLike, radii: npt.ArrayLike) -> Array:
    """Signed distances (n, k), negative inside, from points (n, 3) to spheres: centers (k, 3), radii (k,)."""
    p, c = np.asarray(points, dtype=np.float64), np.asarray(centers, dtype=np.float64).reshape(-1, 3)
    return np.asarray(np.linalg.norm(p[:, None] - c[None], axis=-1) - np.asarray(radii), dtype=np.float64)


def distance_to_ellipsoids(
    points: npt.ArrayLike, centers: npt.ArrayLike, semi_axes: npt.ArrayLike, rotations: npt.ArrayLike
) -> Array:
    """Signed distances (n, k), negative inside, to ellipsoids; the arguments are like those of `distance_to_boxes`.

    By Newton's method on the multiplier of the nearest point (Eberly, Distance from a Point to an Ellipse, an
    Ellipsoid, or a Hyperellipsoid, 2013), from a start at which it converges from one side; to about 1e-7 of the size.
    """
    p = np.asarray(points, dtype=np.float64)
    c, e = (np.asarray(a, dtype=np.float64).reshape(-1, 3) for a in (centers, semi_axes))
    turns = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    local = np.abs(np.einsum("kji,nkj->nki", turns, p[:, None] - c[None]))
    squares, least = e * e, e.min(axis=1)
    y = np.maximum(local, 1e-7 * least[:, None])  # off the planes of symmetry, where the multiplier is not unique
    t = (e * y - squares).max(axis=-1)
    for _ in range(_NEWTON_STEPS):
        shares = e * y / (t[..., None] + squares)
        excess = (shares * shares).sum(-1) - 1.0
        slope = -2.0 * (shares * shares / (t[..., None] + squares)).sum(-1)
        t = t - excess / slope
    nearest = squares * y / (t[..., None] + squares)
    inside = ((local / e) ** 2).sum(-1) < 1.0
    return np.asarray(np.where(inside, -1.0, 1.0) * np.linalg.norm(y - nearest, axis=-1), dtype=np.float64)


_NEWTON_STEPS = 9


def closest_on_segments(points: npt.ArrayLike, starts: npt.ArrayLike, ends: npt.ArrayLike) -> Array:
    """Closest points (n, k, 3) to points (n, 3) on the segments from starts (k, 3) to ends (k, 3)."""
    p = np.asarray(points, dtype=np.float64)[:, None]
    a, b = (np.asarray(e, dtype=np.float64).reshape(-1, 3)[None] for e in (starts, ends))
    axis = b - a
    squared = np.maximum((axis * axis).sum(-1), 1e-18)
    share = np.clip(((p - a) * axis).sum(-1) / squared, 0.0, 1.0)
    return np.asarray(a + share[..., None] * axis, dtype=np.float64)


def distance_to_capsules(
    points: npt.ArrayLike, starts: npt.ArrayLike, ends: npt.ArrayLike, radii: npt.ArrayLike
) -> Array:
    """Signed distances (n, k), negative inside, from points (n, 3) to capsules: axes (k, 3), (k, 3), radii (k,)."""
    nearest = closest_on_segments(points, starts, ends)
    p = np.asarray(points, dtype=np.float64)[:, None]
    return np.asarray(np.linalg.norm(p - nearest, axis=-1) - np.asarray(radii), dtype=np.float64)


def distance_to_boxes(
    points: npt.ArrayLike, centers: npt.ArrayLike, half_extents: npt.ArrayLike, rotations: npt.ArrayLike
) -> Array:
    """Signed distances (n, k), negative inside, to boxes: (k, 3), (k, 3), rotations (k, 3, 3) world_from_box."""
    p = np.asarray(points, dtype=np.float64)
    c, h = (np.asarray(e, dtype=np.float64).reshape(-1, 3) for e in (centers, half_extents))
    local = np.einsum("kji,nkj->nki", np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3), p[:, None] - c[None])
    excess = np.abs(local) - h[None]
    outside = np.linalg.norm(np.maximum(excess, 0.0), axis=-1)
    return np.asarray(outside + np.minimum(excess.max(-1), 0.0), dtype=np.float64)


def distance_to_shapes(points: npt.ArrayLike, shapes: Sequence[Shape], chunk: int = 4096) -> Array:
    """Signed distances (n, k), negative inside, from points (n, 3) to a mixed list of k shapes.

    Args:
        points: (n, 3) metres.
        shapes: k spheres, capsules or boxes, in the points' frame.
        chunk: points handled at a time, which bounds the memory for intermediate results.
    """
    p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    result = np.empty((len(p), len(shapes)))
    columns: dict[type, list[int]] = {kind: [] for kind in (Sphere, Ellipsoid, Capsule, Box)}
    for i, s in enumerate(shapes):
        stretched = isinstance(s, Sphere) and s.ellipsoid is not None
        columns[Ellipsoid if stretched else next(kind for kind in columns if isinstance(s, kind))].append(i)
    spheres = [s for s in shapes if isinstance(s, Sphere) and s.ellipsoid is None]
    ellipsoids = [s.ellipsoid for s in shapes if isinstance(s, Sphere) and s.ellipsoid is not None]
    capsules = [s for s in shapes if isinstance(s, Capsule)]
    boxes = [s for s in shapes if isinstance(s, Box)]
    for first in range(0, len(p), chunk):
        rows = slice(first, first + chunk)
        if spheres:
            result[rows, columns[Sphere]] = distance_to_spheres(
                p[rows], [s.center for s in spheres], [s.radius for s in spheres]
            )
        if ellipsoids:
            result[rows, columns[Ellipsoid]] = distance_to_ellipsoids(
                p[rows], *zip(*((e.center, e.semi_axes, e.rotation) for e in ellipsoids), strict=True)
            )
        if capsules:
            result[rows, columns[Capsule]] = distance_to_capsules(
                p[rows], [s.start for s in capsules], [s.end for s in capsules], [s.radius for s in capsules]
            )
        if boxes:
            result[rows, columns[Box]] = distance_to_boxes(
                p[rows], [s.center for s in boxes], [s.half_extents for s in boxes], [s.rotation for s in boxes]
            )
    return result
