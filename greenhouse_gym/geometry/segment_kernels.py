"""Distances of segments from each other and from boxes and ellipsoids, for kernels."""

from __future__ import annotations

import math

from greenhouse_gym.common.jit import inlined

_GOLDEN, _SEARCHES = (math.sqrt(5.0) - 1) / 2, 24
_NEWTON_STEPS = 9


@inlined
def _clip(x):
    return 0.0 if x < 0.0 else (1.0 if x > 1.0 else x)


@inlined
def dot(a, b):
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def minus(a, b):
    """Return the difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def segments_apart(a, b, c, d):
    """Return the squared distance of the segments from a to b and from c to d (Ericson 2004)."""
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, vv, vw = dot(u, u), dot(v, v), dot(v, w)
    s = t = 0.0
    if uu < 1e-14:
        t = _clip(vw / vv) if vv >= 1e-14 else 0.0
    else:
        uw = dot(u, w)
        if vv < 1e-14:
            s = _clip(-uw / uu)
        else:
            uv = dot(u, v)
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
    d = minus(b, a)
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
def to_ellipsoid(a, b, t, e):
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
    at_u, at_v = to_ellipsoid(a, b, u, axes), to_ellipsoid(a, b, v, axes)
    best = min(min(at_u, at_v), min(to_ellipsoid(a, b, 0.0, axes), to_ellipsoid(a, b, 1.0, axes)))
    for _ in range(_SEARCHES):
        if at_u < at_v:
            high, v, at_v = v, u, at_u
            u = high - _GOLDEN * (high - low)
            at_u = to_ellipsoid(a, b, u, axes)
            best = min(best, at_u)
        else:
            low, u, at_u = u, v, at_v
            v = low + _GOLDEN * (high - low)
            at_v = to_ellipsoid(a, b, v, axes)
            best = min(best, at_v)
    return best
