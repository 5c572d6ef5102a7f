"""Grids of distances to the shapes of scenes, computed on the device."""

from functools import lru_cache
from typing import NamedTuple

import warp as wp

from greenhouse_gym.envs.warp.geometry import geometry

COARSE_CELL, COARSE_COUNT, COARSE_UNIT = 0.05, 48, 0.0025
"""Distance between the nodes of the coarse grid around the arm, their number along each axis, and the unit of its
distances, metres."""

Half4 = wp.types.vector(4, wp.float16)


class GridKernels(NamedTuple):
    """Kernels in single precision: `fill` computes a grid, `coarsen` rounds it down to bytes."""

    fill: wp.Kernel
    coarsen: wp.Kernel


@lru_cache
def grid_kernels() -> GridKernels:
    """Return the kernels."""
    g = geometry(wp.float32)
    unit = COARSE_UNIT
    vec3, mat3, Shapes, point_distance = g.vec3, g.mat3, g.Shapes, g.point_distance

    @wp.func
    def as_vector(node: wp.vec3i):
        return vec3(float(node[0]), float(node[1]), float(node[2]))

    @wp.func
    def keep_near(
        shapes: Shapes,
        first: wp.int32,
        point: vec3,
        radius: wp.float32,
        limit: wp.float32,
        rows: wp.array(dtype=wp.int32),
        distances: wp.array(dtype=wp.float32),
        source: wp.int32,
        count: wp.int32,
        result: wp.int32,
    ):
        """Copy those shapes of a list that may be the nearest or second nearest within a ball; return their number."""
        nearest = limit - radius
        second = limit - radius
        found = int(0)
        i = int(0)
        while i < count:
            row = first + i
            if source >= 0:
                row = rows[source + i]
            reach = second + radius + radius
            if wp.length(point - shapes.center[row]) - shapes.bound[row] <= reach:
                distance = point_distance(shapes, row, point)
                if distance <= reach:
                    rows[result + found] = row
                    distances[result + found] = distance
                    found += 1
                if distance < nearest:
                    second = nearest
                    nearest = distance
                elif distance < second:
                    second = distance
            i += 1
        kept = int(0)
        i = int(0)
        while i < found:  # those that came before the nearest ones may be too far
            if distances[result + i] <= second + radius + radius:
                rows[result + kept] = rows[result + i]
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
        cell: wp.float32,
        nodes: wp.vec3i,
        limit: wp.float32,
        lists: wp.array2d(dtype=wp.int32),
        scratch: wp.array2d(dtype=wp.float32),
        grid: wp.array(dtype=Half4),
    ):
        """Fill one block of nodes of a scene's grid: distance, distance without the nearest tomato, and its index.

        Blocks are halved; a shape stays with a block only while it may be one of the two nearest somewhere in it.
        """
        index, block = wp.tid()
        thread = index * (nodes[0] * nodes[1] * nodes[2] // 512) + block
        scene = first_scene + index
        rows = lists[thread]
        distances = scratch[thread]
        room = lists.shape[1] // 3
        fruit = shapes.first[scene] + skip[scene]
        others = fruit + tomatoes[scene]
        by = nodes[1] // 8
        bz = nodes[2] // 8
        corner = wp.vec3i(8 * (block // (by * bz)), 8 * ((block // bz) % by), 8 * (block % bz))
        base = position[scene]
        turn = rotation[scene]
        spread = cell * 0.8660254037844386  # half the diagonal of a cell
        middle = as_vector(corner) + vec3(3.5)
        count = shapes.count[scene] - skip[scene]
        large = keep_near(
            shapes, fruit, base + turn * (origin + cell * middle), 7.0 * spread, limit, rows, distances, -1, count, 0
        )
        octant = int(0)
        while octant < 8:
            low = corner + 4 * wp.vec3i(octant // 4, (octant // 2) % 2, octant % 2)
            middle = as_vector(low) + vec3(1.5)
            small = keep_near(
                shapes, 0, base + turn * (origin + cell * middle), 3.0 * spread, limit, rows, distances, 0, large, room
            )
            part = int(0)
            while part < 8:
                pair = low + 2 * wp.vec3i(part // 4, (part // 2) % 2, part % 2)
                middle = as_vector(pair) + vec3(0.5)
                few = keep_near(
                    shapes,
                    0,
                    base + turn * (origin + cell * middle),
                    spread,
                    limit,
                    rows,
                    distances,
                    room,
                    small,
                    2 * room,
                )
                node = int(0)
                while node < 8:
                    at = pair + wp.vec3i(node // 4, (node // 2) % 2, node % 2)
                    point = base + turn * (origin + cell * as_vector(at))
                    nearest = limit
                    otherwise = limit
                    tomato = int(-1)
                    i = int(0)
                    while i < few:
                        row = rows[2 * room + i]
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
                        wp.float16(wp.max(nearest, -1000.0)),
                        wp.float16(wp.max(otherwise, -1000.0)),
                        wp.float16(float(tomato)),
                        wp.float16(0.0),
                    )
                    node += 1
                part += 1
            octant += 1

    @wp.kernel(module="unique", enable_backward=False)
    def coarsen(grid: wp.array(dtype=Half4), coarse: wp.array(dtype=wp.uint8)):
        """Round distances down to bytes; float16 may have rounded them up by half a unit."""
        i = wp.tid()
        coarse[i] = wp.uint8(int(wp.clamp(float(grid[i][0]) / unit - 0.5, 0.0, 255.0)))

    return GridKernels(fill, coarsen)
