"""Kernel that computes the result of a step: observation, reward, ends of episodes and infos."""

from functools import lru_cache
from typing import Any

import warp as wp

from greenhouse_gym.envs.warp.contacts import _COUNTERPARTS, MAX_PARTS
from greenhouse_gym.envs.warp.structs import FRESH, IDLE, NO_CONTACT, Half4, structs
from greenhouse_gym.motion.distance_field import CELL, MAX_DISTANCE, ORIGIN, SHAPE

FEATURES = (
    "joint_position", "joint_velocity", "command_error", "tip_position", "tool_axis", "grasp_offset", "target_position",
    "target_direction", "turn_to_target", "clearance", "obstacle_direction",
)  # fmt: skip
"""Features that the kernel computes."""


@wp.struct
class Layout:
    """First column of each feature in the observation; -1 if it is not part of it."""

    joint_position: wp.int32
    joint_velocity: wp.int32
    command_error: wp.int32
    grasp_offset: wp.int32
    target_position: wp.int32
    target_direction: wp.int32
    turn_to_target: wp.int32
    tip_position: wp.int32
    tool_axis: wp.int32
    clearance: wp.int32
    obstacle_direction: wp.int32


@wp.struct
class Rules:
    """Success radius, step limit, factors of the reward's terms, and whether the target counts as an obstacle."""

    success_radius: wp.float64
    step_limit: wp.int32
    success: wp.float32
    collision: wp.float32
    progress: wp.float32
    time: wp.float32
    effort: wp.float32
    target_is_obstacle: wp.int32


@wp.struct
class Output:
    """Arrays (n, ...) that a step returns; ``contact`` holds the arm's part and its counterpart, -1 without contact."""

    observation: wp.array2d(dtype=wp.float32)
    achieved: wp.array2d(dtype=wp.float64)
    desired: wp.array2d(dtype=wp.float64)
    reward: wp.array(dtype=wp.float32)
    terms: wp.array2d(dtype=wp.float32)
    terminated: wp.array(dtype=wp.bool)
    truncated: wp.array(dtype=wp.bool)
    ended: wp.array(dtype=wp.bool)
    success: wp.array(dtype=wp.bool)
    collision: wp.array(dtype=wp.bool)
    contact: wp.array2d(dtype=wp.int32)
    distance: wp.array(dtype=wp.float32)
    clearance: wp.array(dtype=wp.float32)
    scene: wp.array(dtype=wp.int32)
    target: wp.array(dtype=wp.int32)
    difficulty: wp.array(dtype=wp.int32)


