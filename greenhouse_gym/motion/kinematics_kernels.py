"""Kernels of forward and inverse kinematics.

An arm is an array (n, 16) of its joints: the fixed pose before each joint as 3x4 by rows, its unit axis in the frame
after it, and 1 for slides.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.segment_kernels import dot, minus

Array = npt.NDArray[np.float64]


@inlined
def _turned(axis, angle):
    """Return the rotation about a unit axis by rows (Rodrigues' formula)."""
    s, c = math.sin(angle), math.cos(angle)
    v, x, y, z = 1.0 - c, axis[0], axis[1], axis[2]
    return (
        c + x * x * v, x * y * v - z * s, x * z * v + y * s,
        x * y * v + z * s, c + y * y * v, y * z * v - x * s,
        x * z * v - y * s, y * z * v + x * s, c + z * z * v,
    )  # fmt: skip


@inlined
def _product(r, m):
    return (
        r[0] * m[0] + r[1] * m[3] + r[2] * m[6], r[0] * m[1] + r[1] * m[4] + r[2] * m[7],
        r[0] * m[2] + r[1] * m[5] + r[2] * m[8], r[3] * m[0] + r[4] * m[3] + r[5] * m[6],
        r[3] * m[1] + r[4] * m[4] + r[5] * m[7], r[3] * m[2] + r[4] * m[5] + r[5] * m[8],
        r[6] * m[0] + r[7] * m[3] + r[8] * m[6], r[6] * m[1] + r[7] * m[4] + r[8] * m[7],
        r[6] * m[2] + r[7] * m[5] + r[8] * m[8],
    )  # fmt: skip


@inlined
def applied(r, x, y, z):
    """Return a rotation by rows times a vector."""
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


@inlined
def joint_frames(joints, q, frames):
    """Write the frames after each joint: rotation by rows, position; then the anchor and the axis of the joint."""
    r, px, py, pz = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 0.0, 0.0, 0.0
    for j in range(len(joints)):
        o = (
            joints[j, 0], joints[j, 1], joints[j, 2], joints[j, 4], joints[j, 5], joints[j, 6], joints[j, 8],
            joints[j, 9], joints[j, 10],
        )  # fmt: skip
        axis = (joints[j, 12], joints[j, 13], joints[j, 14])
        x, y, z = applied(r, joints[j, 3], joints[j, 7], joints[j, 11])
        px, py, pz = px + x, py + y, pz + z
        r = _product(r, o)
        x, y, z = applied(r, axis[0], axis[1], axis[2])
        frames[j, 12], frames[j, 13], frames[j, 14] = px, py, pz
        frames[j, 15], frames[j, 16], frames[j, 17] = x, y, z
        if joints[j, 15] > 0.0:
            px, py, pz = px + q[j] * x, py + q[j] * y, pz + q[j] * z
        else:
            r = _product(r, _turned(axis, q[j]))
        for k in range(9):
            frames[j, k] = r[k]
        frames[j, 9], frames[j, 10], frames[j, 11] = px, py, pz


@inlined
def _solve(matrix, vector, count):
    """Solve a positive definite system of equations in place (Cholesky)."""
    for i in range(count):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
    for i in range(count):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] /= matrix[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] /= matrix[i, i]


@inlined
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel(
    "i8(f8[:, ::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], f8[::1], i8, f8[:, ::1], b1[::1])",
    writes=("joints", "guesses", "done"),
)
def bring_onto(
    joints: Array,
    tip: Array,
    point: Array,
    cone: Array,
    lower: Array,
    upper: Array,
    lengths: Array,
    weights: Array,
    iterations: int,
    guesses: Array,
    done: npt.NDArray[np.bool_],
) -> int:
    """Bring the grasp point onto a point by damped least squares; see `greenhouse_gym.motion.inverse_kinematics`.

    Args:
        joints: The arm, see this module.
        tip: (12,) fixed pose from the last joint to the tip as 3x4 by rows.
        point: (3,) where the grasp point shall be.
        cone: (4,) axis and half angle of the cone that the tool axis must end up in; a negative angle for no cone.
        lower: (n,) lower limits of the joints.
        upper: (n,) upper limits.
        lengths: (4,) distance of the grasp point from the tip, tolerance, largest correction, and the distance from
            the point beyond which a guess is left out.
        weights: (2,) damping, and weight of the tool's direction relative to its position, metres per radian.
        iterations: Number of iterations.
        guesses: (k, n) the guesses, which become the results.
        done: (k,) the second result: which have converged.

    Returns:
        The number of guesses that were not left out.
    """
    n, tried = len(joints), 0
    ahead, tolerance, largest, threshold = lengths
    damping, weight = weights
    frames, jacobian, normal, error = np.empty((n, 18)), np.zeros((6, n)), np.empty((6, 6)), np.empty(6)
    rows, direction = (6 if cone[3] >= 0.0 else 3), (cone[0], cone[1], cone[2])
    for m in range(len(guesses)):
        q = guesses[m]
        done[m] = False
        for iteration in range(iterations):
            joint_frames(joints, q, frames)
            f = frames[n - 1]
            r = (f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8])
            axis, offset = applied(r, tip[2], tip[6], tip[10]), applied(r, tip[3], tip[7], tip[11])
            at = (
                f[9] + offset[0] + ahead * axis[0], f[10] + offset[1] + ahead * axis[1],
                f[11] + offset[2] + ahead * axis[2],
            )  # fmt: skip
            away = minus(point, at)
            distance = math.sqrt(dot(away, away))
            if iteration == 0:
                if distance > threshold:
                    break
                tried += 1
            turn, outside = (0.0, 0.0, 0.0), 0.0
            if rows == 6:
                across = _cross(axis, direction)
                sine = math.sqrt(dot(across, across))
                outside = max(math.atan2(sine, dot(axis, direction)) - cone[3], 0.0)
                scale = outside / max(sine, 1e-9)
                turn = (across[0] * scale, across[1] * scale, across[2] * scale)
            if distance < tolerance and turn[0] == 0.0 and turn[1] == 0.0 and turn[2] == 0.0:
                done[m] = True
                break
            shrink = min(1.0, largest / max(distance, 1e-12))
            for k in range(3):
                error[k] = away[k] * shrink
                error[3 + k] = weight * 1.05 * turn[k]  # slightly past the edge, so that the axis counts as inside
            for j in range(n):
                g = frames[j]
                along, arm = (g[15], g[16], g[17]), (at[0] - g[12], at[1] - g[13], at[2] - g[14])
                slides = joints[j, 15] > 0.0
                column = along if slides else _cross(along, arm)
                turns = 0.0 if slides or outside == 0.0 else weight
                for k in range(3):
                    jacobian[k, j], jacobian[3 + k, j] = column[k], turns * along[k]
            for i in range(rows):
                for k in range(rows):
                    total = damping * damping if i == k else 0.0
                    for j in range(n):
                        total += jacobian[i, j] * jacobian[k, j]
                    normal[i, k] = total
            _solve(normal, error, rows)
            for j in range(n):
                value = q[j]
                for i in range(rows):
                    value += jacobian[i, j] * error[i]
                q[j] = min(max(value, lower[j]), upper[j])
    return tried
