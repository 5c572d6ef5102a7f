"""Grids of distances to the shapes of scenes, computed on the device."""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from greenhouse_gym.envs.warp.geometry import geometry

# mypy: disable-error-code="no-untyped-def, valid-type, operator, call-overload, index, arg-type"

COARSE_CELL, COARSE_COUNT, COARSE_UNIT = 0.05, 48, 0.0025
"""Distance between the nodes of the coarse grid around the arm, their number along each axis, and the unit of its
distances, metres."""

_BLOCK = 8
_AT_ONCE = 16  # scenes whose grids are computed together

Half4 = wp.types.vector(4, wp.float16)


class GridKernels(NamedTuple):
    """Kernels for one precision: `fill` computes a grid, `coarsen` rounds it down to bytes."""

    fill: wp.Kernel
    coarsen: wp.Kernel


@lru_cache
def grid_kernels(real: Any) -> GridKernels:
    """Return the kernels of a precision."""
    g = geometry(real)
    vec3, mat3, Shapes, point_distance = g.vec3, g.mat3, g.Shapes, g.point_distance  # noqa: N806
    zero, half = real(0.0), real(0.5)

    @wp.func
    def keep_near(
        shapes: Shapes,
        first: wp.int32,
        point: vec3,
        radius: real,
        limit: real,
        lists: wp.array2d(dtype=wp.int32),
        thread: wp.int32,
        source: wp.int32,
        count: wp.int32,
        result: wp.int32,
    ):
        """Copy those shapes of a list that may be the nearest or second nearest within a ball; return their number."""
        nearest = limit - radius
        second = limit - radius
        i = int(0)
        while i < count:
            row = first + i
            if source >= 0:
                row = lists[thread, source + i]
            if wp.length(point - shapes.center[row]) - shapes.bound[row] < second + radius + radius:
                distance = point_distance(shapes, row, point)
                if distance < nearest:
                    second = nearest
                    nearest = distance
                elif distance < second:
                    second = distance
            i += 1
        kept = int(0)
        i = int(0)
        while i < count:
            row = first + i
            if source >= 0:
                row = lists[thread, source + i]
            reach = second + radius + radius
            if wp.length(point - shapes.center[row]) - shapes.bound[row] < reach:
                if point_distance(shapes, row, point) <= reach:
                    lists[thread, result + kept] = row
                    kept += 1
            i += 1
        return kept

    @wp.kernel(module="unique", enable_backward=False)
    def fill(
        shapes: Shapes,
        skip: wp.array(dtype=wp.int32),
        tomatoes: wp.array(dtype=wp.int32),
        position: wp.array(dtype=vec3),
        rotation: wp.array(dtype=mat3),
        first_scene: wp.int32,
        origin: vec3,
        cell: real,
        nodes: wp.vec3i,
        limit: real,
        lists: wp.array2d(dtype=wp.int32),
        grid: wp.array(dtype=Half4),
    ):
        """Fill one block of nodes of a scene's grid: distance, distance without the nearest tomato, and its index.

        Blocks are halved; a shape stays with a block only while it may be one of the two nearest somewhere in it.
        """
        index, block = wp.tid()
        thread = index * (nodes[0] * nodes[1] * nodes[2] // 512) + block
        scene = first_scene + index
        room = lists.shape[1] // 3
        fruit = shapes.first[scene] + skip[scene]
        others = fruit + tomatoes[scene]
        by = nodes[1] // 8
        bz = nodes[2] // 8
        corner = wp.vec3i(8 * (block // (by * bz)), 8 * ((block // bz) % by), 8 * (block % bz))
        base = position[scene]
        turn = rotation[scene]
        spread = cell * real(0.8660254037844386)
        middle = vec3(real(corner[0]), real(corner[1]), real(corner[2])) + real(3.5) * vec3(real(1.0))
        count = shapes.count[scene] - skip[scene]
        large = keep_near(
            shapes, fruit, base + turn * (origin + cell * middle), real(7.0) * spread, limit, lists, thread, -1, count, 0
        )
        octant = int(0)
        while octant < 8:
            low = corner + 4 * wp.vec3i(octant // 4, (octant // 2) % 2, octant % 2)
            middle = vec3(real(low[0]), real(low[1]), real(low[2])) + real(1.5) * vec3(real(1.0))
            small = keep_near(
                shapes, 0, base + turn * (origin + cell * middle), real(3.0) * spread, limit, lists, thread, 0, large, room
            )
            part = int(0)
            while part < 8:
                pair = low + 2 * wp.vec3i(part // 4, (part // 2) % 2, part % 2)
                middle = vec3(real(pair[0]), real(pair[1]), real(pair[2])) + half * vec3(real(1.0))
                few = keep_near(
                    shapes, 0, base + turn * (origin + cell * middle), spread, limit, lists, thread, room, small, 2 * room
                )
                node = int(0)
                while node < 8:
                    at = pair + wp.vec3i(node // 4, (node // 2) % 2, node % 2)
                    point = base + turn * (origin + cell * vec3(real(at[0]), real(at[1]), real(at[2])))
                    nearest = limit
                    otherwise = limit
                    tomato = int(-1)
                    i = int(0)
                    while i < few:
                        row = lists[thread, 2 * room + i]
                        distance = point_distance(shapes, row, point)
                        if distance < nearest:
                            otherwise = nearest
                            nearest = distance
                            tomato = wp.where(row < others, row - fruit, -1)
                        else:
                            otherwise = wp.min(otherwise, distance)
                        i += 1
                    place = scene * (nodes[0] * nodes[1] * nodes[2]) + (at[0] * nodes[1] + at[1]) * nodes[2] + at[2]
                    grid[place] = Half4(
                        wp.float16(wp.max(nearest, real(-1000.0))),
                        wp.float16(wp.max(otherwise, real(-1000.0))),
                        wp.float16(float(tomato)),
                        wp.float16(0.0),
                    )
                    node += 1
                part += 1
            octant += 1

    @wp.kernel(module="unique", enable_backward=False)
    def coarsen(grid: wp.array(dtype=Half4), unit: real, coarse: wp.array(dtype=wp.uint8)):
        """Round distances down to bytes; float16 may have rounded them up by half a unit."""
        i = wp.tid()
        coarse[i] = wp.uint8(int(wp.clamp(real(grid[i][0]) / unit - half, zero, real(255.0))))

    return GridKernels(fill, coarsen)
