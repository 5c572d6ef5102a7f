"""Kernel that finds contacts of the arm with the scene, itself and the floor."""

from functools import lru_cache
from typing import Any

import warp as wp

from greenhouse_gym.envs.warp.cells import CELL
from greenhouse_gym.envs.warp.structs import IDLE, Cells, structs

MAX_SHAPES, MAX_PARTS = 60_000, 128
"""Maximum number of shapes in a scene and of parts of an arm that a contact can encode."""

FLOOR = 65_535
"""Counterpart of a contact with the floor; those from `MAX_SHAPES` on are parts of the arm, those below are shapes."""

_COUNTERPARTS = 65_536
_LAST_STEP = 127  # later physics steps have this order in codes


@lru_cache
def collide_kernel(real: Any, lanes: int, part_threads: int) -> wp.Kernel:
    """Return the collision kernel for a type of real numbers.

    Args:
        real: Type of real numbers.
        lanes: Number of threads of a simulation.
        part_threads: Number of threads that divide the neighborhood of a part.
    """
    t = structs(real)
    vec3, Arm, Scenes, State, Shapes = t.vec3, t.Arm, t.Scenes, t.State, t.Shapes
    to_point, to_segment, segment_distance = t.to_point, t.to_segment, t.segment_distance
    idle, half, cell = IDLE, real(0.5), real(CELL)
    own, floor, counterparts, per_step, last_step = (
        MAX_SHAPES,
        FLOOR,
        _COUNTERPARTS,
        _COUNTERPARTS * MAX_PARTS,
        _LAST_STEP,
    )

    @wp.func
    def code(step: wp.int32, part: wp.int32, counterpart: wp.int32):
        return wp.min(step, last_step) * per_step + part * counterparts + counterpart

    @wp.kernel(module="unique", enable_backward=False)
    def collide(arm: Arm, scenes: Scenes, shapes: Shapes, cells: Cells, s: State):
        """Record the first contact of some of the parts."""
        w, lane = wp.tid()
        if s.phase[w] == idle:
            return
        scene = scenes.scene[s.row[w]]
        first = shapes.first[scene]
        target = scenes.shape[s.row[w]]
        low = scenes.base[scene] + vec3(real(cells.low))
        side = cells.side
        parts = arm.part_link.shape[0]
        steps = s.part_start.shape[1]
        best = s.contact[w]
        none = best
        work = lane
        while work < parts * part_threads:
            part = work // part_threads
            mask = arm.part_mask[part]
            start = s.part_start[w, steps - 1, part]
            end = s.part_end[w, steps - 1, part]
            along = end - start
            middle = start + half * along
            radius = arm.part_radius[part]
            reach = radius + s.travel[w, part]
            ball = reach + half * wp.length(along)
            first_cell = (wp.min(start, end) - vec3(reach) - low) / cell
            last_cell = (wp.max(start, end) + vec3(reach) - low) / cell
            last_x = wp.min(int(last_cell[0]), side - 1)
            last_y = wp.min(int(last_cell[1]), side - 1)
            last_z = wp.min(int(last_cell[2]), side - 1)
            x = wp.max(int(first_cell[0]), 0) + work % part_threads
            if mask == 0:
                x = side
            while x <= last_x:
                y = wp.max(int(first_cell[1]), 0)
                while y <= last_y:
                    z = wp.max(int(first_cell[2]), 0)
                    row = ((scene * side + x) * side + y) * side
                    item = cells.start[row + z]  # the cells of a row follow each other
                    last_item = cells.start[row + last_z + 1]
                    while item < last_item:
                        shape = cells.item[item]
                        bound = shapes.bound[first + shape]
                        offset = shapes.center[first + shape] - middle
                        if wp.dot(offset, offset) < (ball + bound) * (ball + bound) and (mask == 1 or shape != target):
                            squared = to_point(start, along, shapes.center[first + shape])
                            if squared < (reach + bound) * (reach + bound) and (
                                segment_distance(shapes, first + shape, start, along) < reach
                            ):
                                step = int(0)
                                while step < steps:
                                    at = s.part_start[w, step, part]
                                    gap = segment_distance(shapes, first + shape, at, s.part_end[w, step, part] - at)
                                    if gap < radius:
                                        best = wp.min(best, code(step, part, shape))
                                        step = steps
                                    step += 1
                        item += 1
                    y += 1
                x += part_threads
            work += lanes
        pair = lane
        while pair < arm.pairs.shape[0]:
            a = arm.pairs[pair][0]
            b = arm.pairs[pair][1]
            contact_distance = arm.part_radius[a] + arm.part_radius[b]
            far = contact_distance + s.travel[w, a] + s.travel[w, b]
            step = steps - 1
            while step >= 0:  # the last one first, which rules out most pairs
                at_a = s.part_start[w, step, a]
                at_b = s.part_start[w, step, b]
                squared = to_segment(at_a, s.part_end[w, step, a] - at_a, at_b, s.part_end[w, step, b] - at_b)
                if squared < contact_distance * contact_distance:
                    best = wp.min(best, code(step, a, own + b))
                if step == steps - 1 and squared >= far * far:
                    step = 0
                step -= 1
            pair += lanes
        part = lane
        while part < parts:
            lowest = wp.min(s.part_start[w, steps - 1, part][2], s.part_end[w, steps - 1, part][2])
            if arm.part_mask[part] != 0 and (lowest - s.travel[w, part] - arm.part_radius[part] < scenes.floor[scene]):
                step = int(0)
                while step < steps:
                    lowest = wp.min(s.part_start[w, step, part][2], s.part_end[w, step, part][2])
                    if lowest - arm.part_radius[part] < scenes.floor[scene]:
                        best = wp.min(best, code(step, part, floor))
                        step = steps
                    step += 1
            part += lanes
        if best < none:
            wp.atomic_min(s.contact, w, best)

    return collide
