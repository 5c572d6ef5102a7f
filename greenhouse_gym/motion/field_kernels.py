"""Kernels of `greenhouse_gym.motion.distance_field`; lengths are in metres.

Distances are computed in single precision, so that eight nodes or shapes fit one processor instruction. Each kernel is
compiled for the grid of `distance_field`; its results do not depend on the processor.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import allocating, inlined, kernel
from greenhouse_gym.motion.distance_field import BLOCK, CELL, MAX_DEPTH, MAX_DISTANCE, ORIGIN, SHAPE
from greenhouse_gym.motion.float16_kernels import as_half, half_bits

Float32 = npt.NDArray[np.float32]
Array = npt.NDArray[np.float64]

_, _Y, _Z = SHAPE
_ORIGIN_X, _ORIGIN_Y, _ORIGIN_Z = ORIGIN
_PART = 4  # nodes per side
_NODES = _PART**3
_ZERO, _ONE = np.float32(0), np.float32(1)
_FAR, _DEEP, _NONE = np.float32(MAX_DISTANCE), np.float32(-MAX_DEPTH), np.float32(1e30)
_BEYOND = np.float32(MAX_DISTANCE + 1e-3)  # farther than what is stored, also after rounding
_SLACK = 1e-5  # metres, more than single precision rounds off
_BLOCK_RADIUS = np.float32((BLOCK - 1) / 2 * CELL * np.sqrt(3.0) + _SLACK)
_PART_RADIUS = np.float32((_PART - 1) / 2 * CELL * np.sqrt(3.0) + _SLACK)
_NEWTON_STEPS = 9


@inlined
def _to_capsule(x, y, z, c):
    """Return the signed distance of a point to a capsule, given by a tuple of a column of `column_nodes`."""
    dx, dy, dz = x - c[0], y - c[1], z - c[2]
    s = (dx * c[3] + dy * c[4] + dz * c[5]) * c[6]
    s = s if s > _ZERO else _ZERO
    s = s if s < _ONE else _ONE
    dx, dy, dz = dx - s * c[3], dy - s * c[4], dz - s * c[5]
    return np.sqrt(dx * dx + dy * dy + dz * dz) - c[7]


@inlined
def _to_box(x, y, z, b):
    """Return the signed distance of a point to a box, given by a tuple of a column of `column_nodes`."""
    dx, dy, dz = x - b[0], y - b[1], z - b[2]
    e = abs(b[6] * dx + b[9] * dy + b[12] * dz) - b[3]
    f = abs(b[7] * dx + b[10] * dy + b[13] * dz) - b[4]
    g = abs(b[8] * dx + b[11] * dy + b[14] * dz) - b[5]
    depth = e if e > f else f
    depth = depth if depth > g else g
    e, f, g = e if e > _ZERO else _ZERO, f if f > _ZERO else _ZERO, g if g > _ZERO else _ZERO
    return np.sqrt(e * e + f * f + g * g) + (depth if depth < _ZERO else _ZERO)


@inlined
def _capsule(c, i):
    return c[0, i], c[1, i], c[2, i], c[3, i], c[4, i], c[5, i], c[6, i], c[7, i]


@inlined
def _box(b, i):
    turn = b[6, i], b[7, i], b[8, i], b[9, i], b[10, i], b[11, i], b[12, i], b[13, i], b[14, i]
    return (b[0, i], b[1, i], b[2, i], b[3, i], b[4, i], b[5, i], *turn)


@inlined
def _keep(distances, count, radius, candidates, kept):
    """Write the candidates that may be the nearest one within a radius of the center; return their number."""
    nearest = _NONE
    for i in range(count):
        nearest = distances[i] if distances[i] < nearest else nearest
    limit = nearest + radius + radius
    limit = limit if limit < _FAR + radius else _FAR + radius
    found = 0
    for i in range(count):
        if distances[i] <= limit:
            kept[found], distances[found] = candidates[i], distances[i]
            found += 1
    return found


@inlined
def _lower(best, xs, ys, zs, capsules, boxes, i):
    """Lower the distances of nodes to those from part i where it is nearer."""
    n = capsules.shape[1]
    if i < n:
        capsule = _capsule(capsules, i)
        for k in range(_NODES):
            d = _to_capsule(xs[k], ys[k], zs[k], capsule)
            best[k] = d if d < best[k] else best[k]
    else:
        box = _box(boxes, i - n)
        for k in range(_NODES):
            d = _to_box(xs[k], ys[k], zs[k], box)
            best[k] = d if d < best[k] else best[k]


@inlined
def _to_ellipsoid(memory, count, axes):
    """Compute the signed distances of points to an ellipsoid; see `greenhouse_gym.geometry.distance_to_ellipsoids`.

    The first rows of ``memory`` (5, n) are the points' coordinates in its frame, without signs; the last is the result.
    """
    sizes, parameters, distances = memory[:3], memory[3], memory[4]
    e0, e1, e2 = axes[0], axes[1], axes[2]
    s0, s1, s2 = e0 * e0, e1 * e1, e2 * e2
    tiny = 1e-7 * min(e0, min(e1, e2))
    for i in range(count):
        y0, y1, y2 = max(sizes[0, i], tiny), max(sizes[1, i], tiny), max(sizes[2, i], tiny)
        parameters[i] = max(e0 * y0 - s0, max(e1 * y1 - s1, e2 * y2 - s2))
    for _ in range(_NEWTON_STEPS):  # of all points, for vector instructions
        for i in range(count):
            t, y0, y1, y2 = parameters[i], max(sizes[0, i], tiny), max(sizes[1, i], tiny), max(sizes[2, i], tiny)
            a0, a1, a2 = t + s0, t + s1, t + s2
            r0, r1, r2 = e0 * y0 / a0, e1 * y1 / a1, e2 * y2 / a2
            q0, q1, q2 = r0 * r0, r1 * r1, r2 * r2
            parameters[i] = t - (q0 + (q1 + q2) - 1.0) / (-2.0 * (q0 / a0 + (q1 / a1 + q2 / a2)))
    for i in range(count):
        t, y0, y1, y2 = parameters[i], max(sizes[0, i], tiny), max(sizes[1, i], tiny), max(sizes[2, i], tiny)
        n0, n1, n2 = y0 - s0 * y0 / (t + s0), y1 - s1 * y1 / (t + s1), y2 - s2 * y2 / (t + s2)
        distance = np.sqrt(n0 * n0 + (n1 * n1 + n2 * n2))
        f0, f1, f2 = sizes[0, i] / e0, sizes[1, i] / e1, sizes[2, i] / e2
        distances[i] = -distance if f0 * f0 + (f1 * f1 + f2 * f2) < 1.0 else distance


@allocating
def _to_others(block_x, block_y, capsules, boxes, nearest):
    """Compute the signed distances from a column of nodes to capsules and boxes, at most the largest stored one.

    Blocks of nodes are halved; a shape stays with a block only while it may be the nearest one somewhere in it.
    """
    n, m = capsules.shape[1], boxes.shape[1]
    everything, in_block, in_part = np.arange(n + m), np.empty(n + m, np.int64), np.empty(n + m, np.int64)
    distances = np.empty(n + m, np.float32)
    xs, ys, zs, best = (
        np.empty(_NODES, np.float32), np.empty(_NODES, np.float32), np.empty(_NODES, np.float32),
        np.empty(_NODES, np.float32),
    )  # fmt: skip
    nearest[:] = as_half(_FAR)
    for block_z in range(0, _Z, BLOCK):
        half = (BLOCK - 1) / 2
        x = np.float32((block_x + half) * CELL + _ORIGIN_X)
        y = np.float32((block_y + half) * CELL + _ORIGIN_Y)
        z = np.float32((block_z + half) * CELL + _ORIGIN_Z)
        for i in range(n):
            distances[i] = _to_capsule(x, y, z, _capsule(capsules, i))
        for i in range(m):
            distances[n + i] = _to_box(x, y, z, _box(boxes, i))
        count = _keep(distances, n + m, _BLOCK_RADIUS, everything, in_block)
        for part in range(8 if count else 0):
            part_x = block_x + _PART * (part >> 2)
            part_y = block_y + _PART * ((part >> 1) & 1)
            part_z = block_z + _PART * (part & 1)
            half = (_PART - 1) / 2
            x = np.float32((part_x + half) * CELL + _ORIGIN_X)
            y = np.float32((part_y + half) * CELL + _ORIGIN_Y)
            z = np.float32((part_z + half) * CELL + _ORIGIN_Z)
            k = 0
            while k < count and in_block[k] < n:
                distances[k] = _to_capsule(x, y, z, _capsule(capsules, in_block[k]))
                k += 1
            while k < count:
                distances[k] = _to_box(x, y, z, _box(boxes, in_block[k] - n))
                k += 1
            left = _keep(distances, count, _PART_RADIUS, in_block, in_part)
            if left == 0:
                continue
            for k in range(_NODES):
                xs[k] = np.float32((part_x + (k >> 4)) * CELL + _ORIGIN_X)
                ys[k] = np.float32((part_y + ((k >> 2) & 3)) * CELL + _ORIGIN_Y)
                zs[k] = np.float32((part_z + (k & 3)) * CELL + _ORIGIN_Z)
                best[k] = _FAR
            first = 0
            for j in range(1, left):
                first = j if distances[j] < distances[first] else first
            _lower(best, xs, ys, zs, capsules, boxes, in_part[first])
            largest = best[0]
            for k in range(1, _NODES):
                largest = best[k] if best[k] > largest else largest
            for j in range(left):
                if j != first and distances[j] - _PART_RADIUS < largest:
                    _lower(best, xs, ys, zs, capsules, boxes, in_part[j])
            for k in range(_NODES):
                d = best[k] if best[k] > _DEEP else _DEEP
                a, b, c = part_x - block_x + (k >> 4), part_y - block_y + ((k >> 2) & 3), part_z + (k & 3)
                nearest[a, b, c] = as_half(d)


@inlined
def _range(center, reach, origin, first, count):
    """Return the first and the last plus one of some nodes along an axis within reach of a center."""
    low, high = np.ceil((center - reach - origin) / CELL), np.floor((center + reach - origin) / CELL) + 1
    return max(int(max(low, 0.0)), first), min(int(max(high, 0.0)), first + count)


@inlined
def _to_tomato(
    block_x, block_y, k, tomato, stretched, center, semi_axes, rotation, base, first, second, index, memory, own, chosen
):
    """Lower the distances of a column of nodes to those from tomato k where it is nearer."""
    center_x, center_y, center_z, radius = tomato
    size = max(semi_axes[0], max(semi_axes[1], semi_axes[2])) if stretched else radius
    reach, number = size + MAX_DISTANCE, np.int16(k)
    low_x, high_x = _range(center_x, reach, _ORIGIN_X, block_x, BLOCK)
    low_y, high_y = _range(center_y, reach, _ORIGIN_Y, block_y, BLOCK)
    if low_x >= high_x or low_y >= high_y:
        return
    low_z, high_z = _range(center_z, reach, _ORIGIN_Z, 0, _Z)
    bound = np.float32(size + _SLACK) if stretched else np.float32(radius)
    squares, d = own[0], own[1]
    for z in range(_Z):
        dz = np.float32(z * CELL + _ORIGIN_Z - center_z)
        squares[z] = dz * dz if low_z <= z < high_z else _NONE
    for x in range(low_x, high_x):
        px = x * CELL + _ORIGIN_X
        dx = np.float32(px - center_x)
        for y in range(low_y, high_y):
            py = y * CELL + _ORIGIN_Y
            dy = np.float32(py - center_y)
            flat = dx * dx + dy * dy
            if np.sqrt(flat) - bound > _BEYOND:
                continue
            i, j = x - block_x, y - block_y
            f, s, tomatoes = first[i, j], second[i, j], index[i, j]
            for z in range(_Z):
                d[z] = np.sqrt(flat + squares[z]) - bound
            if stretched:  # exact only where it may be nearer than the second nearest
                count = 0
                for z in range(low_z, high_z):
                    if d[z] < s[z]:
                        pz = z * CELL + _ORIGIN_Z
                        ex = base[0, 0] * px + base[0, 1] * py + base[0, 2] * pz + base[0, 3] - center[0]
                        ey = base[1, 0] * px + base[1, 1] * py + base[1, 2] * pz + base[1, 3] - center[1]
                        ez = base[2, 0] * px + base[2, 1] * py + base[2, 2] * pz + base[2, 3] - center[2]
                        for axis in range(3):
                            a, b, c = rotation[0, axis], rotation[1, axis], rotation[2, axis]
                            memory[axis, count] = abs(a * ex + b * ey + c * ez)
                        chosen[count] = z
                        count += 1
                _to_ellipsoid(memory, count, semi_axes)
                for i in range(count):
                    d[chosen[i]] = np.float32(memory[4, i])
            for z in range(_Z):  # without branches, for vector instructions
                distance, nearest, next_nearest, known = d[z], f[z], s[z], tomatoes[z]
                closer = distance < nearest
                other = distance if distance < next_nearest else next_nearest
                s[z] = nearest if closer else other
                f[z] = distance if closer else nearest
                tomatoes[z] = number if closer else known


@kernel(
    "void(f4[:, ::1], f4[:, ::1], f8[:, ::1], b1[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8, i8, "
    "u8[:, :, ::1])",
    writes=("nodes",),
)
def column_nodes(
    capsules: Float32,
    boxes: Float32,
    tomatoes: Array,
    stretched: npt.NDArray[np.bool_],
    centers: Array,
    semi_axes: Array,
    rotations: Array,
    scene_from_base: Array,
    block_x: int,
    block_y: int,
    nodes: npt.NDArray[np.uint64],
) -> None:
    """Compute a column of nodes of a scene's field, `BLOCK` nodes wide along x and y.

    Args:
        capsules: (8, n) start, axis, inverse of its squared length or 0, and radius of capsules, base frame.
        boxes: (15, m) center, half extents and rotation base_from_box, by rows, of boxes.
        tomatoes: (t, 4) centers in the base frame and radii.
        stretched: (t,) whether a tomato is an ellipsoid.
        centers: (t, 3) centers of the tomatoes in the scene frame; this and the next two are read of ellipsoids only.
        semi_axes: (t, 3) their semi-axes.
        rotations: (t, 3, 3) their rotations in the scene frame.
        scene_from_base: (4, 4) pose of the base.
        block_x: First node of the column along x.
        block_y: First node of the column along y.
        nodes: (`BLOCK`, `BLOCK`, z) the result: `NODE` as whole numbers.
    """
    shape = BLOCK, BLOCK, _Z
    first, second, tomato = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.int16)
    memory, own, chosen = np.empty((5, _Z)), np.empty((2, _Z), np.float32), np.empty(_Z, np.int64)
    _to_others(block_x, block_y, capsules, boxes, first)
    for x in range(BLOCK):
        for y in range(BLOCK):
            for z in range(_Z):
                second[x, y, z], tomato[x, y, z] = first[x, y, z], -1
    for k in range(len(tomatoes)):
        _to_tomato(
            block_x, block_y, k, tomatoes[k], stretched[k], centers[k], semi_axes[k], rotations[k], scene_from_base,
            first, second, tomato, memory, own, chosen,
        )  # fmt: skip
    for x in range(BLOCK):
        for y in range(BLOCK):
            for z in range(_Z):
                d = first[x, y, z] if first[x, y, z] > _DEEP else _DEEP
                other = second[x, y, z] if second[x, y, z] > _DEEP else _DEEP
                both = np.uint64(half_bits(d) | (half_bits(other) << np.uint32(16)))
                nodes[x, y, z] = both | (np.uint64(tomato[x, y, z] & 0xFFFF) << np.uint64(32))
