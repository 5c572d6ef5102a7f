"""Kernels of `greenhouse_gym.rendering.raycaster`: rays through the tree over the shapes of a scene.

The arithmetic is that of MuJoCo, operation by operation, so that hits are equal to the last bit.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
import numpy.typing as npt

from greenhouse_gym.common.jit import inlined, kernel
from greenhouse_gym.geometry.segment_kernels import dot, minus

Array = npt.NDArray[np.float64]
Ids = npt.NDArray[np.int32]

_SPHERE, _CAPSULE = int(mujoco.mjtGeom.mjGEOM_SPHERE), int(mujoco.mjtGeom.mjGEOM_CAPSULE)
_ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
BUNDLE = 16
"""Rays that pass through the tree together."""

_STACK = 128  # deeper than any tree with a median split
_TINY = 1e-15  # MuJoCo's mjMINVAL
_SLACK = 1e-9  # metres, by which boxes of the tree are enlarged against rounding


@inlined
def _rotation(q):
    """Return the rotation of a quaternion by rows."""
    if q[0] == 1.0 and q[1] == 0.0 and q[2] == 0.0 and q[3] == 0.0:
        return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    q00, q01, q02, q03 = q[0] * q[0], q[0] * q[1], q[0] * q[2], q[0] * q[3]
    q11, q12, q13 = q[1] * q[1], q[1] * q[2], q[1] * q[3]
    q22, q23, q33 = q[2] * q[2], q[2] * q[3], q[3] * q[3]
    return (
        (q00 - q22) + (q11 - q33), 2 * (q12 - q03), 2 * (q13 + q02),
        2 * (q12 + q03), (q00 + q22) - (q11 + q33), 2 * (q23 - q01),
        2 * (q13 - q02), 2 * (q23 + q01), (q00 - q22) + (q33 - q11),
    )  # fmt: skip


@inlined
def _turned_back(r, v):
    return (
        r[0] * v[0] + r[3] * v[1] + r[6] * v[2],
        r[1] * v[0] + r[4] * v[1] + r[7] * v[2],
        r[2] * v[0] + r[5] * v[1] + r[8] * v[2],
    )


@inlined
def _roots(a, b, c):
    """Return both roots of a x^2 + 2 b x + c in ascending order, or -1 twice."""
    determinant = b * b - a * c
    if determinant < _TINY:
        return -1.0, -1.0
    determinant = math.sqrt(determinant)
    return (-b - determinant) / a, (-b + determinant) / a


@inlined
def _first(roots):
    return roots[0] if roots[0] >= 0.0 else (roots[1] if roots[1] >= 0.0 else -1.0)


@inlined
def _nearer(best, x):
    return x if best < 0.0 or x < best else best


@inlined
def _inverse_squares(size):
    return 1.0 / (size[0] * size[0]), 1.0 / (size[1] * size[1]), 1.0 / (size[2] * size[2])


@inlined
def _to_sphere(offset, direction, squared):
    return _first(_roots(dot(direction, direction), dot(direction, offset), dot(offset, offset) - squared))


@inlined
def _to_capsule(p, d, size):
    """Return the distance along a ray to a capsule, and which part it hits: 0 the side, 1 and -1 the caps."""
    best, part = -1.0, 0
    a, b = d[0] * d[0] + d[1] * d[1], d[0] * p[0] + d[1] * p[1]
    x = _first(_roots(a, b, p[0] * p[0] + p[1] * p[1] - size[0] * size[0]))
    if x >= 0.0 and abs(p[2] + x * d[2]) <= size[1]:
        best = x
    for side in (1, -1):
        q = (p[0], p[1], p[2] - side * size[1])
        roots = _roots(dot(d, d), dot(d, q), dot(q, q) - size[0] * size[0])
        for k in range(2):
            x = roots[k]
            if x >= 0.0 and side * (p[2] + x * d[2]) >= size[1] and _nearer(best, x) != best:
                best, part = x, side
    return best, part


@inlined
def _to_box(p, d, size):
    """Return the distance along a ray to a box, and the face: 1 to 3 for the axes, negative on the lower side."""
    best, face = -1.0, 0
    for i in range(3):
        along, j, k = d[i], 0 if i else 1, 1 if i == 2 else 2
        if abs(along) > _TINY:
            for side in (-1, 1):
                x = (side * size[i] - p[i]) / along
                if (
                    x >= 0.0
                    and abs(p[j] + x * d[j]) <= size[j]
                    and abs(p[k] + x * d[k]) <= size[k]
                    and _nearer(best, x) != best
                ):
                    best, face = x, side * (i + 1)
    return best, face


@inlined
def _to_geom(kind, size, r, offset, direction):
    """Return the distance along a ray to a geom with a rotation, or -1, and the part of the geom."""
    if kind == _SPHERE:
        return _to_sphere(offset, direction, size[0] * size[0]), 0
    if kind != _ELLIPSOID:
        reach = size[0] + size[1]
        squared = reach * reach if kind == _CAPSULE else dot(size, size)
        if _to_sphere(offset, direction, squared) < 0.0:
            return -1.0, 0
    p, d = _turned_back(r, offset), _turned_back(r, direction)
    if kind == _CAPSULE:
        return _to_capsule(p, d, size)
    if kind != _ELLIPSOID:
        return _to_box(p, d, size)
    s = _inverse_squares(size)
    e = (s[0] * d[0], s[1] * d[1], s[2] * d[2])
    scaled = s[0] * p[0] * p[0] + s[1] * p[1] * p[1] + s[2] * p[2] * p[2]
    return _first(_roots(dot(e, d), dot(e, p), scaled - 1.0)), 0


@inlined
def _unit(v):
    length = math.sqrt(dot(v, v))
    scale = 1.0 / length
    return v[0] * scale, v[1] * scale, v[2] * scale


@inlined
def _normal(kind, size, position, quat, origin, direction, x, part):
    """Return the unit normal of a geom where a ray hits a part of it at a distance."""
    if kind == _SPHERE:
        hit = (origin[0] + direction[0] * x, origin[1] + direction[1] * x, origin[2] + direction[2] * x)
        return _unit(minus(hit, position))
    offset = minus(origin, position)
    r = _rotation(quat)
    if kind != _CAPSULE and kind != _ELLIPSOID:
        axis, sign = abs(part) - 1, 1.0 if part > 0 else -1.0
        return sign * r[axis], sign * r[3 + axis], sign * r[6 + axis]
    p, d = _turned_back(r, offset), _turned_back(r, direction)
    n = (p[0] + d[0] * x, p[1] + d[1] * x, p[2] + d[2] * x)
    if kind == _ELLIPSOID:
        s = _inverse_squares(size)
        n = (n[0] * s[0], n[1] * s[1], n[2] * s[2])
    else:
        n = (n[0], n[1], n[2] - part * size[1] if part else 0.0)
    n = _unit(n)
    return (
        r[0] * n[0] + r[1] * n[1] + r[2] * n[2],
        r[3] * n[0] + r[4] * n[1] + r[5] * n[2],
        r[6] * n[0] + r[7] * n[1] + r[8] * n[2],
    )


@inlined
def _geom(g, sizes, positions, quats, origin):
    """Return position, offset from an origin, size and rotation of a geom."""
    at = (positions[g, 0], positions[g, 1], positions[g, 2])
    extents = (sizes[g, 0], sizes[g, 1], sizes[g, 2])
    return at, minus(at, origin), extents, (quats[g, 0], quats[g, 1], quats[g, 2], quats[g, 3])


@inlined
def _entry(box, origin, inverse, limit):
    """Return the distance along a ray to a box of the tree, or -1 if it is missed or beyond a limit."""
    low, high = 0.0, limit
    for i in range(3):
        u = (box[i] - box[3 + i] - _SLACK - origin[i]) * inverse[i]
        v = (box[i] + box[3 + i] + _SLACK - origin[i]) * inverse[i]
        low, high = max(low, min(u, v)), min(high, max(u, v))
    return low if low <= high else -1.0


@inlined
def _entry_of_bundle(box, origin, bundle, limit):
    """Return a lower bound of `_entry` for a bundle of rays, or -1 if it misses the box.

    The bundle is the smallest and the largest component of the directions along each axis, and their inverses.
    """
    low, high = 0.0, limit
    for i in range(3):
        near, far = box[i] - box[3 + i] - _SLACK - origin[i], box[i] + box[3 + i] + _SLACK - origin[i]
        smallest, largest, of_smallest, of_largest = bundle[i, 0], bundle[i, 1], bundle[i, 2], bundle[i, 3]
        if (near > 0.0 and largest <= 0.0) or (far < 0.0 and smallest >= 0.0):
            return -1.0
        if near > 0.0:
            low = max(low, near * of_largest)
        elif far < 0.0:
            low = max(low, far * of_smallest)
        if smallest > 0.0:
            high = min(high, far * of_smallest)
        elif largest < 0.0:
            high = min(high, near * of_largest)
    return low if low <= high * (1.0 + 1e-12) else -1.0


@inlined
def _inverse(x):
    return 1.0 / (math.copysign(1e-12, x) if abs(x) < 1e-12 else x)


@kernel(
    "void(f8[::1], f8[:, ::1], i8[::1], f8, i8, i8, "
    "Tuple((i4[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f4[:, ::1])), "
    "Tuple((i4[:, ::1], i4[::1], f8[:, ::1])), f8[::1], i8[::1], f8[:, ::1])",
    writes=("distance", "hit", "normal"),
)
def nearer_hits(
    origin: Array,
    directions: Array,
    order: npt.NDArray[np.int64],
    reach: float,
    first: int,
    last: int,
    geoms: tuple[Ids, Array, Array, Array, Array, npt.NDArray[np.float32]],
    tree: tuple[Ids, Ids, Array],
    distance: Array,
    hit: npt.NDArray[np.int64],
    normal: Array,
) -> None:
    """Find which geoms of the world rays hit before anything else.

    Args:
        origin: (3,) origin of the rays, metres.
        directions: (m, 3) unit vectors.
        order: (m,) all rays, in an order in which `BUNDLE` successive ones are close to each other.
        reach: Geoms whose bounding spheres begin farther away are left out, metres.
        first: Id of the first geom that may be hit.
        last: Id after the last one. Invisible ones are left out.
        geoms: Types (g,), sizes (g, 3), positions (g, 3), rotations (g, 4), bounding radii (g,) and colors (g, 4) of
            all geoms of the model.
        tree: Children (b, 2), geoms (b,) and boxes (b, 6) of the tree over those of the world.
        distance: (m,) distances of known hits, or -1; becomes that of the nearest hit.
        hit: (m,) becomes the geom, where one is nearer; otherwise it is unchanged.
        normal: (m, 3) becomes its unit normal; (0, 3) to leave normals out.
    """
    kinds, sizes, positions, quats, radii, colors = geoms
    child, node, boxes = tree
    stack, entries = np.empty(_STACK, np.int64), np.empty(_STACK)
    bundle, inverses = np.empty((3, 4)), np.empty((BUNDLE, 3))
    best, found, part = np.empty(BUNDLE), np.empty(BUNDLE, np.int64), np.empty(BUNDLE, np.int64)
    widest = 0.0
    for g in range(first, last):
        widest = max(widest, radii[g])
    o = (origin[0], origin[1], origin[2])
    for start in range(0, len(order), BUNDLE):
        count, limit = min(BUNDLE, len(order) - start), 0.0
        for k in range(count):
            m = order[start + k]
            best[k], found[k], part[k] = distance[m] if distance[m] >= 0.0 else np.inf, -1, 0
            limit = max(limit, min(best[k], reach + 2.0 * widest))
            for i in range(3):
                x = directions[m, i]
                inverses[k, i] = _inverse(x)
                bundle[i, 0] = x if k == 0 else min(bundle[i, 0], x)
                bundle[i, 1] = x if k == 0 else max(bundle[i, 1], x)
        for i in range(3):
            bundle[i, 2], bundle[i, 3] = _inverse(bundle[i, 0]), _inverse(bundle[i, 1])
        stack[0], entries[0] = 0, 0.0
        size = 1
        while size > 0:
            size -= 1
            n = stack[size]
            if entries[size] > limit:
                continue
            g = node[n]
            if g < 0:
                a, b = child[n, 0], child[n, 1]
                at_a, at_b = _entry_of_bundle(boxes[a], o, bundle, limit), _entry_of_bundle(boxes[b], o, bundle, limit)
                if at_a > at_b:
                    a, b, at_a, at_b = b, a, at_b, at_a
                if at_b >= 0.0:  # the farther one, to be visited later
                    stack[size], entries[size] = b, at_b
                    size += 1
                if at_a >= 0.0:
                    stack[size], entries[size] = a, at_a
                    size += 1
            elif first <= g < last and colors[g, 3] != 0.0:
                at, away, extents, quat = _geom(g, sizes, positions, quats, o)
                if dot(away, away) > (reach + radii[g]) ** 2:
                    continue
                rotation, offset, limit = _rotation(quat), minus(o, at), 0.0
                for k in range(count):
                    m = order[start + k]
                    inverse = (inverses[k, 0], inverses[k, 1], inverses[k, 2])
                    if _entry(boxes[n], o, inverse, min(best[k], reach + 2.0 * widest)) >= 0.0:
                        d = (directions[m, 0], directions[m, 1], directions[m, 2])
                        x, where = _to_geom(kinds[g], extents, rotation, offset, d)
                        if 0.0 <= x < best[k] or (x == best[k] and g < found[k]):
                            best[k], found[k], part[k] = x, g, where
                    limit = max(limit, min(best[k], reach + 2.0 * widest))
        for k in range(count):
            g, m = found[k], order[start + k]
            if g >= 0:
                distance[m], hit[m] = best[k], g
                if len(normal):
                    d = (directions[m, 0], directions[m, 1], directions[m, 2])
                    at, _, extents, quat = _geom(g, sizes, positions, quats, o)
                    normal[m, 0], normal[m, 1], normal[m, 2] = _normal(
                        kinds[g], extents, at, quat, o, d, best[k], part[k]
                    )