@lru_cache
def observe_kernel(real: Any) -> wp.Kernel:
    """Return the outcome kernel for a type of real numbers."""
    t = structs(real)
    vec3, Arm, Scenes, State = t.vec3, t.Arm, t.Scenes, t.State
    fresh, idle, none = FRESH, IDLE, NO_CONTACT
    counterparts, max_parts = _COUNTERPARTS, MAX_PARTS
    origin, cell, far, capped = vec3(*ORIGIN), real(CELL), real(MAX_DISTANCE), real(MAX_DISTANCE - 1e-3)
    size_y, size_z, nodes = SHAPE[1], SHAPE[2], SHAPE[0] * SHAPE[1] * SHAPE[2]
    last_x, last_y, last_z = (real(size - 1 - 1e-5) for size in SHAPE)
    zero, one, shortest = real(0.0), real(1.0), real(1e-6)

    @wp.func
    def put(row: wp.array(dtype=wp.float32), first: wp.int32, value: vec3):
        """Write a vector into an observation that contains it."""
        if first >= 0:
            for d in range(3):
                row[first + d] = wp.float32(value[d])

    @wp.func
    def put_values(row: wp.array(dtype=wp.float32), first: wp.int32, values: wp.array(dtype=real)):
        if first >= 0:
            for i in range(values.shape[0]):
                row[first + i] = wp.float32(values[i])

    @wp.kernel(module="unique", enable_backward=False)
    def observe(
        arm: Arm,
        scenes: Scenes,
        fields: wp.array(dtype=Half4),
        s: State,
        rules: Rules,
        layout: Layout,
        low: wp.array(dtype=wp.float32),
        high: wp.array(dtype=wp.float32),
        resets_only: wp.int32,
        out: Output,
    ):
        """Compute observation and outcome of a simulation; ``resets_only`` keeps the rewards and ends of the step."""
        w = wp.tid()
        phase = s.phase[w]
        if phase == idle:
            return
        row = s.row[w]
        scene = scenes.scene[row]
        base = scenes.base[scene]
        heading = scenes.heading[scene]
        tip = (s.tip[w] - base) @ heading
        axis = s.axis[w] @ heading
        grasp = tip + scenes.radius[row] * axis
        target = scenes.target[row]
        goal = scenes.goal[row]
        distance = wp.length(goal - grasp)
        contact = s.contact[w]
        if phase == fresh:
            s.start_contact[w] = contact
        else:
            contact = wp.min(contact, s.start_contact[w])
            s.start_contact[w] = none
        collided = contact != none
        success = wp.float64(distance) < rules.success_radius and not collided
        out.success[w] = success
        out.collision[w] = collided
        out.contact[w, 0] = wp.where(collided, (contact // counterparts) % max_parts, -1)
        out.contact[w, 1] = wp.where(collided, contact % counterparts, -1)
        out.distance[w] = wp.float32(distance)
        out.scene[w] = scene
        out.target[w] = scenes.tomato[row]
        out.difficulty[w] = scenes.rating[row]
        if phase != fresh:
            steps = s.steps[w] + 1
            s.steps[w] = steps
            gained = wp.where(success, rules.success, 0.0)
            lost = wp.where(collided, rules.collision, 0.0)
            progress = rules.progress * wp.float32(s.distance[w] - distance)
            effort = rules.effort * wp.float32(s.effort[w])
            out.terms[w, 0] = gained
            out.terms[w, 1] = lost
            out.terms[w, 2] = progress
            out.terms[w, 3] = rules.time
            out.terms[w, 4] = effort
            out.reward[w] = gained + lost + progress + rules.time + effort
            ended = success or collided
            out.terminated[w] = ended
            out.truncated[w] = steps >= rules.step_limit and not ended
            out.ended[w] = ended or steps >= rules.step_limit
            if ended or steps >= rules.step_limit:
                s.ended[w] = 1
        elif resets_only == 0:
            for k in range(5):
                out.terms[w, k] = 0.0
            out.reward[w] = 0.0
            out.terminated[w] = False
            out.truncated[w] = False
            out.ended[w] = False
        s.distance[w] = distance
        for d in range(3):
            out.achieved[w, d] = wp.float64(grasp[d])
            out.desired[w, d] = wp.float64(goal[d])
        observation = out.observation[w]
        put_values(observation, layout.joint_position, s.joints[w])
        put_values(observation, layout.joint_velocity, s.velocities[w])
        if layout.command_error >= 0:
            for i in range(s.joints.shape[1]):
                observation[layout.command_error + i] = wp.float32(s.command[w, i] - s.joints[w, i])
        put(observation, layout.grasp_offset, target - grasp)
        put(observation, layout.target_position, target)
        put(observation, layout.tip_position, tip)
        put(observation, layout.tool_axis, axis)
        direction = (target - tip) / wp.max(wp.length(target - tip), shortest)
        put(observation, layout.target_direction, direction)
        put(observation, layout.turn_to_target, wp.cross(axis, direction))
        ignored = wp.float16(float(scenes.tomato[row]))
        if rules.target_is_obstacle != 0:
            ignored = wp.float16(-2.0)
        nearest = real(1000.0)
        probe = int(0)
        while probe < arm.probe_link.shape[0]:
            position = ((s.probe[w, probe] - base) @ heading - origin) / cell
            inside = vec3(
                wp.clamp(position[0], zero, last_x),
                wp.clamp(position[1], zero, last_y),
                wp.clamp(position[2], zero, last_z),
            )
            x = int(inside[0])
            y = int(inside[1])
            z = int(inside[2])
            fraction = inside - vec3(real(x), real(y), real(z))
            value = real(0.0)
            slope = vec3()
            for dx in range(2):
                for dy in range(2):
                    for dz in range(2):
                        node = fields[scene * nodes + ((x + dx) * size_y + y + dy) * size_z + z + dz]
                        v = real(wp.where(node[2] == ignored, node[1], node[0]))
                        wx = wp.where(dx == 1, fraction[0], one - fraction[0])
                        wy = wp.where(dy == 1, fraction[1], one - fraction[1])
                        wz = wp.where(dz == 1, fraction[2], one - fraction[2])
                        value += v * wx * wy * wz
                        slope += v * vec3(
                            real(2 * dx - 1) * wy * wz, real(2 * dy - 1) * wx * wz, real(2 * dz - 1) * wx * wy
                        )
            value += cell * wp.length(position - inside)
            length = wp.length(slope)
            to_obstacle = vec3()
            if value < capped and length > shortest:
                to_obstacle = -slope / length
            clearance = wp.min(value, far) - arm.probe_radius[probe]
            nearest = wp.min(nearest, clearance)
            if layout.clearance >= 0:
                observation[layout.clearance + probe] = wp.float32(clearance)
            if layout.obstacle_direction >= 0:
                put(observation, layout.obstacle_direction + 3 * probe, to_obstacle)
            probe += 1
        out.clearance[w] = wp.float32(nearest)
        column = int(0)
        while column < low.shape[0]:
            observation[column] = wp.clamp(observation[column], low[column], high[column])
            column += 1

    return observe
