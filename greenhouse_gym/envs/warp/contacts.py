"""Kernels that find contacts of the arm: `screen` finds the parts near shapes, `collide` tests these exactly."""

from functools import lru_cache
from typing import Any, NamedTuple

import warp as wp

from greenhouse_gym.envs.warp.fields import COARSE_CELL, COARSE_COUNT, COARSE_UNIT
from greenhouse_gym.envs.warp.structs import IDLE, structs

MAX_SHAPES, MAX_PARTS = 60_000, 128
"""Maximum number of shapes in a scene and of parts of an arm that a contact can encode."""

FLOOR = 65_535
"""Counterpart of a contact with the floor; those from `MAX_SHAPES` on are parts of the arm, those below are shapes."""

_COUNTERPARTS = 65_536
_LAST_STEP = 127  # later physics steps have this order in codes
_SLACK = 0.004  # metres by which a part must be away from shapes to be left out


class ContactKernels(NamedTuple):
    """Kernels for one precision."""

    screen: wp.Kernel
    collide: wp.Kernel


@lru_cache
def contact_kernels(real: Any, lanes: int) -> ContactKernels:
    """Return the kernels of a precision; ``lanes`` threads share the shapes of a simulation."""
    t = structs(real)
    vec3, Arm, Scenes, Grids, State, Shapes = t.vec3, t.Arm, t.Scenes, t.Grids, t.State, t.Shapes
    to_point, to_segment, segment_distance = t.to_point, t.to_segment, t.segment_distance
    idle, count, last = IDLE, COARSE_COUNT, COARSE_COUNT - 1
    half_width = real(COARSE_CELL * (COARSE_COUNT - 1) / 2)
    zero, half, cell, unit, slack, tiny = (real(x) for x in (0.0, 0.5, COARSE_CELL, COARSE_UNIT, _SLACK, 1e-9))
    own, floor, counterparts, per_step, last_step = (
        MAX_SHAPES,
        FLOOR,
        _COUNTERPARTS,
        _COUNTERPARTS * MAX_PARTS,
        _LAST_STEP,
    )

    @wp.kernel(module="unique", enable_backward=False)
    def screen(arm: Arm, scenes: Scenes, grids: Grids, s: State):
        """March along a part's axis in steps that the coarse grid proves to be free."""
        w, part = wp.tid()
        if s.phase[w] == idle:
            return
        near = int(0)
        if arm.part_touches[part] != 0:
            scene = scenes.scene[s.row[w]]
            low = scenes.base[scene] - vec3(half_width)
            end_step = s.part_start.shape[1] - 1
            start = s.part_start[w, end_step, part]
            along = s.part_end[w, end_step, part] - start
            length = wp.length(along)
            along = along / wp.max(length, tiny)
            reach = arm.part_radius[part] + s.travel[w, part] + slack
            done = real(0.0)
            going = int(1)
            while going != 0:
                position = (start + done * along - low) / cell
                x = wp.clamp(int(wp.round(position[0])), 0, last)
                y = wp.clamp(int(wp.round(position[1])), 0, last)
                z = wp.clamp(int(wp.round(position[2])), 0, last)
                node = grids.coarse[((scene * count + x) * count + y) * count + z]
                away = cell * wp.length(position - vec3(real(x), real(y), real(z)))
                free = unit * real(int(node)) - away - reach
                if free <= zero:
                    near = 1
                    going = 0
                elif done >= length:
                    going = 0
                else:
                    done = wp.min(length, done + free + slack)
        s.near[w, part] = near

    @wp.func
    def code(step: wp.int32, part: wp.int32, counterpart: wp.int32):
        return wp.min(step, last_step) * per_step + part * counterparts + counterpart

    @wp.kernel(module="unique", enable_backward=False)
    def collide(arm: Arm, scenes: Scenes, shapes: Shapes, s: State):
        """Record the first contact with some of the shapes, of the arm with itself, and with the floor."""
        w, lane = wp.tid()
        if s.phase[w] == idle:
            return
        scene = scenes.scene[s.row[w]]
        first = shapes.first[scene]
        shape_count = shapes.count[scene]
        target = scenes.shape[s.row[w]]
        parts = arm.part_link.shape[0]
        steps = s.part_start.shape[1]
        best = s.contact[w]
        none = best
        part = int(0)
        while part < parts:
            touches = arm.part_touches[part]
            if touches != 0 and s.near[w, part] != 0:
                start = s.part_start[w, steps - 1, part]
                along = s.part_end[w, steps - 1, part] - start
                middle = start + half * along
                radius = arm.part_radius[part]
                reach = radius + s.travel[w, part]
                ball = reach + half * wp.length(along)
                shape = lane
                while shape < shape_count:
                    bound = shapes.bound[first + shape]
                    offset = shapes.center[first + shape] - middle
                    if wp.dot(offset, offset) < (ball + bound) * (ball + bound) and (touches == 1 or shape != target):
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
                    shape += lanes
            part += 1
        pair = lane
        while pair < arm.pairs.shape[0]:
            a = arm.pairs[pair][0]
            b = arm.pairs[pair][1]
            touching = arm.part_radius[a] + arm.part_radius[b]
            far = touching + s.travel[w, a] + s.travel[w, b]
            step = steps - 1
            while step >= 0:  # the last one first, which rules out most pairs
                at_a = s.part_start[w, step, a]
                at_b = s.part_start[w, step, b]
                squared = to_segment(at_a, s.part_end[w, step, a] - at_a, at_b, s.part_end[w, step, b] - at_b)
                if squared < touching * touching:
                    best = wp.min(best, code(step, a, own + b))
                if step == steps - 1 and squared >= far * far:
                    step = 0
                step -= 1
            pair += lanes
        part = lane
        while part < parts:
            lowest = wp.min(s.part_start[w, steps - 1, part][2], s.part_end[w, steps - 1, part][2])
            if arm.part_touches[part] != 0 and (
                lowest - s.travel[w, part] - arm.part_radius[part] < scenes.floor[scene]
            ):
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

    return ContactKernels(screen, collide)
