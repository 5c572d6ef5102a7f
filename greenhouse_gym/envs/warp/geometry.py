"""Distances between the axis of an arm's part and the shapes of a scene, as Warp functions for one precision."""

from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import warp as wp

from greenhouse_gym.geometry.shape_arrays import BOX, CAPSULE, SPHERE


@lru_cache
def geometry(real: Any) -> SimpleNamespace:
    """Return types and functions for a type of real numbers: ``vec3``, ``mat3``, ``Shapes`` and distances."""
    vec3, mat3 = wp.types.vector(3, real), wp.types.matrix((3, 3), real)
    zero, one, half, two, tiny = (real(x) for x in (0.0, 1.0, 0.5, 2.0, 1e-12))
    parallel, golden, min_axis, smallest_slope = real(1e-9), real(0.381966), real(1e-6), real(1e-20)
    sphere, capsule, box = SPHERE, CAPSULE, BOX

    @wp.struct
    class Shapes:
        first: wp.array(dtype=wp.int32)
        count: wp.array(dtype=wp.int32)
        kind: wp.array(dtype=wp.int32)
        center: wp.array(dtype=vec3)
        rotation: wp.array(dtype=mat3)
        size: wp.array(dtype=vec3)
        bound: wp.array(dtype=real)

    @wp.func
    def to_point(start: vec3, along: vec3, point: vec3):
        """Return the squared distance of the segment from ``start`` to ``start + along`` to a point."""
        offset = point - start
        offset = offset - wp.clamp(wp.dot(offset, along) / wp.max(wp.dot(along, along), tiny), zero, one) * along
        return wp.dot(offset, offset)

    @wp.func
    def to_segment(start: vec3, along: vec3, other: vec3, other_along: vec3):
        """Return the squared distance of two segments (Ericson, Real-Time Collision Detection, 5.1.9)."""
        offset = start - other
        a = wp.max(wp.dot(along, along), tiny)
        e = wp.max(wp.dot(other_along, other_along), tiny)
        b = wp.dot(along, other_along)
        c = wp.dot(along, offset)
        f = wp.dot(other_along, offset)
        denominator = a * e - b * b
        u = real(0.0)
        if denominator > parallel * a * e:
            u = wp.clamp((b * f - c * e) / denominator, zero, one)
        v = wp.clamp((b * u + f) / e, zero, one)
        u = wp.clamp((b * v - c) / a, zero, one)
        apart = offset + u * along - v * other_along
        return wp.dot(apart, apart)

    @wp.func
    def slope_to_box(start: vec3, along: vec3, size: vec3, t: real):
        """Return half the derivative along t of the squared distance of ``start + t along`` to a box."""
        total = real(0.0)
        for i in range(3):
            x = start[i] + t * along[i]
            total += (x - wp.clamp(x, -size[i], size[i])) * along[i]
        return total

    @wp.func
    def to_box(start: vec3, along: vec3, size: vec3):
        """Return the squared distance of a segment to a box at the origin.

        It is convex along the segment, and quadratic between the planes of the faces.
        """
        low = real(0.0)
        high = real(1.0)
        if slope_to_box(start, along, size, zero) >= zero:
            high = real(0.0)
        elif slope_to_box(start, along, size, one) <= zero:
            low = real(1.0)
        else:
            for i in range(3):
                for side in range(2):
                    t = (real(2 * side - 1) * size[i] - start[i]) / along[i]  # infinite or NaN if parallel
                    if t > low and t < high:
                        if slope_to_box(start, along, size, t) > zero:
                            high = t
                        else:
                            low = t
            falling = slope_to_box(start, along, size, low)
            rising = slope_to_box(start, along, size, high)
            if rising - falling > smallest_slope:
                low += (high - low) * wp.clamp(-falling / (rising - falling), zero, one)
        total = real(0.0)
        for i in range(3):
            x = start[i] + low * along[i]
            x -= wp.clamp(x, -size[i], size[i])
            total += x * x
        return total

    @wp.func
    def ellipsoid_distance(point: vec3, axes: vec3):
        """Return the signed distance of a point to an ellipsoid at the origin, by Newton's method (Eberly, 2013)."""
        shortest = wp.min(axes[0], wp.min(axes[1], axes[2]))
        inside = real(0.0)
        t = real(-1e9)
        y = vec3()
        for i in range(3):
            y[i] = wp.max(wp.abs(point[i]), min_axis * shortest)
            inside += (y[i] / axes[i]) * (y[i] / axes[i])
            t = wp.max(t, axes[i] * y[i] - axes[i] * axes[i])
        steps = int(0)
        while steps < 12:
            value = -one
            slope = real(0.0)
            for i in range(3):
                m = t + axes[i] * axes[i]
                part = axes[i] * y[i] / m
                value += part * part
                slope -= two * part * part / m
            t -= value / slope
            steps += 1
        total = real(0.0)
        for i in range(3):
            x = y[i] * t / (t + axes[i] * axes[i])
            total += x * x
        return wp.where(inside < one, -wp.sqrt(total), wp.sqrt(total))

    @wp.func
    def to_ellipsoid(start: vec3, along: vec3, axes: vec3):
        """Return the distance of a segment to an ellipsoid at the origin; it is convex along the segment."""
        low = real(0.0)
        high = real(1.0)
        steps = int(0)
        while steps < 24:
            first = low + golden * (high - low)
            second = high - golden * (high - low)
            if ellipsoid_distance(start + first * along, axes) < ellipsoid_distance(start + second * along, axes):
                high = second
            else:
                low = first
            steps += 1
        return ellipsoid_distance(start + half * (low + high) * along, axes)

    @wp.func
    def segment_distance(shapes: Shapes, row: wp.int32, start: vec3, along: vec3):
        """Return the distance of a segment to a shape; at most 0 if it enters it."""
        kind = shapes.kind[row]
        size = shapes.size[row]
        center = shapes.center[row]
        if kind == sphere:
            return wp.sqrt(to_point(start, along, center)) - size[0]
        rotation = shapes.rotation[row]
        if kind == capsule:
            axis = size[1] * vec3(rotation[0, 2], rotation[1, 2], rotation[2, 2])
            return wp.sqrt(to_segment(start, along, center - axis, two * axis)) - size[0]
        local = (start - center) @ rotation
        local_along = along @ rotation
        if kind == box:
            return wp.sqrt(to_box(local, local_along, size))
        return to_ellipsoid(local, local_along, size)

    return SimpleNamespace(
        real=real, vec3=vec3, mat3=mat3, Shapes=Shapes, to_point=to_point, to_segment=to_segment,
        segment_distance=segment_distance
    )  # fmt: skip
