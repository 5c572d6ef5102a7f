"""Rotations and poses: a pose is a 4x4 matrix named ``target_from_source``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.errors import InvalidValueError
from greenhouse_gym.geometry.arrays import Array

_UNITY = np.eye(3)


def is_rotation(matrix: npt.ArrayLike, tolerance: float = 1e-5) -> bool:
    """Return whether a (3, 3) matrix is orthonormal with determinant +1."""
    r = np.asarray(matrix, dtype=np.float64)
    return r.shape == (3, 3) and bool(np.isfinite(r).all() and are_rotations(r, tolerance))


def is_pose(matrix: npt.ArrayLike, tolerance: float = 1e-4) -> bool:
    """Return whether a matrix is a finite (4, 4) pose: a rotation to a tolerance, a translation and 0 0 0 1."""
    t = np.asarray(matrix, dtype=np.float64)
    finite = t.shape == (4, 4) and np.isfinite(t).all()
    return bool(finite and np.allclose(t[3], [0, 0, 0, 1])) and is_rotation(t[:3, :3], tolerance)


def are_rotations(matrices: Array, tolerance: float = 1e-5) -> npt.NDArray[np.bool_]:
    """Return whether matrices (..., 3, 3) of finite numbers are orthonormal with determinant +1, (...)."""
    # np.allclose gives the same but takes 0.2 ms
    unity = np.abs(matrices @ np.swapaxes(matrices, -1, -2) - _UNITY) <= tolerance + 1e-5 * _UNITY
    return np.asarray(unity.all(axis=(-1, -2)) & (np.linalg.det(matrices) > 0))


def pose(rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike | None = None) -> Array:
    """Return a (4, 4) pose from a (3, 3) rotation and a (3,) translation; the identity for each that is None."""
    result = np.eye(4)
    if rotation is not None:
        result[:3, :3] = rotation
    if translation is not None:
        result[:3, 3] = translation
    return result


def invert(target_from_source: npt.ArrayLike) -> Array:
    """Return the inverse of rigid poses, (..., 4, 4)."""
    t = np.asarray(target_from_source, dtype=np.float64)
    result = np.zeros_like(t)
    rotation = np.swapaxes(t[..., :3, :3], -1, -2)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, t[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform(target_from_source: npt.ArrayLike, points: npt.ArrayLike) -> Array:
    """Return points (n, 3) of the source frame in the target frame, (n, 3)."""
    t = np.asarray(target_from_source, dtype=np.float64)
    moved: Array = np.asarray(points, dtype=np.float64) @ t[:3, :3].T + t[:3, 3]
    return moved


def rotation_about(axis: npt.ArrayLike, angle: float) -> Array:
    """Return the (3, 3) rotation by ``angle`` radians about ``axis`` (3,) of any length (Rodrigues' formula).

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
    """Return the angle of a (3, 3) rotation, 0 to pi radians; stable near 0 and pi."""
    r = np.asarray(rotation, dtype=np.float64)
    sine = 0.5 * np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    return float(np.arctan2(sine, 0.5 * (np.trace(r) - 1.0)))


def quaternions_from(rotations: npt.ArrayLike) -> Array:
    """Return unit quaternions (k, 4), w x y z with the largest entry positive, of rotations (k, 3, 3).

    Each is the eigenvector to the largest eigenvalue of a symmetric matrix (Bar-Itzhack, New Method for Extracting the
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
    """Return the rotations (k, 3, 3) of quaternions (k, 4), w x y z, of any length but 0.

    Raises:
        InvalidValueError: The length of one is 0.
    """
    q = np.asarray(quaternions, dtype=np.float64).reshape(-1, 4)
    length = np.linalg.norm(q, axis=1)
    if (length < 1e-6).any():
        raise InvalidValueError("a quaternion of zeros is not a rotation")
    w, x, y, z = (q / length[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def frame_along(direction: npt.ArrayLike) -> Array:
    """Return a (3, 3) rotation whose third column is the unit vector along ``direction`` (3,)."""
    z = np.asarray(direction, dtype=np.float64)
    z = z / np.linalg.norm(z)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])
