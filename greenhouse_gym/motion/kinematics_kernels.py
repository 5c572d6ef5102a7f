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

_PER_RIGHT_ANGLE = 2.0 / math.pi
_RIGHT_ANGLE = float(np.float32(math.pi / 2))  # few bits, so that its multiples are exact
_REST = math.pi / 2 - _RIGHT_ANGLE + 6.123233995736766e-17  # of a right angle
_S0, _S1, _S2, _S3, _S4, _S5, _S6 = (-1.0 / ((2 * k + 2) * (2 * k + 3)) for k in range(7))
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = (-1.0 / ((2 * k + 1) * (2 * k + 2)) for k in range(8))
_TRIAL, _PROGRESS = 4, 0.7
"""Iterations after which a guess within a threshold is given up if its error is more than this fraction of that two
iterations before: 98 of 100 guesses that would end on the target still do, in half as many iterations of all."""
_ROOM = 0.01  # radians or metres between its limits below which a joint is parked: corrections are left to the others


@inlined
def _sine_and_cosine(x):
    """Return both by Taylor's series about the nearest multiple of a right angle, to 3e-16."""
    turns = math.floor(x * _PER_RIGHT_ANGLE + 0.5)
    r = (x - turns * _RIGHT_ANGLE) - turns * _REST
    z, quadrant = r * r, int(turns) & 3
    sine = 1.0 + z * _S3 * (1.0 + z * _S4 * (1.0 + z * _S5 * (1.0 + z * _S6)))
    sine = r * (1.0 + z * _S0 * (1.0 + z * _S1 * (1.0 + z * _S2 * sine)))
    cosine = 1.0 + z * _C4 * (1.0 + z * _C5 * (1.0 + z * _C6 * (1.0 + z * _C7)))
    cosine = 1.0 + z * _C0 * (1.0 + z * _C1 * (1.0 + z * _C2 * (1.0 + z * _C3 * cosine)))
    if quadrant & 1:
        sine, cosine = cosine, -sine
    return (-sine, -cosine) if quadrant & 2 else (sine, cosine)


@inlined
def _turned(axis, angle):
    """Return the rotation about a unit axis by rows (Rodrigues' formula)."""
    s, c = _sine_and_cosine(angle)
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
def _last_frame(f):
    """Return the rotation and the position of the last of some frames."""
    n = len(f) - 1
    return (
        (f[n, 0], f[n, 1], f[n, 2], f[n, 3], f[n, 4], f[n, 5], f[n, 6], f[n, 7], f[n, 8]),
        (f[n, 9], f[n, 10], f[n, 11]),
    )


@inlined
def _grasp_point(joints, tip, ahead, q):
    """Return the grasp point by turning it about each joint, the last one first."""
    x, y, z = tip[3] + ahead * tip[2], tip[7] + ahead * tip[6], tip[11] + ahead * tip[10]
    for j in range(len(joints) - 1, -1, -1):
        a, b, c = joints[j, 12], joints[j, 13], joints[j, 14]
        if joints[j, 15] > 0.0:
            x, y, z = x + q[j] * a, y + q[j] * b, z + q[j] * c
        else:
            sine, cosine = _sine_and_cosine(q[j])
            along = (a * x + b * y + c * z) * (1.0 - cosine)
            x, y, z = (
                cosine * x + sine * (b * z - c * y) + along * a,
                cosine * y + sine * (c * x - a * z) + along * b,
                cosine * z + sine * (a * y - b * x) + along * c,
            )
        x, y, z = (
            joints[j, 0] * x + joints[j, 1] * y + joints[j, 2] * z + joints[j, 3],
            joints[j, 4] * x + joints[j, 5] * y + joints[j, 6] * z + joints[j, 7],
            joints[j, 8] * x + joints[j, 9] * y + joints[j, 10] * z + joints[j, 11],
        )
    return x, y, z


@inlined
def _solve(matrix, vector, count):
    """Solve a positive definite system of equations, given by its lower triangle, in place (Cholesky)."""
    for i in range(count):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = 1.0 / math.sqrt(total) if i == j else total * matrix[j, j]  # inverses on the diagonal
    for i in range(count):
        for k in range(i):
            vector[i] -= matrix[i, k] * vector[k]
        vector[i] *= matrix[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            vector[i] -= matrix[k, i] * vector[k]
        vector[i] *= matrix[i, i]


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
    gives_up = threshold < np.inf  # guesses from anywhere may need many steps
    rows, direction = (6 if cone[3] >= 0.0 else 3), (cone[0], cone[1], cone[2])
    for m in range(len(guesses)):
        q = guesses[m]
        done[m] = False
        away = minus(point, _grasp_point(joints, tip, ahead, q))
        if dot(away, away) > threshold * threshold:
            continue
        tried += 1
        before = last = np.inf
        for iteration in range(iterations):
            joint_frames(joints, q, frames)
            r, p = _last_frame(frames)
            axis, offset = applied(r, tip[2], tip[6], tip[10]), applied(r, tip[3], tip[7], tip[11])
            at = (
                p[0] + offset[0] + ahead * axis[0], p[1] + offset[1] + ahead * axis[1],
                p[2] + offset[2] + ahead * axis[2],
            )  # fmt: skip
            away = minus(point, at)
            distance = math.sqrt(dot(away, away))
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
            error_left = distance + weight * outside
            if gives_up and iteration >= _TRIAL and error_left > _PROGRESS * before:
                break
            before, last = last, error_left
            shrink = min(1.0, largest / max(distance, 1e-12))
            for k in range(3):
                error[k] = away[k] * shrink
                error[3 + k] = weight * 1.05 * turn[k]  # slightly past the edge, so that the axis counts as inside
            for j in range(n):
                along = (frames[j, 15], frames[j, 16], frames[j, 17])
                arm = (at[0] - frames[j, 12], at[1] - frames[j, 13], at[2] - frames[j, 14])
                slides, parked = joints[j, 15] > 0.0, upper[j] - lower[j] < _ROOM
                column = (0.0, 0.0, 0.0) if parked else along if slides else _cross(along, arm)
                turns = 0.0 if slides or parked or outside == 0.0 else weight
                for k in range(3):
                    jacobian[k, j], jacobian[3 + k, j] = column[k], turns * along[k]
            for i in range(rows):
                for k in range(i + 1):
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
