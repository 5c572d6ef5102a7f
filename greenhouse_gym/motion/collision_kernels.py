"""Kernels of collision checks and inverse kinematics: an arm of capsules among the shapes of a scene.

The arm is a chain of joints with capsules; spheres are capsules without length. The world is a tree of boxes over
spheres, capsules, ellipsoids, boxes and planes. Both are a few arrays, so that a single call takes a microsecond. The
first argument of most kernels is a tuple of:

- joints (n, 16): fixed pose before each joint as 3x4 by rows, unit axis in the frame after it, 1 for slides;
- capsules (c, 11): index of the last joint before the capsule or -1, both ends in that joint's frame, radius, margin,
  and the masks ``contype`` and ``conaffinity``;
- pairs (p, 2): capsules that must not touch each other;
- geoms (g, 19): type as in MuJoCo, position, rotation by rows, size, ``contype``, ``conaffinity`` and margin;
- nodes (b, 9): center and half sizes of the boxes of the tree, margins included, their two children, and the geom of a
  leaf or -1;
- planes (k, 19): the geoms that are planes.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel

Array = npt.NDArray[np.float64]
Pairs = npt.NDArray[np.int32]
World = tuple[Array, Array, Pairs, Array, Array, Array]

_PLANE, _SPHERE = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_SPHERE)
_CAPSULE, _BOX = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_BOX)
_STACK = 128  # deeper than any tree with a median split
_GOLDEN, _SEARCHES = (math.sqrt(5.0) - 1) / 2, 24
_NEWTON_STEPS = 9
WORLD = "Tuple((f8[:, ::1], f8[:, ::1], i4[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1]))"


@inlined
def _clip(x):
    return 0.0 if x < 0.0 else (1.0 if x > 1.0 else x)


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def _minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def segments_apart(a, b, c, d):
    """Return the squared distance of the segments from a to b and from c to d (Ericson 2004)."""
    u, v, w = _minus(b, a), _minus(d, c), _minus(a, c)
    uu, vv, vw = _dot(u, u), _dot(v, v), _dot(v, w)
    s = t = 0.0
    if uu < 1e-14:
        t = _clip(vw / vv) if vv >= 1e-14 else 0.0
    else:
        uw = _dot(u, w)
        if vv < 1e-14:
            s = _clip(-uw / uu)
        else:
            uv = _dot(u, v)
            determinant = uu * vv - uv * uv
            s = _clip((uv * vw - uw * vv) / determinant) if determinant > 1e-14 else 0.0
            t = (uv * s + vw) / vv
            if t < 0.0:
                t, s = 0.0, _clip(-uw / uu)
            elif t > 1.0:
                t, s = 1.0, _clip((uv - uw) / uu)
    x, y, z = w[0] + s * u[0] - t * v[0], w[1] + s * u[1] - t * v[1], w[2] + s * u[2] - t * v[2]
    return x * x + y * y + z * z


@inlined
def _excess(x, half):
    return x - half if x > half else (x + half if x < -half else 0.0)


@inlined
def _slope(a, d, half, t):
    """Return half the derivative along a segment of the squared distance to a box."""
    x, y, z = a[0] + t * d[0], a[1] + t * d[1], a[2] + t * d[2]
    return _excess(x, half[0]) * d[0] + _excess(y, half[1]) * d[1] + _excess(z, half[2]) * d[2]


@inlined
def segment_to_box(a, b, half):
    """Return the squared distance of the segment from a to b to a box about the origin.

    The derivative along the segment is increasing and linear between the planes of the box.
    """
    d = _minus(b, a)
    first, last = _slope(a, d, half, 0.0), _slope(a, d, half, 1.0)
    if first >= 0.0:
        t = 0.0
    elif last <= 0.0:
        t = 1.0
    else:
        low, high = 0.0, 1.0
        for k in range(6):
            along, start, size = d[0], a[0], half[0]
            if k > 3:
                along, start, size = d[2], a[2], half[2]
            elif k > 1:
                along, start, size = d[1], a[1], half[1]
            if abs(along) > 1e-12:
                u = ((size if k & 1 else -size) - start) / along
                if low < u < high:
                    value = _slope(a, d, half, u)
                    if value < 0.0:
                        low, first = u, value
                    else:
                        high, last = u, value
        t = low + (high - low) * -first / (last - first) if last > first else low
    x, y, z = _excess(a[0] + t * d[0], half[0]), _excess(a[1] + t * d[1], half[1]), _excess(a[2] + t * d[2], half[2])
    return x * x + y * y + z * z


@inlined
def _to_ellipsoid(a, b, t, e):
    """Return the signed distance of a point of a segment to an ellipsoid; see `geometry.distance_to_ellipsoids`."""
    l0, l1, l2 = abs(a[0] + t * (b[0] - a[0])), abs(a[1] + t * (b[1] - a[1])), abs(a[2] + t * (b[2] - a[2]))
    s0, s1, s2 = e[0] * e[0], e[1] * e[1], e[2] * e[2]
    tiny = 1e-7 * min(e[0], min(e[1], e[2]))
    y0, y1, y2 = max(l0, tiny), max(l1, tiny), max(l2, tiny)
    root = max(e[0] * y0 - s0, max(e[1] * y1 - s1, e[2] * y2 - s2))
    for _ in range(_NEWTON_STEPS):
        d0, d1, d2 = root + s0, root + s1, root + s2
        r0, r1, r2 = e[0] * y0 / d0, e[1] * y1 / d1, e[2] * y2 / d2
        excess = r0 * r0 + r1 * r1 + r2 * r2 - 1.0
        root += excess / (2.0 * (r0 * r0 / d0 + r1 * r1 / d1 + r2 * r2 / d2))
    n0, n1, n2 = y0 - s0 * y0 / (root + s0), y1 - s1 * y1 / (root + s1), y2 - s2 * y2 / (root + s2)
    distance = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    return -distance if l0 * l0 / s0 + l1 * l1 / s1 + l2 * l2 / s2 < 1.0 else distance


@inlined
def segment_to_ellipsoid(a, b, axes):
    """Return the signed distance of the segment from a to b to an ellipsoid about the origin, by golden sections."""
    low, high = 0.0, 1.0
    u, v = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    at_u, at_v = _to_ellipsoid(a, b, u, axes), _to_ellipsoid(a, b, v, axes)
    best = min(min(at_u, at_v), min(_to_ellipsoid(a, b, 0.0, axes), _to_ellipsoid(a, b, 1.0, axes)))
    for _ in range(_SEARCHES):
        if at_u < at_v:
            high, v, at_v = v, u, at_u
            u = high - _GOLDEN * (high - low)
            at_u = _to_ellipsoid(a, b, u, axes)
            best = min(best, at_u)
        else:
            low, u, at_u = u, v, at_v
            v = low + _GOLDEN * (high - low)
            at_v = _to_ellipsoid(a, b, v, axes)
            best = min(best, at_v)
    return best


@inlined
def _local(p, g):
    """Return a point in the frame of a geom."""
    x, y, z = p[0] - g[1], p[1] - g[2], p[2] - g[3]
    return (
        g[4] * x + g[7] * y + g[10] * z,
        g[5] * x + g[8] * y + g[11] * z,
        g[6] * x + g[9] * y + g[12] * z,
    )


@inlined
def near(g, a, b, radius):
    """Return whether the segment from a to b is nearer to a geom than a radius."""
    if radius <= 0.0:
        return False
    kind, size = int(g[0]), (g[13], g[14], g[15])
    if kind == _SPHERE:
        center, limit = (g[1], g[2], g[3]), radius + size[0]
        return segments_apart(a, b, center, center) < limit * limit
    if kind == _CAPSULE:
        x, y, z, limit = g[6] * size[1], g[9] * size[1], g[12] * size[1], radius + size[0]
        return segments_apart(a, b, (g[1] - x, g[2] - y, g[3] - z), (g[1] + x, g[2] + y, g[3] + z)) < limit * limit
    u, v = _local(a, g), _local(b, g)
    if kind == _PLANE:
        return min(u[2], v[2]) < radius
    if kind == _BOX:
        return segment_to_box(u, v, size) < radius * radius
    origin = (0.0, 0.0, 0.0)
    apart = math.sqrt(segments_apart(u, v, origin, origin))
    if apart >= radius + max(size[0], max(size[1], size[2])):
        return False
    return apart < radius + min(size[0], min(size[1], size[2])) or segment_to_ellipsoid(u, v, size) < radius


@inlined
def _distance(g, a, b):
    """Return the distance of the segment from a to b to a geom; inside a box it is 0."""
    kind, size, origin = int(g[0]), (g[13], g[14], g[15]), (0.0, 0.0, 0.0)
    u, v = _local(a, g), _local(b, g)
    if kind == _SPHERE:
        return math.sqrt(segments_apart(u, v, origin, origin)) - size[0]
    if kind == _CAPSULE:
        return math.sqrt(segments_apart(u, v, (0.0, 0.0, -size[1]), (0.0, 0.0, size[1]))) - size[0]
    if kind == _PLANE:
        return min(u[2], v[2])
    if kind == _BOX:
        return math.sqrt(segment_to_box(u, v, size))
    return segment_to_ellipsoid(u, v, size)


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
def _applied(r, x, y, z):
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


@inlined
def _frames(joints, q, frames):
    """Write the frames after each joint: rotation by rows, position; then the anchor and the axis of the joint."""
    r, px, py, pz = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), 0.0, 0.0, 0.0
    for j in range(len(joints)):
        o = joints[j]
        x, y, z = _applied(r, o[3], o[7], o[11])
        px, py, pz = px + x, py + y, pz + z
        r = _product(r, (o[0], o[1], o[2], o[4], o[5], o[6], o[8], o[9], o[10]))
        x, y, z = _applied(r, o[12], o[13], o[14])
        f = frames[j]
        f[12], f[13], f[14], f[15], f[16], f[17] = px, py, pz, x, y, z
        if o[15] > 0.0:
            px, py, pz = px + q[j] * x, py + q[j] * y, pz + q[j] * z
        else:
            r = _product(r, _turned((o[12], o[13], o[14]), q[j]))
        for k in range(9):
            f[k] = r[k]
        f[9], f[10], f[11] = px, py, pz


@inlined
def memory_for(world):
    """Return the memory that checks need: joint frames, ends of capsules, a stack, a configuration and a motion."""
    n, frames, ends = len(world[0]), np.empty((len(world[0]), 18)), np.empty((len(world[1]), 6))
    return frames, ends, np.empty(_STACK, np.int64), np.empty(n), np.empty(n)


@inlined
def place(joints, capsules, q, frames, ends):
    """Write both ends of each capsule in a configuration; the frames are memory."""
    _frames(joints, q, frames)
    for k in range(len(capsules)):
        c, j = capsules[k], int(capsules[k, 0])
        for end in range(2):
            x, y, z = c[1 + 3 * end], c[2 + 3 * end], c[3 + 3 * end]
            if j >= 0:
                f = frames[j]
                x, y, z = (
                    f[9] + (f[0] * x + f[1] * y + f[2] * z),
                    f[10] + (f[3] * x + f[4] * y + f[5] * z),
                    f[11] + (f[6] * x + f[7] * y + f[8] * z),
                )
            ends[k, 3 * end], ends[k, 3 * end + 1], ends[k, 3 * end + 2] = x, y, z


@inlined
def gap(world, q, limit, first, memory):
    """Return the smallest distance beyond the margins in a configuration if it is below a limit, else the limit.

    With ``first``, the search ends with -1 at any distance below the limit. ``memory`` is that of `memory_for`.
    """
    joints, capsules, pairs, geoms, nodes, planes = world
    frames, ends, stack = memory[0], memory[1], memory[2]
    place(joints, capsules, q, frames, ends)
    for p in range(len(pairs)):
        i, k = pairs[p, 0], pairs[p, 1]
        a, b = (ends[i, 0], ends[i, 1], ends[i, 2]), (ends[i, 3], ends[i, 4], ends[i, 5])
        c, d = (ends[k, 0], ends[k, 1], ends[k, 2]), (ends[k, 3], ends[k, 4], ends[k, 5])
        radius = capsules[i, 7] + capsules[k, 7] + capsules[i, 8] + capsules[k, 8]
        reach, squared = radius + limit, segments_apart(a, b, c, d)
        if reach > 0.0 and squared < reach * reach:
            if first:
                return -1.0
            limit = math.sqrt(squared) - radius
    for k in range(len(capsules) - 1, -1, -1):  # the tool first: most collisions are its
        if capsules[k, 0] < 0 or len(nodes) == 0:
            continue
        a, b = (ends[k, 0], ends[k, 1], ends[k, 2]), (ends[k, 3], ends[k, 4], ends[k, 5])
        radius, offered, accepted = capsules[k, 7] + capsules[k, 8], int(capsules[k, 9]), int(capsules[k, 10])
        mx, my, mz = (a[0] + b[0]) / 2, (a[1] + b[1]) / 2, (a[2] + b[2]) / 2
        hx, hy, hz = abs(a[0] - b[0]) / 2 + radius, abs(a[1] - b[1]) / 2 + radius, abs(a[2] - b[2]) / 2 + radius
        for p in range(len(planes)):
            g = planes[p]
            if (int(g[17]) & offered or int(g[16]) & accepted) and near(g, a, b, radius + g[18] + limit):
                if first:
                    return -1.0
                limit = _distance(g, a, b) - radius - g[18]
        stack[0] = 0
        size = 1
        while size > 0:
            size -= 1
            n = nodes[stack[size]]
            if (
                abs(n[0] - mx) > n[3] + hx + limit
                or abs(n[1] - my) > n[4] + hy + limit
                or abs(n[2] - mz) > n[5] + hz + limit
            ):
                continue
            if n[8] < 0:
                stack[size], stack[size + 1] = int(n[6]), int(n[7])
                size += 2
                continue
            g = geoms[int(n[8])]
            if (int(g[17]) & offered or int(g[16]) & accepted) and near(g, a, b, radius + g[18] + limit):
                if first:
                    return -1.0
                limit = _distance(g, a, b) - radius - g[18]
    return limit


@kernel(f"i8({WORLD}, f8[:, ::1])")
def first_contact(world: World, configurations: Array) -> int:
    """Return the index of the first of some configurations (k, n) that is in collision, or -1."""
    memory = memory_for(world)
    for k in range(len(configurations)):
        if gap(world, configurations[k], 0.0, True, memory) < 0.0:
            return k
    return -1


@kernel(f"void({WORLD}, f8[:, ::1], b1[::1])", writes=("touching",))
def contacts(world: World, configurations: Array, touching: npt.NDArray[np.bool_]) -> None:
    """Write which of some configurations (k, n) are in collision, (k,)."""
    memory = memory_for(world)
    for k in range(len(configurations)):
        touching[k] = gap(world, configurations[k], 0.0, True, memory) < 0.0


@inlined
def contacts_along(world, start, motion, steps, memory):
    """Check the inner points of a motion; see `contact_along`."""
    q, checks, bits = memory[3], 0, 0
    while (1 << bits) <= steps - 1:
        bits += 1
    for index in range(1, 1 << bits):
        reverse = 0
        for bit in range(bits):
            reverse |= ((index >> bit) & 1) << (bits - 1 - bit)
        if reverse < steps:
            fraction = reverse / steps
            for j in range(len(q)):
                q[j] = start[j] + fraction * motion[j]
            checks += 1
            if gap(world, q, 0.0, True, memory) < 0.0:
                return checks
    return 0


@kernel(f"i8({WORLD}, f8[::1], f8[::1], i8)")
def contact_along(world: World, start: Array, motion: Array, steps: int) -> int:
    """Check the inner points of a straight motion from a configuration, in `collision.halving_order`.

    Returns:
        Number of checks up to the first collision, or 0 without a collision.
    """
    return contacts_along(world, start, motion, steps, memory_for(world))


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
    writes=("guesses", "done"),
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
            _frames(joints, q, frames)
            f = frames[n - 1]
            r = (f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8])
            axis, offset = _applied(r, tip[2], tip[6], tip[10]), _applied(r, tip[3], tip[7], tip[11])
            at = (
                f[9] + offset[0] + ahead * axis[0], f[10] + offset[1] + ahead * axis[1],
                f[11] + offset[2] + ahead * axis[2],
            )  # fmt: skip
            away = _minus(point, at)
            distance = math.sqrt(_dot(away, away))
            if iteration == 0:
                if distance > threshold:
                    break
                tried += 1
            turn, outside = (0.0, 0.0, 0.0), 0.0
            if rows == 6:
                across = _cross(axis, direction)
                sine = math.sqrt(_dot(across, across))
                outside = max(math.atan2(sine, _dot(axis, direction)) - cone[3], 0.0)
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
